//! Who is taken for a node: whoever listens at a path that the caller has named; of those that were found only a process of one's own user,
//! or of root.

use std::{io, os::unix::net::UnixStream};

use tokio::{net, runtime::Builder};

/// Whose process may listen where an endpoint connects.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(in crate::client) enum Believed {
    /// Anybody's: who has named the socket has said so whom it believes.
    #[default]
    Anybody,
    /// One of this process's user, or of root: the socket was found where others may put theirs, as in `/tmp`.
    OwnUser,
}

/// The process that listens is of a user that is not believed here.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("who listens there is a process of uid {theirs}, neither of one's own, {own}, nor of root")]
pub(in crate::client) struct NotBelieved {
    pub(in crate::client) theirs: u32,
    pub(in crate::client) own: u32,
}

impl Believed {
    /// Looks who listens at the other end of a connection, on which nothing was said yet.
    pub(super) fn check(self, socket: &UnixStream) -> io::Result<()> {
        match self {
            Self::Anybody => Ok(()),
            Self::OwnUser => {
                believe(uid_of(socket)?, rustix::process::geteuid().as_raw()).map_err(io::Error::other)
            }
        }
    }
}

const fn believe(theirs: u32, own: u32) -> Result<(), NotBelieved> {
    if theirs == own || theirs == 0 { Ok(()) } else { Err(NotBelieved { theirs, own }) }
}

/// The user that has called `listen` at the other end, as the kernel says (SO_PEERCRED).
fn uid_of(socket: &UnixStream) -> io::Result<u32> {
    // Tokio's own reading of it, as at the node's end, though that wants a reactor: what rustix has takes it that the process has a number
    // other than 0, and one of another pid namespace has not.
    let runtime = Builder::new_current_thread().enable_io().build()?;
    let read = || -> io::Result<u32> {
        let _inside = runtime.enter();
        net::UnixStream::from_std(socket.try_clone()?)?.peer_cred().map(|credentials| credentials.uid())
    };
    let uid = read();
    // Not dropped as it is: a thread of another runtime may be the caller, and must not wait.
    runtime.shutdown_background();
    uid
}

#[cfg(test)]
mod tests {
    use std::{os::unix::net::UnixListener, time::Duration};

    use rustix::process::{Uid, geteuid};
    use socket2::{Domain, SockAddr, Socket, Type};

    use super::*;
    use crate::{
        client::{ApiError, NodeApi, Registration},
        lncl::testing::{TestDirectory, TestNode, WATCHDOG},
    };

    /// A user that is neither root nor this one; no account needs to have it.
    const STRANGER: u32 = 54_321;

    #[test]
    fn ones_own_user_and_root_are_believed_and_nobody_else() {
        assert!(believe(1000, 1000).is_ok() && believe(0, 1000).is_ok() && believe(0, 0).is_ok());
        assert_eq!(believe(1001, 1000), Err(NotBelieved { theirs: 1001, own: 1000 }));
        assert!(believe(1000, 0).is_err(), "root believes no other user");
    }

    #[test]
    fn a_node_of_ones_own_that_was_found_is_entered_from_a_thread_and_from_a_task() {
        let node = TestNode::start();
        let api = NodeApi::connect_found(node.path(), WATCHDOG).expect("it is ours");
        let thread = api.register_transport_address(Registration::new().deadline(WATCHDOG));
        let runtime = Builder::new_current_thread().enable_all().build().expect("a runtime");
        let task = runtime.block_on(async {
            // Also where a call that blocks is made by a task.
            let again = NodeApi::connect_found(node.path(), WATCHDOG)?;
            again.register_transport_address_async(Registration::new().deadline(WATCHDOG)).await
        });
        let (thread, task) = (thread.expect("it is let in"), task.expect("it is let in"));
        assert_ne!(thread.tid(), task.tid());
    }

    #[test]
    fn a_socket_that_was_found_is_not_believed_where_another_user_listens() {
        if !geteuid().is_root() {
            println!("skipped: only root can listen as another user");
            return;
        }
        // Given: a file of one's own at which somebody else listens
        let directory = TestDirectory::new();
        let path = directory.path().join("node.sock");
        let socket = Socket::new(Domain::UNIX, Type::STREAM, None).unwrap();
        socket.bind(&SockAddr::unix(&path).unwrap()).unwrap();
        let listens = || {
            // Only this one thread becomes somebody else.
            rustix::thread::set_thread_uid(Uid::from_raw(STRANGER)).expect("root may");
            socket.listen(8).unwrap();
        };
        std::thread::scope(|scope| scope.spawn(listens).join().expect("no panic"));
        let is_not_believed = |error: &ApiError| {
            let words = error.to_string();
            words.contains("54321") && words.contains("NodeApi::connect")
        };
        // When: it was found. Then:
        let error = NodeApi::connect_found(&path, WATCHDOG).unwrap_err();
        assert!(is_not_believed(&error), "{error}");
        // When: it was another one's when it was found. Then:
        let found = NodeApi { path: path.clone(), believed: Believed::OwnUser };
        let error = found.register_transport_address(Registration::new().deadline(WATCHDOG)).unwrap_err();
        assert!(is_not_believed(&error), "{error}");
        // When: it is named. Then: it is asked, and says nothing.
        let named = NodeApi::connect(&path).expect("it listens");
        let short = Registration::new().deadline(Duration::from_millis(50));
        let error = named.register_transport_address(short).unwrap_err();
        assert!(matches!(error, ApiError::NoAnswer(_)), "{error}");
    }

    #[test]
    fn what_was_found_and_listens_no_more_is_told_as_the_system_says_it() {
        let directory = TestDirectory::new();
        let path = directory.path().join("node.sock");
        drop(UnixListener::bind(&path).unwrap());
        let error = NodeApi::connect_found(&path, WATCHDOG).unwrap_err();
        let is_refused = |cause: &io::Error| cause.kind() == io::ErrorKind::ConnectionRefused;
        assert!(matches!(&error, ApiError::NoNode { cause, .. } if is_refused(cause)), "{error}");
    }
}
