//! The former process of an application. The next one starts after its end, and finds devices and ports free.

use std::{
    io,
    os::fd::OwnedFd,
    pin::pin,
    sync::{Arc, Mutex},
    time::Duration,
};

use tokio::{io::unix::AsyncFd, time::timeout};

use sinew_runtime::lock;

/// Time after which a killed process that still runs is logged. Its end takes less than a millisecond; a slower one has
/// much memory to release, or hangs in the kernel.
const SLOW: Duration = Duration::from_secs(1);

/// The last process that was started for an application, dead or not, as its pidfd.
#[derive(Debug, Default)]
pub(super) struct Predecessor(Mutex<Option<Arc<OwnedFd>>>);

impl Predecessor {
    /// Stores the last started process. If a waiter gives up, the next one waits for the same process.
    pub(super) fn set(&self, pidfd: Arc<OwnedFd>) {
        *lock(&self.0) = Some(pidfd);
    }

    /// Waits until the process has ended, whichever thread reaps it. Meanwhile the application `app` has no process;
    /// its supervisor waits for it only until its start deadline.
    ///
    /// # Errors
    /// It is unknown whether the process has ended.
    pub(super) async fn has_ended(&self, app: &str) -> io::Result<()> {
        let Some(pidfd) = lock(&self.0).clone() else { return Ok(()) };
        #[expect(
            deprecated,
            reason = "sound for an OwnedFd, whose descriptor never changes; its successor is an unsafe fn, and unsafe code lives in sinew-shm and the C binding alone"
        )]
        let pidfd = AsyncFd::new(pidfd)?;
        // The descriptor is readable once the process has ended.
        let mut ended = pin!(pidfd.readable());
        let seen = match timeout(SLOW, &mut ended).await {
            Ok(seen) => seen,
            Err(_) => {
                sinew_runtime::log::warn!(
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
    fn abandoned_wait_leaves_process_to_next_waiter() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        let mut child = Command::new("sleep").arg("600").process_group(0).spawn().unwrap();
        let pidfd = pidfd_open(Pid::from_child(&child), PidfdFlags::empty()).unwrap();
        let pidfd = Arc::new(pidfd);
        let predecessor = Predecessor::default();
        runtime.block_on(async {
            assert!(!waits(predecessor.has_ended("first")), "there is none before it");
            predecessor.set(pidfd.clone());
            // Each of these waits is abandoned, as when a process is not ready in time
            assert!(waits(predecessor.has_ended("second")));
            assert!(waits(predecessor.has_ended("third")));
            pidfd_send_signal(&pidfd, Signal::KILL).unwrap();
            timeout(Duration::from_secs(60), predecessor.has_ended("fourth")).await.unwrap().unwrap();
        });
        child.wait().unwrap();
    }
}
