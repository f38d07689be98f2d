//! A process of the cast, as its director sees it.

use std::{
    ffi::OsStr,
    io::{BufRead, BufReader, Write},
    path::Path,
    process::{Child, ChildStdin, Command, ExitStatus, Stdio},
    thread::JoinHandle,
};

use rustix::process::{Pid, Signal, kill_process};

use crate::until;

/// A running process. It is killed when this is dropped.
#[derive(Debug)]
pub struct Performer {
    role: String,
    child: Child,
    input: Option<ChildStdin>,
    reader: Option<JoinHandle<()>>,
}

impl Performer {
    /// Starts `program` in this role. Each whole line that it says is given to `hear`, on a thread of its own.
    ///
    /// # Panics
    /// If it cannot be started.
    pub(crate) fn start(
        program: &Path,
        role: &str,
        arguments: &[String],
        temporary: &Path,
        hear: impl FnMut(&str) + Send + 'static,
    ) -> Self {
        Self::start_with(program, role, arguments, &[("TMPDIR", temporary)], hear)
    }

    /// The same, with this in its environment.
    ///
    /// # Panics
    /// If it cannot be started.
    pub(crate) fn start_with(
        program: &Path,
        role: &str,
        arguments: &[String],
        environment: &[(&str, impl AsRef<OsStr>)],
        hear: impl FnMut(&str) + Send + 'static,
    ) -> Self {
        let mut command = Command::new(program);
        command.arg("--role").arg(role).args(arguments);
        command.envs(environment.iter().map(|(variable, value)| (variable, value)));
        Self::start_command(command, role, hear)
    }

    /// The same with a command that starts a program in this role, such as one on another host.
    ///
    /// # Panics
    /// If it cannot be started.
    pub(crate) fn start_command(
        mut command: Command,
        role: &str,
        mut hear: impl FnMut(&str) + Send + 'static,
    ) -> Self {
        let spawned = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn();
        let mut child = spawned.unwrap_or_else(|error| panic!("{role} does not start: {error}"));
        let (input, output) = (child.stdin.take(), child.stdout.take().expect("its output is a pipe"));
        let reader = std::thread::spawn(move || {
            let mut output = BufReader::new(output);
            let mut line = String::new();
            // A line without an end is one in which it was killed.
            while output.read_line(&mut line).is_ok() && line.ends_with('\n') {
                hear(line.trim_end());
                line.clear();
            }
        });
        Self { role: role.to_owned(), child, input, reader: Some(reader) }
    }

    /// Its process id.
    #[must_use]
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// Says a line to it.
    ///
    /// # Panics
    /// If it has ended.
    pub fn tell(&mut self, line: &str) {
        let input = self.input.as_mut().expect("its input is a pipe until it is told to end");
        writeln!(input, "{line}").unwrap_or_else(|error| panic!("{} does not listen: {error}", self.role));
    }

    /// Sends it a signal.
    ///
    /// # Panics
    /// If it is no process any more.
    pub fn signal(&self, signal: Signal) {
        let id = i32::try_from(self.child.id()).ok().and_then(Pid::from_raw).expect("a process id");
        kill_process(id, signal).unwrap_or_else(|error| panic!("{} takes no {signal:?}: {error}", self.role));
    }

    /// Stops it, and returns when it stands still.
    ///
    /// # Panics
    /// If it is no process any more.
    pub fn freeze(&self) {
        self.signal(Signal::STOP);
        crate::wait_until_frozen(self.child.id());
    }

    /// Kills it, and returns when it is gone and all that it said was heard: whether it had lived until then.
    ///
    /// # Panics
    /// If the system does not say.
    #[must_use]
    pub fn kill(mut self) -> bool {
        let lived = self.child.try_wait().expect("a child can be waited for").is_none();
        self.end_now();
        lived
    }

    /// Tells it to end, and waits until it has and all that it said was heard.
    ///
    /// # Panics
    /// If it does not in time.
    pub fn end(mut self) -> ExitStatus {
        drop(self.input.take());
        let (role, child) = (&self.role, &mut self.child);
        let status = until(&format!("{role} ends"), || child.try_wait().expect("a child can be waited for"));
        self.end_now();
        status
    }

    /// Kills it, and returns when it is gone and all that it said was heard.
    pub(crate) fn kill_now(&mut self) {
        self.end_now();
    }

    fn end_now(&mut self) {
        // It may have ended by itself.
        let _ = self.child.kill();
        let _ = self.child.wait();
        if let Some(reader) = self.reader.take() {
            // What it panicked of is on the terminal.
            let _ = reader.join();
        }
    }
}

impl Drop for Performer {
    fn drop(&mut self) {
        self.end_now();
    }
}
