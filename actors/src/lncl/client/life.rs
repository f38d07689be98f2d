//! The life of the process behind a connection: a child that it forked may hold the socket open after its end.

use std::{
    future::pending,
    io,
    os::fd::{AsFd, OwnedFd},
};

use rustix::{
    io::Errno,
    process::{Pid, PidfdFlags, pidfd_open},
};
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
    /// Watches the process behind `socket`, whose number is `pid`; 0 where the kernel does not say it, as of a process in another PID
    /// namespace. Such a one can be watched since Linux 6.5 (SO_PEERPIDFD).
    ///
    /// # Errors
    /// It cannot be watched: there is no descriptor left, a sandbox forbids it, or the kernel is too old.
    pub(in crate::lncl) fn behind(socket: impl AsFd, pid: i32) -> io::Result<Self> {
        match sinew_shm::peer_pidfd(socket) {
            Ok(pidfd) => Self::watched(pidfd),
            // It has ended, and was reaped: SRCH since Linux 6.15, INVAL before.
            Err(cause) if matches!(Errno::from_io_error(&cause), Some(Errno::SRCH | Errno::INVAL)) => {
                Ok(Self::Over)
            }
            Err(cause) if pid == 0 => Err(io::Error::new(
                cause.kind(),
                format!(
                    "it is in another PID namespace, and the kernel gives no descriptor for it (SO_PEERPIDFD, since Linux 6.5): {cause}; its \
                     name is free when the last copy of its socket is closed"
                ),
            )),
            Err(_) => Self::of(pid),
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
