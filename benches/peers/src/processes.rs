//! The processes of a case: this program, in other roles.

use std::{
    io::{BufRead, BufReader, Read},
    os::fd::OwnedFd,
    process::{Child, Command, Stdio},
};

/// The environment variable that gives this program a role.
pub(crate) const ROLE: &str = "SINEW_PEERS_ROLE";

const THERE: &str = "there";

/// This program in another role.
pub(crate) fn command(role: &str) -> Command {
    let mut command = Command::new(std::env::current_exe().expect("this program has a path"));
    command.env(ROLE, role);
    command
}

/// Another process of a case; it is ended when this is dropped.
pub(crate) struct Process(Child);

impl Process {
    /// Starts a role, and waits until it says that it is there.
    pub(crate) fn start(role: &str) -> Self {
        Self::start_with(role, Stdio::piped())
    }

    /// The same with a descriptor as its input.
    pub(crate) fn start_on(role: &str, input: OwnedFd) -> Self {
        Self::start_with(role, Stdio::from(input))
    }

    fn start_with(role: &str, input: Stdio) -> Self {
        let mut child =
            command(role).stdin(input).stdout(Stdio::piped()).spawn().expect("a process for the other end");
        let mut line = String::new();
        let output = child.stdout.take().expect("its output is a pipe");
        BufReader::new(output).read_line(&mut line).expect("the other end says that it is there");
        assert_eq!(line.trim(), THERE, "the process with the role `{role}` failed");
        Self(child)
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Tells the process that started this one that it can go on.
pub(crate) fn say_there() {
    println!("{THERE}");
}

/// Until the process that started this one closes the pipe, or ends this one.
pub(crate) fn await_end() {
    let _ = std::io::stdin().read(&mut [0]);
}
