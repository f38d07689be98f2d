//! Whether this process is a node's, or hosts one application of one.

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
use sinew_runtime::tid::NodeAddress;

use super::words::VARIABLE;
use crate::{config::NodeConfig, stores::lock};

/// What the builder of a node does in this process.
pub(crate) enum Role {
    /// Start the node.
    Node,
    /// Host one of its applications.
    Host(Hosting),
    /// Nothing: this process hosts an application of another node.
    Bystander,
}

/// What this process is to host.
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

/// What the builder of the node with this configuration does in this process.
pub(crate) fn role(config: &NodeConfig) -> Role {
    static ADOPTED: OnceLock<Option<Adopted>> = OnceLock::new();
    let Some(adopted) = ADOPTED.get_or_init(adopt) else { return Role::Node };
    if adopted.address != config.node_address() || adopted.node != config.name {
        return Role::Bystander;
    }
    match lock(&adopted.socket).take() {
        Some(socket) => Role::Host(Hosting { app: adopted.app.clone(), socket }),
        // A second builder of the same node.
        None => Role::Bystander,
    }
}

/// Looks whether a node started this process to host an application, and binds its life to the node's.
fn adopt() -> Option<Adopted> {
    let variable = std::env::var(VARIABLE).ok()?;
    let mut parts = variable.split('\n');
    let parent = parts.next()?.parse().ok().and_then(Pid::from_raw)?;
    let address = NodeAddress::new(parts.next()?.parse().ok()?);
    let (node, app) = (parts.next()?.to_owned(), parts.next()?.to_owned());
    let stdin = std::io::stdin();
    // A process that this one starts has the variable too, but not the socket.
    if socket_peercred(&stdin).ok()?.pid != parent {
        return None;
    }
    let socket = UnixStream::from(stdin.as_fd().try_clone_to_owned().ok()?);
    // Nobody reads the node's words by mistake, here or in a process that this one starts.
    File::open("/dev/null").ok().and_then(|nothing| rustix::stdio::dup2_stdin(&nothing).ok())?;
    die_with(parent, &socket);
    Some(Adopted { address, node, app, socket: Mutex::new(Some(socket)) })
}

/// Never an orphan: the kernel kills this process with its parent, and so does a thread of its own when the connection to
/// the node hangs up.
fn die_with(parent: Pid, socket: &UnixStream) {
    // Tells of the thread that started this process, which lives as long as the node's process
    // (`spawn.rs`). It is forgotten when the calling thread ends; the thread below is not.
    if let Err(error) = set_parent_process_death_signal(Some(Signal::KILL)) {
        crate::log::warn!(%error, "the kernel does not bind this process to its node; its connection does");
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

/// Ends this process at once, running no code of the application's.
pub(super) fn die() -> ! {
    let _ = kill_process(getpid(), Signal::KILL);
    std::process::abort()
}
