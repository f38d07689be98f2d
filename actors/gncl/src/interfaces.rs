//! Lost addresses of this host, because their interface went down or they were removed.
//!
//! A connection does not detect this by itself: its writes wait for the interface to return.

use std::{fmt, io, net::SocketAddr};

use futures_util::{Stream, stream};
use sinew_net::InterfaceMonitor;
use tokio::io::unix::AsyncFd;

/// An address that its bound sockets cannot use any more.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct AddressLost(pub(super) SocketAddr);

impl fmt::Display for AddressLost {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.ip().fmt(f)
    }
}

/// Returns a stream of the addresses that are lost from now on.
///
/// # Errors
/// The kernel sends no reports to this process; then losses are detected by missing answers.
pub(super) fn lost() -> io::Result<impl Stream<Item = AddressLost>> {
    Ok(stream::unfold((subscribe()?, Vec::new()), async |(mut monitor, mut lost)| {
        while lost.is_empty() {
            lost = next_lost(&mut monitor)
                .await
                .inspect_err(|error| {
                    sinew_runtime::log::warn!(%error, "the kernel does not say any more which interfaces go down");
                })
                .ok()?;
        }
        lost.pop().map(|address| (AddressLost(address), (monitor, lost)))
    }))
}

fn subscribe() -> io::Result<AsyncFd<InterfaceMonitor>> {
    let mut monitor = InterfaceMonitor::subscribe()?;
    monitor.request_addresses()?;
    #[expect(
        deprecated,
        reason = "sound for a monitor, which keeps its descriptor; its successor is an unsafe fn, and unsafe code lives in sinew-shm and the C binding alone"
    )]
    AsyncFd::new(monitor)
}

/// Waits for the kernel's next messages. Returns the lost addresses.
async fn next_lost(monitor: &mut AsyncFd<InterfaceMonitor>) -> io::Result<Vec<SocketAddr>> {
    loop {
        let mut ready = monitor.readable_mut().await?;
        if let Ok(lost) = ready.try_io(|monitor| monitor.get_mut().receive_lost()) {
            return lost;
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[tokio::test(flavor = "current_thread")]
    async fn answer_of_the_kernel_wakes_the_reader() {
        let mut monitor = subscribe().expect("any process may listen");
        let answer = tokio::time::timeout(Duration::from_secs(10), next_lost(&mut monitor)).await;
        answer.expect("the kernel answers within 10 s").expect("the socket is good");
    }
}
