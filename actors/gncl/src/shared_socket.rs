//! Sockets that stay open while this layer is restarted. Each instance waits for them with the existing
//! descriptors, so a start does not fail when no descriptor is free.

use std::{
    io,
    os::fd::{AsFd, AsRawFd, OwnedFd},
    sync::Arc,
    task::{Context, Poll, ready},
};

use tokio::io::{Interest, unix::AsyncFd};

/// A shared socket, with only one reader.
pub(super) struct SharedSocket<S: AsRawFd>(AsyncFd<Arc<S>>);

impl<S: AsRawFd + AsFd + From<OwnedFd>> SharedSocket<S> {
    /// Registers `socket`, which does not block, with the calling thread's reactor.
    ///
    /// # Errors
    /// The reactor does not accept it.
    pub(super) fn register(socket: &Arc<S>) -> io::Result<Self> {
        let watched = watch(socket.clone()).or_else(|_| {
            // A former instance on this thread has not released it yet, so a duplicate descriptor is used.
            watch(Arc::new(socket.as_fd().try_clone_to_owned()?.into()))
        });
        watched.map(Self)
    }

    pub(super) fn socket(&self) -> &S {
        self.0.get_ref()
    }

    /// Runs `step` when the socket is readable.
    pub(super) fn poll<T>(
        &self,
        cx: &mut Context<'_>,
        mut step: impl FnMut(&S) -> io::Result<T>,
    ) -> Poll<io::Result<T>> {
        loop {
            drop(ready!(self.0.poll_read_ready(cx))?);
            match self.try_io(&mut step) {
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
                result => return Poll::Ready(result),
            }
        }
    }

    /// Waits until the socket may be readable.
    pub(super) async fn readable(&self) -> io::Result<()> {
        self.0.readable().await.map(drop)
    }

    /// Runs `step`. If it would block, [`readable`](Self::readable) waits from now on.
    pub(super) fn try_io<T>(&self, mut step: impl FnMut(&S) -> io::Result<T>) -> io::Result<T> {
        self.0.try_io(Interest::READABLE, |socket| step(socket))
    }
}

#[expect(
    deprecated,
    reason = "sound for a socket of the standard library, which keeps its descriptor; its successor is an unsafe fn, and unsafe code lives in sinew-shm and the C binding alone"
)]
fn watch<S: AsRawFd>(socket: Arc<S>) -> io::Result<AsyncFd<Arc<S>>> {
    AsyncFd::with_interest(socket, Interest::READABLE)
}
