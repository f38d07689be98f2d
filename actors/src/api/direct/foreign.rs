//! What a peer has passed that is none of what was to come. To close it may take as long as its sender likes, so no thread of the
//! application's does.

use std::{
    io,
    os::{
        fd::{AsFd, OwnedFd},
        unix::net::UnixStream,
    },
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicUsize, Ordering},
    },
    thread,
};

use sinew_shm::Received;

/// Threads at most that close such things at once. What comes while all are at it stays open until the process ends.
const CLOSING_MAX: usize = 16;
static CLOSING: AtomicUsize = AtomicUsize::new(0);

/// Further copies of what a peer has passed, and of the socket over which it did. While they live nothing that becomes of the others is the
/// last close, the only one that can block.
pub(super) struct Foreign(Vec<OwnedFd>);

impl Foreign {
    pub(super) fn of(received: &Received, socket: &Arc<UnixStream>) -> io::Result<Self> {
        let mut copies = received.copies()?;
        copies.push(socket.as_fd().try_clone_to_owned()?);
        Ok(Self(copies))
    }

    /// All is what was to come, and in use: to close a copy of it waits for nobody.
    pub(super) fn are_good(mut self) {
        self.0.clear();
    }
}

impl Drop for Foreign {
    fn drop(&mut self) {
        if !self.0.is_empty() {
            close(std::mem::take(&mut self.0));
        }
    }
}

fn close(foreign: Vec<OwnedFd>) {
    // Not in the thread's closure alone: where there is no thread that is dropped here.
    let held = Arc::new(Mutex::new(foreign));
    let its = held.clone();
    let is_room = CLOSING.fetch_add(1, Ordering::Relaxed) < CLOSING_MAX;
    let closing = is_room.then(|| {
        thread::Builder::new().name("sinew-closing".to_owned()).spawn(move || {
            let foreign = std::mem::take(&mut *its.lock().unwrap_or_else(PoisonError::into_inner));
            drop(foreign);
            CLOSING.fetch_sub(1, Ordering::Relaxed);
        })
    });
    if !matches!(closing, Some(Ok(_))) {
        CLOSING.fetch_sub(1, Ordering::Relaxed);
        tracing::error!(
            "a peer has passed descriptors that were not asked for; they stay open until this process ends"
        );
        std::mem::forget(held);
    }
}
