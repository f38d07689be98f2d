//! The processes of a bench: its own program, in other roles.

use std::{
    io::{BufRead, BufReader, Read},
    os::fd::OwnedFd,
    process::{Child, ChildStdout, Command, Stdio},
};

use rustix::process::{Pid, Signal, kill_process};

/// The environment variable that gives a bench's program a role.
const ROLE: &str = "SINEW_BENCH_ROLE";
const THERE: &str = "there";

/// The role that this process was started in, unless a person started it.
#[must_use]
pub fn role() -> Option<String> {
    std::env::var(ROLE).ok()
}

/// This program in another role.
///
/// # Panics
/// If the system does not say where this program is.
#[must_use]
pub fn command(role: &str) -> Command {
    let mut command = Command::new(std::env::current_exe().expect("this program has a path"));
    command.env(ROLE, role);
    command
}

/// Runs this program in another role until it has ended, and says whether that went well.
#[must_use]
pub fn has_run(mut command: Command) -> bool {
    command.stdin(Stdio::null()).status().is_ok_and(|status| status.success())
}

/// Another process of a bench; it is ended when this is dropped.
#[derive(Debug)]
pub struct Process {
    child: Child,
    output: BufReader<ChildStdout>,
}

impl Process {
    /// Starts a role, and waits until it says that it is there. Its input ends with this value.
    ///
    /// # Panics
    /// If it ends before.
    #[must_use]
    pub fn start(role: &str) -> Self {
        Self::start_command(command(role), role)
    }

    /// The same with a command that runs this program, such as one on another host.
    ///
    /// # Panics
    /// If it ends before.
    #[must_use]
    pub fn start_command(command: Command, role: &str) -> Self {
        Self::start_with(command, Stdio::piped(), role)
    }

    /// The same with a descriptor as its input.
    ///
    /// # Panics
    /// If it ends before.
    #[must_use]
    pub fn start_on(role: &str, input: OwnedFd) -> Self {
        Self::start_with(command(role), Stdio::from(input), role)
    }

    fn start_with(mut command: Command, input: Stdio, role: &str) -> Self {
        let child = command.stdin(input).stdout(Stdio::piped()).spawn();
        let mut child = child.expect("a process for the other end");
        let output = BufReader::new(child.stdout.take().expect("its output is a pipe"));
        let mut process = Self { child, output };
        assert_eq!(process.line(), THERE, "the process with the role `{role}` failed");
        process
    }

    /// Sends it a signal.
    ///
    /// # Panics
    /// If it is no process any more.
    pub fn signal(&self, signal: Signal) {
        let id = i32::try_from(self.child.id()).ok().and_then(Pid::from_raw).expect("a process id");
        kill_process(id, signal).expect("a child that nobody has collected takes signals");
    }

    /// How often its threads have gone to sleep so far.
    #[must_use]
    pub fn sleeps(&self) -> u64 {
        sleeps_of(&self.child.id().to_string())
    }

    /// The next line that it says.
    ///
    /// # Panics
    /// If the pipe breaks; at its end the line is empty.
    pub fn line(&mut self) -> String {
        let mut line = String::new();
        self.output.read_line(&mut line).expect("the other process is heard");
        line.trim_end().to_owned()
    }

    /// Waits until it has ended by itself, and hands out what it said last.
    #[must_use]
    pub fn wait(mut self) -> String {
        let mut rest = String::new();
        // What cannot be read was not said.
        let _ = self.output.read_to_string(&mut rest);
        // Dropping it collects it.
        let _ = self.child.wait();
        rest
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// How often the threads of this process have gone to sleep so far: each time, something must wake them.
#[must_use]
pub fn sleeps() -> u64 {
    sleeps_of("self")
}

/// What Linux counts as voluntary context switches, of all threads that live now; 0 where it does not say.
fn sleeps_of(process: &str) -> u64 {
    let tasks = std::fs::read_dir(format!("/proc/{process}/task"));
    let statuses = tasks.into_iter().flatten().flatten();
    let statuses = statuses.filter_map(|task| std::fs::read_to_string(task.path().join("status")).ok());
    statuses.filter_map(|status| counted(&status)).sum()
}

fn counted(status: &str) -> Option<u64> {
    let line = status.lines().find_map(|line| line.strip_prefix("voluntary_ctxt_switches:"))?;
    line.trim().parse().ok()
}

/// Tells the process that started this one that it can go on.
pub fn say_there() {
    println!("{THERE}");
}

/// Until the process that started this one closes the pipe, or ends this one.
pub fn await_end() {
    let _ = std::io::stdin().read(&mut [0]);
}
