//! The process before: the next one of an application is started when that has ended, and finds devices and ports free.

use std::{
    io,
    os::fd::OwnedFd,
    pin::pin,
    sync::{Arc, Mutex},
    time::Duration,
};

use tokio::{io::unix::AsyncFd, time::timeout};

use crate::stores::lock;

/// A process that was killed ends in less than a millisecond. One that takes longer than this is told of: it has much memory to give back,
/// or hangs in the kernel.
const SLOW: Duration = Duration::from_secs(1);

/// The last process that was started for an application, dead or not, as its descriptor.
#[derive(Debug, Default)]
pub(super) struct Predecessor(Mutex<Option<Arc<OwnedFd>>>);

impl Predecessor {
    /// This one was started last. Whoever gives up waiting for it leaves it to the next that waits.
    pub(super) fn set(&self, pidfd: Arc<OwnedFd>) {
        *lock(&self.0) = Some(pidfd);
    }

    /// Waits until it has ended, whoever reaps it. The application `app` that is to be started has no process meanwhile: its supervisor
    /// waits for it to become ready, and no longer.
    ///
    /// # Errors
    /// Nobody can say whether it has ended.
    pub(super) async fn has_ended(&self, app: &str) -> io::Result<()> {
        let Some(pidfd) = lock(&self.0).clone() else { return Ok(()) };
        #[expect(
            deprecated,
            reason = "sound for an OwnedFd, whose descriptor never changes; its successor is an unsafe fn, and unsafe code lives in sinew-shm and the C binding alone"
        )]
        let pidfd = AsyncFd::new(pidfd)?;
        // Readable from its end on.
        let mut ended = pin!(pidfd.readable());
        let seen = match timeout(SLOW, &mut ended).await {
            Ok(seen) => seen,
            Err(_) => {
                crate::log::warn!(
                    app,
                    "its former process was killed and has not ended: it hangs in the kernel, or has much memory to give back; the next one waits for that"
                );
                ended.await
            }
        };
        seen.map(|_| ())
    }
}

#[cfg(test)]
mod tests {
    use std::{future::Future, os::unix::process::CommandExt, process::Command, task};

    use rustix::process::{Pid, PidfdFlags, Signal, pidfd_open, pidfd_send_signal};

    use super::*;

    /// Whether this would wait.
    fn waits(wait: impl Future<Output = io::Result<()>>) -> bool {
        let wait = pin!(wait);
        wait.poll(&mut task::Context::from_waker(task::Waker::noop())).is_pending()
    }

    #[test]
    fn whoever_gives_up_waiting_leaves_the_process_to_the_next_one() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        let mut child = Command::new("sleep").arg("600").process_group(0).spawn().unwrap();
        let pidfd = pidfd_open(Pid::from_child(&child), PidfdFlags::empty()).unwrap();
        let pidfd = Arc::new(pidfd);
        let predecessor = Predecessor::default();
        runtime.block_on(async {
            assert!(!waits(predecessor.has_ended("first")), "there is none before it");
            predecessor.set(pidfd.clone());
            // Given up while it waits, as whoever is not ready in its time is
            assert!(waits(predecessor.has_ended("second")));
            assert!(waits(predecessor.has_ended("third")));
            pidfd_send_signal(&pidfd, Signal::KILL).unwrap();
            timeout(Duration::from_secs(60), predecessor.has_ended("fourth")).await.unwrap().unwrap();
        });
        child.wait().unwrap();
    }
}
