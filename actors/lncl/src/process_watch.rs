//! The watch on the process behind a connection: a child that it forked may hold the socket open after its end.

use std::{
    future::pending,
    io,
    os::{
        fd::{AsFd, OwnedFd},
        unix::net::UnixStream,
    },
};

use rustix::{
    event::{PollFd, PollFlags, Timespec, poll},
    io::Errno,
    process::{Pid, PidfdFlags, pidfd_open},
};
use sinew_runtime::remedy::{Wanted, remedy};
use tokio::io::{Interest, unix::AsyncFd};

/// The process that has connected.
pub(crate) enum ProcessWatch {
    /// The process is watched through a descriptor that is readable once the process and all its threads have ended.
    Watched(AsyncFd<OwnedFd>),
    /// It has ended already.
    Over,
    /// It cannot be watched. Its socket signals its end, once no process holds the socket.
    Unknown,
}

impl ProcessWatch {
    /// Watches the process behind `socket`. Its number is `pid`, or 0 if it has none here, as in another PID namespace.
    /// Linux 6.5 and newer support both cases (SO_PEERPIDFD).
    ///
    /// # Errors
    /// The process cannot be watched: no descriptor is left, a sandbox forbids it, or the kernel is too old.
    pub(crate) fn behind(socket: impl AsFd, pid: i32) -> io::Result<Self> {
        let cause = match sinew_shm::peer_pidfd(socket) {
            Ok(pidfd) => return Self::watched(pidfd),
            Err(cause) => cause,
        };
        match fallback(Errno::from_io_error(&cause), pid, gives_pidfds_of_peers) {
            Fallback::ByPid => Self::of(pid),
            Fallback::Over => Ok(Self::Over),
            Fallback::Unwatched => Err(unwatched(&cause)),
        }
    }

    /// Watches the process `pid`, as the kernel reports it; 0 if it does not (a process of another namespace).
    ///
    /// The number may belong to another process by now, but only if the connected one is dead. Then the end of that
    /// other process, or of the socket, is noticed instead, and no living process is affected.
    ///
    /// # Errors
    /// The system does not allow the watch: no descriptor is left, or a sandbox forbids it.
    pub(crate) fn of(pid: i32) -> io::Result<Self> {
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

    /// Resolves when the process has ended; never, if that is unknown.
    pub(crate) async fn ended(&self) {
        match self {
            Self::Watched(pidfd) => {
                if pidfd.readable().await.is_err() {
                    // The reactor has ended, and with it all that it serves.
                    pending::<()>().await;
                }
            }
            Self::Over => {}
            Self::Unknown => pending().await,
        }
    }
}

/// Returns whether the process behind `socket` has ended, as far as the kernel reports it (Linux 6.5). Its number may
/// belong to another process then.
pub(crate) fn has_ended(socket: impl AsFd) -> bool {
    match sinew_shm::peer_pidfd(socket) {
        Ok(pidfd) => {
            let now = Timespec { tv_sec: 0, tv_nsec: 0 };
            poll(&mut [PollFd::new(&pidfd, PollFlags::IN)], Some(&now)) == Ok(1)
        }
        Err(cause) => fallback(Errno::from_io_error(&cause), 0, gives_pidfds_of_peers) == Fallback::Over,
    }
}

/// The fallback if the kernel gives no descriptor of the process behind a socket.
#[derive(Debug, PartialEq)]
enum Fallback {
    /// The process is watched by its number.
    ByPid,
    /// It has ended.
    Over,
    /// It cannot be watched.
    Unwatched,
}

/// Chooses the fallback. ESRCH means an ended process, and so does EINVAL on Linux 6.5 to 6.14. A sandbox or another
/// kernel may return EINVAL for any process. So EINVAL counts only if the kernel gives a descriptor of a living
/// process.
fn fallback(cause: Option<Errno>, pid: i32, gives_pidfds: impl FnOnce() -> bool) -> Fallback {
    if pid != 0 {
        return Fallback::ByPid;
    }
    match cause {
        Some(Errno::SRCH) => Fallback::Over,
        Some(Errno::INVAL) if gives_pidfds() => Fallback::Over,
        _ => Fallback::Unwatched,
    }
}

/// Returns whether the kernel gives a descriptor of this process, which lives.
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
    fn living_process_has_not_ended() {
        let (own, _other) = UnixStream::pair().unwrap();
        assert!(!has_ended(&own));
    }

    #[test]
    fn process_with_a_pid_is_watched_by_it() {
        for cause in [Errno::SRCH, Errno::INVAL, Errno::NOPROTOOPT, Errno::PERM, Errno::MFILE] {
            assert_eq!(fallback(Some(cause), 7, || true), Fallback::ByPid, "{cause}");
        }
    }

    #[test]
    fn process_without_a_pid_ends_by_the_kernels_report() {
        assert_eq!(fallback(Some(Errno::SRCH), 0, || false), Fallback::Over);
        assert_eq!(fallback(Some(Errno::INVAL), 0, || true), Fallback::Over);
        assert_eq!(fallback(Some(Errno::INVAL), 0, || false), Fallback::Unwatched);
        for cause in [Errno::NOPROTOOPT, Errno::OPNOTSUPP, Errno::NODATA, Errno::PERM, Errno::MFILE] {
            assert_eq!(fallback(Some(cause), 0, || true), Fallback::Unwatched, "{cause}");
        }
        assert_eq!(fallback(None, 0, || true), Fallback::Unwatched);
    }

    #[test]
    fn remedy_for_an_unwatchable_process_fits_the_cause() {
        let of = |errno: Errno| unwatched(&errno.into()).to_string();
        assert!(of(Errno::NOPROTOOPT).contains("Linux 6.5"));
        assert!(of(Errno::MFILE).contains("ulimit -n") && !of(Errno::MFILE).contains("6.5"));
    }
}
