//! Child processes of a bench: the same program in other roles.

use std::{
    io::{BufRead, BufReader, Read},
    os::fd::OwnedFd,
    process::{Child, ChildStdout, Command, Stdio},
    time::Duration,
};

use rustix::{
    process::{Pid, Signal, kill_process},
    time::{ClockId, clock_gettime},
};

/// The environment variable that selects the role of a bench's program.
const ROLE: &str = "SINEW_BENCH_ROLE";
const THERE: &str = "there";

/// The role of this process; `None` if it was started from the command line.
#[must_use]
pub fn role() -> Option<String> {
    std::env::var(ROLE).ok()
}

/// A command that runs this program in another role.
///
/// # Panics
/// If the path of this program is unknown.
#[must_use]
pub fn command(role: &str) -> Command {
    let mut command = Command::new(std::env::current_exe().expect("this program has a path"));
    command.env(ROLE, role);
    command
}

/// Runs this program in another role until it exits. Returns whether it succeeded.
#[must_use]
pub fn has_run(mut command: Command) -> bool {
    command.stdin(Stdio::null()).status().is_ok_and(|status| status.success())
}

/// A child process of a bench. It is terminated on drop.
#[derive(Debug)]
pub struct Process {
    child: Child,
    output: BufReader<ChildStdout>,
}

impl Process {
    /// Starts a role and waits until it reports that it is ready. Its standard input closes when this value
    /// is dropped.
    ///
    /// # Panics
    /// If the process exits before it is ready.
    #[must_use]
    pub fn start(role: &str) -> Self {
        Self::start_command(command(role), role)
    }

    /// Like [`start`](Self::start), with a command that runs this program, such as one on another host.
    ///
    /// # Panics
    /// If the process exits before it is ready.
    #[must_use]
    pub fn start_command(command: Command, role: &str) -> Self {
        Self::start_with(command, Stdio::piped(), role)
    }

    /// Like [`start`](Self::start), with a file descriptor as standard input.
    ///
    /// # Panics
    /// If the process exits before it is ready.
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
    /// If the process no longer exists.
    pub fn signal(&self, signal: Signal) {
        let id = i32::try_from(self.child.id()).ok().and_then(Pid::from_raw).expect("a process id");
        kill_process(id, signal).expect("a child that nobody has collected takes signals");
    }

    /// Number of times that its threads have gone to sleep so far.
    #[must_use]
    pub fn sleeps(&self) -> u64 {
        sleeps_of(&self.child.id().to_string())
    }

    /// The next line of its output, which is a time as of [`print_time`].
    ///
    /// # Panics
    /// If it is another line, or the process has exited.
    pub fn time(&mut self) -> Duration {
        let line = self.line();
        Duration::from_nanos(line.parse().unwrap_or_else(|_| panic!("no nanoseconds: `{line}`")))
    }

    /// The next line of its output. At the end of the output the line is empty.
    ///
    /// # Panics
    /// If reading from the pipe fails.
    pub fn line(&mut self) -> String {
        let mut line = String::new();
        self.output.read_line(&mut line).expect("the other process can be read");
        line.trim_end().to_owned()
    }

    /// Closes its standard input, and waits until it has exited. Returns whether it succeeded.
    #[must_use]
    pub fn end(mut self) -> bool {
        drop(self.child.stdin.take());
        self.child.wait().is_ok_and(|status| status.success())
    }

    /// Waits until it has exited, and returns the rest of its output.
    #[must_use]
    pub fn wait(mut self) -> String {
        let mut rest = String::new();
        // Unreadable output is ignored.
        let _ = self.output.read_to_string(&mut rest);
        // The drop reaps the process.
        let _ = self.child.wait();
        rest
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        // The process may have exited already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Number of times that the threads of this process have gone to sleep so far. Each sleep requires a wakeup.
#[must_use]
pub fn sleeps() -> u64 {
    sleeps_of("self")
}

/// Voluntary context switches of all live threads, as Linux counts them; 0 if they are unknown.
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

/// CPU time of this process so far, with all its threads.
#[must_use]
pub fn cpu_time() -> Duration {
    let time = clock_gettime(ClockId::ProcessCPUTime);
    Duration::new(time.tv_sec as u64, time.tv_nsec as u32)
}

/// Prints a time for the parent process.
pub fn print_time(time: Duration) {
    println!("{}", time.as_nanos());
}

/// Tells the parent process that this process is ready.
pub fn print_ready() {
    println!("{THERE}");
}

/// Blocks until the parent process closes the pipe or terminates this process.
pub fn await_end() {
    let _ = std::io::stdin().read(&mut [0]);
}
