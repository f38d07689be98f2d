//! The role of this process: it is a node, or hosts one application of a node.

use std::{
    fs::File,
    os::{fd::AsFd, unix::net::UnixStream},
    sync::{Mutex, OnceLock},
};

use rustix::{
    event::{PollFd, PollFlags, poll},
    net::sockopt::socket_peercred,
    process::{Pid, Signal, getpid, getppid, kill_process, set_parent_process_death_signal},
};
use sinew_model::config::NodeConfig;
use sinew_runtime::{lock, tid::NodeAddress};

use super::protocol::VARIABLE;

/// The action of a node's builder in this process.
pub(crate) enum Role {
    /// Start the node.
    Node,
    /// Host one of its applications.
    Host(Hosting),
    /// No action: this process hosts an application of another node.
    OtherNode,
}

/// The application that this process hosts.
pub(crate) struct Hosting {
    pub(super) app: String,
    pub(super) socket: UnixStream,
}

struct Adopted {
    address: NodeAddress,
    node: String,
    app: String,
    socket: Mutex<Option<UnixStream>>,
}

/// Returns the action of the builder of the node with this configuration, in this process.
pub(crate) fn role(config: &NodeConfig) -> Role {
    static ADOPTED: OnceLock<Option<Adopted>> = OnceLock::new();
    let Some(adopted) = ADOPTED.get_or_init(adopt) else { return Role::Node };
    if adopted.address != config.node_address() || adopted.node != config.name {
        return Role::OtherNode;
    }
    match lock(&adopted.socket).take() {
        Some(socket) => Role::Host(Hosting { app: adopted.app.clone(), socket }),
        // A second builder of the same node.
        None => Role::OtherNode,
    }
}

/// Checks whether a node started this process to host an application, and binds its lifetime to the node's.
fn adopt() -> Option<Adopted> {
    let variable = std::env::var(VARIABLE).ok()?;
    let mut parts = variable.split('\n');
    let parent = parts.next()?.parse().ok().and_then(Pid::from_raw)?;
    let address = NodeAddress::new(parts.next()?.parse().ok()?);
    let (node, app) = (parts.next()?.to_owned(), parts.next()?.to_owned());
    let stdin = std::io::stdin();
    // A process that this one starts inherits the variable, but not the socket.
    if socket_peercred(&stdin).ok()?.pid != parent {
        return None;
    }
    let socket = UnixStream::from(stdin.as_fd().try_clone_to_owned().ok()?);
    // Prevents accidental reads of the node's frames, here and in processes that this one starts.
    File::open("/dev/null").ok().and_then(|nothing| rustix::stdio::dup2_stdin(&nothing).ok())?;
    die_with(parent, &socket);
    Some(Adopted { address, node, app, socket: Mutex::new(Some(socket)) })
}

/// Prevents an orphan. The kernel kills this process with its parent, and a thread kills it when the
/// connection to the node hangs up.
fn die_with(parent: Pid, socket: &UnixStream) {
    // The signal is bound to the thread that started this process, which lives as long as the node's process
    // (`spawn.rs`). The kernel drops the setting when the calling thread ends; the thread below stays.
    if let Err(error) = set_parent_process_death_signal(Some(Signal::KILL)) {
        sinew_runtime::log::warn!(%error, "the kernel does not bind this process to its node; its connection does");
    }
    if getppid() != Some(parent) {
        // The node died before that.
        die();
    }
    let Ok(socket) = socket.try_clone() else { die() };
    let watch = std::thread::Builder::new().name("hang-up".to_owned());
    let watch = watch.spawn(move || {
        loop {
            let mut watched = [PollFd::new(&socket, PollFlags::RDHUP)];
            if poll(&mut watched, None).is_ok() && !watched[0].revents().is_empty() {
                die();
            }
        }
    });
    if watch.is_err() {
        die();
    }
}

/// Ends this process at once, without running code of the application.
pub(super) fn die() -> ! {
    let _ = kill_process(getpid(), Signal::KILL);
    std::process::abort()
}
