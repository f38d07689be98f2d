//! Becomes the program of a command: the program replaces this process.

use std::{
    io::{self, Read as _, Write as _},
    os::unix::{net::UnixStream, process::CommandExt},
    process::Command,
    time::Duration,
};

use rustix::{
    event::{PollFd, PollFlags, Timespec, poll},
    process::{Signal, set_parent_process_death_signal, setsid},
};
use sinew_model::config::NodeConfig;
use sinew_runtime::app::CommandLine;

use super::{protocol::VARIABLE, role::die};

/// The environment variables of a command: the path of the node's socket, and the name that it registers.
const SOCKET: &str = "SINEW_SOCKET";
const NAME: &str = "SINEW_NAME";
/// The exit code of a program that could not be executed, as of a shell.
const EXIT_CODE: i32 = 127;
/// Deadline of the node's permission to begin.
const PERMISSION_TIMEOUT: Duration = Duration::from_secs(10);

/// Becomes the program of the command `app`. If that fails, writes the reason to the node, and ends this process.
pub(super) fn become_program(
    config: &NodeConfig,
    app: &str,
    line: &CommandLine,
    mut socket: UnixStream,
) -> ! {
    let why = execute(config, app, line, &socket);
    // An error means that the node is gone.
    let _ = socket.write_all(why.as_bytes());
    std::process::exit(EXIT_CODE)
}

/// Executes the program. Returns only if that fails, with the cause and the remedy. The kernel closes `socket` at the
/// execution, which shows the node that it has succeeded.
fn execute(config: &NodeConfig, app: &str, line: &CommandLine, socket: &UnixStream) -> String {
    // A process outside of a session cannot join its process groups. So nobody else gets the name of the command.
    if let Err(cause) = setsid() {
        return format!(
            "it cannot begin a session of its own: {cause}; start the node before this program changes its process group"
        );
    }
    // Of this thread, which the program replaces. The setting outlives the execution.
    if let Err(cause) = set_parent_process_death_signal(Some(Signal::KILL)) {
        return format!(
            "the kernel does not bind it to its node (prctl): {cause}; use a seccomp profile that allows this call"
        );
    }
    match wait_until_allowed(socket, PERMISSION_TIMEOUT) {
        Ok(()) if !has_hung_up(socket) => {}
        Err(cause) if cause.kind() != io::ErrorKind::UnexpectedEof => {
            return format!(
                "its node has not let it begin within {PERMISSION_TIMEOUT:?}: {cause}; find what holds up the node"
            );
        }
        // The node died before that.
        Ok(()) | Err(_) => die(),
    }
    let (Some(path), [program, arguments @ ..]) = (&config.lncl.socket, &line.words[..]) else {
        return "there is no socket at which it could join; set `lncl.socket`".to_owned();
    };
    let mut command = Command::new(program);
    command.args(arguments).env_remove(VARIABLE).env(NAME, app);
    // The program may have another working directory.
    command.env(SOCKET, std::path::absolute(path).unwrap_or_else(|_| path.clone()));
    if let Some(folder) = &line.folder {
        command.current_dir(folder);
    }
    let cause = command.exec();
    let folder = line.folder.as_ref().map_or_else(String::new, |folder| format!(" in {}", folder.display()));
    format!("'{program}'{folder} cannot be executed: {cause}; write its path, or add its folder to PATH")
}

/// Waits for the byte by which the node lets the program begin: its group may register the name by then.
fn wait_until_allowed(mut socket: &UnixStream, within: Duration) -> io::Result<()> {
    socket.set_read_timeout(Some(within))?;
    socket.read_exact(&mut [0])
}

/// Returns whether the node's end of the socket is closed.
fn has_hung_up(socket: &UnixStream) -> bool {
    let now = Timespec { tv_sec: 0, tv_nsec: 0 };
    poll(&mut [PollFd::new(socket, PollFlags::RDHUP)], Some(&now)) == Ok(1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn program_begins_only_when_its_node_allows_it() {
        let (mut node, socket) = UnixStream::pair().expect("a pair");
        let wait = |within| wait_until_allowed(&socket, within).map_err(|cause| cause.kind());
        assert_eq!(wait(Duration::from_millis(1)), Err(io::ErrorKind::WouldBlock));
        node.write_all(&[0]).expect("it has room");
        assert_eq!(wait(PERMISSION_TIMEOUT), Ok(()));
        drop(node);
        assert_eq!(wait(PERMISSION_TIMEOUT), Err(io::ErrorKind::UnexpectedEof));
    }
}
