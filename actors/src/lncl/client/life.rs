//! The life of the process behind a connection: a child that it forked may hold the socket open after its end.

use std::{
    future::pending,
    io,
    os::{
        fd::{AsFd, OwnedFd},
        unix::net::UnixStream,
    },
};

use rustix::{
    io::Errno,
    process::{Pid, PidfdFlags, pidfd_open},
};
use sinew_runtime::remedy::{Wanted, remedy};
use tokio::io::{Interest, unix::AsyncFd};

/// The process that has connected.
pub(in crate::lncl) enum Life {
    /// It is watched: a descriptor that is readable when the process has ended, with all its threads.
    Watched(AsyncFd<OwnedFd>),
    /// It has ended already.
    Over,
    /// It cannot be watched. Its socket tells its end, when nobody holds it any more.
    Unknown,
}

impl Life {
    /// Watches the process behind `socket`. Its number is `pid`, or 0 where it has none here, as in another PID namespace. Linux 6.5 and
    /// newer watch it in both cases (SO_PEERPIDFD).
    ///
    /// # Errors
    /// It cannot be watched: there is no descriptor left, a sandbox forbids it, or the kernel is too old.
    pub(in crate::lncl) fn behind(socket: impl AsFd, pid: i32) -> io::Result<Self> {
        let cause = match sinew_shm::peer_pidfd(socket) {
            Ok(pidfd) => return Self::watched(pidfd),
            Err(cause) => cause,
        };
        match instead(Errno::from_io_error(&cause), pid, gives_pidfds_of_peers) {
            Instead::ByNumber => Self::of(pid),
            Instead::Over => Ok(Self::Over),
            Instead::Unwatched => Err(unwatched(&cause)),
        }
    }

    /// Watches the process `pid`, as the kernel says who has connected; 0 where it does not (a process of another namespace).
    ///
    /// The number may belong to another process by now, but only if the one that has connected is dead. Then that
    /// other one's end, or the socket's, is noticed in its place, and nobody who lives loses anything by it.
    ///
    /// # Errors
    /// The system does not let it be watched: there is no descriptor left, or a sandbox forbids it.
    pub(in crate::lncl) fn of(pid: i32) -> io::Result<Self> {
        let Some(pid) = Pid::from_raw(pid) else { return Ok(Self::Unknown) };
        let pidfd = match pidfd_open(pid, PidfdFlags::empty()) {
            Ok(pidfd) => pidfd,
            Err(Errno::SRCH) => return Ok(Self::Over),
            Err(cause) => return Err(cause.into()),
        };
        Self::watched(pidfd)
    }

    fn watched(pidfd: OwnedFd) -> io::Result<Self> {
        #[expect(
            deprecated,
            reason = "sound for an OwnedFd, whose descriptor never changes; its successor is an unsafe fn, and unsafe code lives in sinew-shm and the C binding alone"
        )]
        AsyncFd::with_interest(pidfd, Interest::READABLE).map(Self::Watched)
    }

    /// Resolves when the process has ended; never, if that is not known.
    pub(in crate::lncl) async fn ended(&self) {
        match self {
            Self::Watched(pidfd) => {
                if pidfd.readable().await.is_err() {
                    // The reactor has ended, and all that it serves with it.
                    pending::<()>().await;
                }
            }
            Self::Over => {}
            Self::Unknown => pending().await,
        }
    }
}

/// What is done where the kernel gives no descriptor of the process behind a socket.
#[derive(Debug, PartialEq)]
enum Instead {
    /// It is watched by its number.
    ByNumber,
    /// It has ended.
    Over,
    /// Nothing can be done.
    Unwatched,
}

/// An ended process is ESRCH; EINVAL means the same on Linux 6.5 to 6.14. A sandbox or another kernel may give EINVAL for any process, so EINVAL
/// counts only where the kernel gives a descriptor of a process that lives.
fn instead(cause: Option<Errno>, pid: i32, gives_pidfds: impl FnOnce() -> bool) -> Instead {
    if pid != 0 {
        return Instead::ByNumber;
    }
    match cause {
        Some(Errno::SRCH) => Instead::Over,
        Some(Errno::INVAL) if gives_pidfds() => Instead::Over,
        _ => Instead::Unwatched,
    }
}

/// Whether the kernel gives a descriptor of this process, which lives.
fn gives_pidfds_of_peers() -> bool {
    UnixStream::pair().is_ok_and(|(own, _)| sinew_shm::peer_pidfd(&own).is_ok())
}

fn unwatched(cause: &io::Error) -> io::Error {
    let remedy = match Errno::from_io_error(cause) {
        Some(Errno::NOPROTOOPT | Errno::INVAL | Errno::OPNOTSUPP) => "Linux 6.5 or newer has it".into(),
        Some(_) | None => remedy(Wanted::Descriptor, cause),
    };
    let words = format!(
        "no descriptor of it (SO_PEERPIDFD): {cause}; {remedy}; until then its name is freed when the last copy of its socket is closed"
    );
    io::Error::new(cause.kind(), words)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_process_with_a_number_is_watched_by_it_whatever_the_socket_says() {
        for cause in [Errno::SRCH, Errno::INVAL, Errno::NOPROTOOPT, Errno::PERM, Errno::MFILE] {
            assert_eq!(instead(Some(cause), 7, || true), Instead::ByNumber, "{cause}");
        }
    }

    #[test]
    fn a_process_without_a_number_is_over_only_where_the_kernel_says_so() {
        assert_eq!(instead(Some(Errno::SRCH), 0, || false), Instead::Over);
        assert_eq!(instead(Some(Errno::INVAL), 0, || true), Instead::Over);
        assert_eq!(instead(Some(Errno::INVAL), 0, || false), Instead::Unwatched);
        for cause in [Errno::NOPROTOOPT, Errno::OPNOTSUPP, Errno::NODATA, Errno::PERM, Errno::MFILE] {
            assert_eq!(instead(Some(cause), 0, || true), Instead::Unwatched, "{cause}");
        }
        assert_eq!(instead(None, 0, || true), Instead::Unwatched);
    }

    #[test]
    fn the_remedy_of_a_process_that_cannot_be_watched_fits_the_cause() {
        let of = |errno: Errno| unwatched(&errno.into()).to_string();
        assert!(of(Errno::NOPROTOOPT).contains("Linux 6.5"));
        assert!(of(Errno::MFILE).contains("ulimit -n") && !of(Errno::MFILE).contains("6.5"));
    }
}
