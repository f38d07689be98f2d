//! The memory that the rings of direct links take in this process.

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

/// Maximum bytes of rings for direct links per process, all endpoints together. Messages beyond this limit go
/// through the node.
const PROCESS_BYTES_MAX: usize = 64 << 20;
/// Bytes in addition to each ring: its header and its wake-up descriptors.
const OVERHEAD: usize = 2 * 4_096;

/// The budget of this process.
pub(crate) static PROCESS: Budget = Budget::new(PROCESS_BYTES_MAX);

/// The maximum number of bytes, and the bytes in use.
#[derive(Debug)]
pub(crate) struct Budget {
    held: AtomicUsize,
    max: usize,
    is_logged: AtomicBool,
}

/// The share of one ring; returned to the budget on drop.
#[derive(Debug)]
pub(crate) struct Share {
    budget: &'static Budget,
    bytes: usize,
}

impl Budget {
    pub(crate) const fn new(max: usize) -> Self {
        Self { held: AtomicUsize::new(0), max, is_logged: AtomicBool::new(false) }
    }

    /// Returns whether there is room for one more ring. If there is none, logs this once.
    pub(crate) fn has_room(&self, ring_bytes: usize) -> bool {
        let has_room = self.held.load(Ordering::Relaxed) + ring_bytes + OVERHEAD <= self.max;
        if !has_room && !self.is_logged.swap(true, Ordering::Relaxed) {
            let max = self.max;
            sinew_runtime::log::here!(warn:
                max,
                "the rings of this process's direct links have their most in bytes; what else there is goes through the node"
            );
        }
        has_room
    }

    /// Takes the share of one ring, or returns `None` if there is no room.
    pub(crate) fn take(&'static self, ring_bytes: usize) -> Option<Share> {
        let bytes = ring_bytes + OVERHEAD;
        let with = |held: usize| (held + bytes <= self.max).then_some(held + bytes);
        let taken = self.held.fetch_update(Ordering::Relaxed, Ordering::Relaxed, with);
        taken.ok().map(|_| Share { budget: self, bytes })
    }

    #[cfg(test)]
    pub(crate) fn held(&self) -> usize {
        self.held.load(Ordering::Relaxed)
    }
}

impl Drop for Share {
    fn drop(&mut self) {
        self.budget.held.fetch_sub(self.bytes, Ordering::Relaxed);
    }
}
