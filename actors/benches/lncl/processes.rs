//! The processes of a case: this program, in other roles, on the CPUs where the case wants them.

use std::{
    io::{BufRead, BufReader, Read},
    os::fd::OwnedFd,
    process::{Child, ChildStdout, Command, Stdio},
};

/// The environment variable that gives this program a role.
pub(crate) const ROLE: &str = "SINEW_LNCL_ROLE";
/// The one that makes a run short.
const SHORT: &str = "SINEW_LNCL_SHORT";

/// Whether this is a short run.
pub(crate) fn is_short() -> bool {
    std::env::var_os(SHORT).is_some()
}

/// This program in another role.
pub(crate) fn command(role: &str, is_short: bool) -> Command {
    let program = std::env::current_exe().expect("this program has a path");
    let mut command = Command::new(program);
    command.env(ROLE, role);
    if is_short {
        command.env(SHORT, "1");
    }
    command
}

/// Another process of a case; it is ended when this is dropped.
pub(crate) struct Process {
    child: Child,
    output: BufReader<ChildStdout>,
}

impl Process {
    /// Starts a role, and waits until it says that it is there.
    pub(crate) fn start(role: &str) -> Self {
        Self::start_with(role, Stdio::piped())
    }

    /// The same with a descriptor as its input; it says nothing.
    pub(crate) fn start_on(role: &str, input: OwnedFd) -> Self {
        Self::start_with(role, Stdio::from(input))
    }

    fn start_with(role: &str, input: Stdio) -> Self {
        let mut child = command(role, is_short())
            .stdin(input)
            .stdout(Stdio::piped())
            .spawn()
            .expect("a process for the other end");
        let mut output = BufReader::new(child.stdout.take().expect("its output is a pipe"));
        let mut line = String::new();
        output.read_line(&mut line).expect("the other end says that it is there");
        assert_eq!(line.trim(), THERE, "the process with the role `{role}` failed");
        Self { child, output }
    }

    /// Waits until it has ended by itself.
    pub(crate) fn wait(mut self) {
        // It says nothing more: its output ends with it.
        let _ = self.output.read_to_end(&mut Vec::new());
        let _ = self.child.wait();
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

const THERE: &str = "there";

/// Tells the process that started this one that it can go on.
pub(crate) fn say_there() {
    println!("{THERE}");
}

/// Until the process that started this one closes the pipe, or ends this one.
pub(crate) fn await_end() {
    let _ = std::io::stdin().read(&mut [0]);
}
