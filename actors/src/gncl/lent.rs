//! Sockets that stay open while this layer is restarted, as one life of it waits for them: with the descriptors that there are. A life that
//! begins while none is left must not fail for want of another.

use std::{
    io,
    os::fd::{AsFd, AsRawFd, OwnedFd},
    sync::Arc,
    task::{Context, Poll, ready},
};

use tokio::io::{Interest, unix::AsyncFd};

/// Such a socket, which is read alone.
pub(super) struct Lent<S: AsRawFd>(AsyncFd<Arc<S>>);

impl<S: AsRawFd + AsFd + From<OwnedFd>> Lent<S> {
    /// `socket`, which does not block, on the calling thread's reactor.
    ///
    /// # Errors
    /// The reactor does not take it.
    pub(super) fn of(socket: &Arc<S>) -> io::Result<Self> {
        let watched = watch(socket.clone()).or_else(|_| {
            // A former life on this thread has not given it back: by a descriptor of its own then.
            watch(Arc::new(socket.as_fd().try_clone_to_owned()?.into()))
        });
        watched.map(Self)
    }

    pub(super) fn socket(&self) -> &S {
        self.0.get_ref()
    }

    /// Takes `step` when something has come.
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

    /// Waits until something may have come.
    pub(super) async fn readable(&self) -> io::Result<()> {
        self.0.readable().await.map(drop)
    }

    /// Takes `step`; where it would block, [`readable`](Self::readable) waits from now on.
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
