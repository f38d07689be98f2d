//! Becomes the program of a command: the program replaces this process.

use std::{
    io::Write as _,
    os::unix::{net::UnixStream, process::CommandExt},
    process::Command,
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
    if has_hung_up(socket) {
        // The node died before that.
        die();
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

/// Returns whether the node's end of the socket is closed.
fn has_hung_up(socket: &UnixStream) -> bool {
    let now = Timespec { tv_sec: 0, tv_nsec: 0 };
    poll(&mut [PollFd::new(socket, PollFlags::RDHUP)], Some(&now)) == Ok(1)
}
