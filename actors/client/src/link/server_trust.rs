//! Which listening processes are trusted as a node. At a path that the caller has named, any process; at a
//! path found by search, only a process of the own user or of root.

use std::{io, os::unix::net::UnixStream};

use tokio::{net, runtime::Builder};

use sinew_protocol::user_namespace::unmapped_user;

/// The owner that the process listening at the socket must have.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) enum ServerTrust {
    /// Any owner: the caller has named the socket, and thereby the process to trust.
    #[default]
    AnyUser,
    /// This process's user, or root: the socket was found where other users may create theirs, as in `/tmp`.
    SameUserOrRoot,
}

/// The listening process belongs to an untrusted user.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "the process that listens there runs as user {theirs}, which is neither this process's user ({own}) nor root for certain"
)]
pub(crate) struct UntrustedServerError {
    pub(crate) theirs: u32,
    pub(crate) own: u32,
}

impl ServerTrust {
    /// Checks which process listens at the other end of a connection on which nothing was sent yet.
    pub(super) fn check(self, socket: &UnixStream) -> io::Result<()> {
        match self {
            Self::AnyUser => Ok(()),
            Self::SameUserOrRoot => {
                let (theirs, own) = (uid_of(socket)?, rustix::process::geteuid().as_raw());
                let is_one_user = unmapped_user() != Some(theirs);
                check_owner(theirs, own, is_one_user).map_err(io::Error::other)
            }
        }
    }
}

/// `is_one_user`: whether the number `theirs` stands for one user, and not for all that the user namespace
/// does not map.
const fn check_owner(theirs: u32, own: u32, is_one_user: bool) -> Result<(), UntrustedServerError> {
    if is_one_user && (theirs == own || theirs == 0) {
        Ok(())
    } else {
        Err(UntrustedServerError { theirs, own })
    }
}

/// Returns the user that called `listen` at the other end, as reported by the kernel (SO_PEERCRED).
fn uid_of(socket: &UnixStream) -> io::Result<u32> {
    // Uses Tokio's reader, as the node's end does, although that needs a reactor. The one of rustix requires
    // a nonzero process number, which a process of another pid namespace does not have.
    let runtime = Builder::new_current_thread().enable_io().build()?;
    let read = || -> io::Result<u32> {
        let _inside = runtime.enter();
        net::UnixStream::from_std(socket.try_clone()?)?.peer_cred().map(|credentials| credentials.uid())
    };
    let uid = read();
    // Not dropped directly: the caller may be a thread of another runtime and must not block.
    runtime.shutdown_background();
    uid
}

#[cfg(test)]
mod tests {
    use std::{os::unix::net::UnixListener, time::Duration};

    use rustix::process::{Uid, geteuid};
    use socket2::{Domain, SockAddr, Socket, Type};

    use super::*;
    use crate::{ApiError, NodeApi, Registration};
    use sinew_lncl::testing::{TestDirectory, TestNode, WATCHDOG};

    /// A user that is neither root nor this one; no account needs to have it.
    const OTHER_USER: u32 = 54_321;

    #[test]
    fn only_own_user_and_root_are_trusted() {
        assert!(
            check_owner(1000, 1000, true).is_ok()
                && check_owner(0, 1000, true).is_ok()
                && check_owner(0, 0, true).is_ok()
        );
        assert_eq!(check_owner(1001, 1000, true), Err(UntrustedServerError { theirs: 1001, own: 1000 }));
        assert!(check_owner(1000, 0, true).is_err(), "root trusts no other user");
        assert!(check_owner(65_534, 65_534, false).is_err(), "the number stands for many users");
    }

    #[test]
    fn found_node_of_own_user_accepts_thread_and_task() {
        let node = TestNode::start();
        let api = NodeApi::connect_trusted(node.path(), WATCHDOG).expect("it is ours");
        let thread = api.register_transport_address(Registration::new().deadline(WATCHDOG));
        let runtime = Builder::new_current_thread().enable_all().build().expect("a runtime");
        let task = runtime.block_on(async {
            // Also where a call that blocks is made by a task.
            let again = NodeApi::connect_trusted(node.path(), WATCHDOG)?;
            again.register_transport_address_async(Registration::new().deadline(WATCHDOG)).await
        });
        let (thread, task) = (thread.expect("it is let in"), task.expect("it is let in"));
        assert_ne!(thread.tid(), task.tid());
    }

    #[test]
    fn found_socket_of_another_user_is_not_trusted() {
        if !geteuid().is_root() {
            println!("skipped: only root can listen as another user");
            return;
        }
        // Given: a file of this user at which another user listens
        let directory = TestDirectory::new();
        let path = directory.path().join("node.sock");
        let socket = Socket::new(Domain::UNIX, Type::STREAM, None).unwrap();
        socket.bind(&SockAddr::unix(&path).unwrap()).unwrap();
        let listens = || {
            // Only this one thread changes its user.
            rustix::thread::set_thread_uid(Uid::from_raw(OTHER_USER)).expect("root may");
            socket.listen(8).unwrap();
        };
        std::thread::scope(|scope| scope.spawn(listens).join().expect("no panic"));
        let is_untrusted = |error: &ApiError| {
            let text = error.to_string();
            text.contains("54321") && text.contains("NodeApi::connect")
        };
        // When: it was found. Then:
        let error = NodeApi::connect_trusted(&path, WATCHDOG).unwrap_err();
        assert!(is_untrusted(&error), "{error}");
        // When: the socket changed its owner after it was found. Then:
        let found = NodeApi { path: path.clone(), server_trust: ServerTrust::SameUserOrRoot };
        let error = found.register_transport_address(Registration::new().deadline(WATCHDOG)).unwrap_err();
        assert!(is_untrusted(&error), "{error}");
        // When: the path is explicit. Then: the API connects, and gets no answer.
        let named = NodeApi::connect(&path).expect("it listens");
        let short = Registration::new().deadline(Duration::from_millis(50));
        let error = named.register_transport_address(short).unwrap_err();
        assert!(matches!(error, ApiError::NoAnswer(_)), "{error}");
    }

    #[test]
    fn found_socket_without_listener_reports_system_error() {
        let directory = TestDirectory::new();
        let path = directory.path().join("node.sock");
        drop(UnixListener::bind(&path).unwrap());
        let error = NodeApi::connect_trusted(&path, WATCHDOG).unwrap_err();
        let is_refused = |cause: &io::Error| cause.kind() == io::ErrorKind::ConnectionRefused;
        assert!(matches!(&error, ApiError::NoNode { cause, .. } if is_refused(cause)), "{error}");
    }
}
