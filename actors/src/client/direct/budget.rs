//! How much memory the rings of direct links take in this process.

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

/// Bytes of rings for direct links that one process makes at most, all its endpoints together. What is above goes through
/// the node.
const PROCESS_BYTES_MAX: usize = 64 << 20;
/// Bytes beside each ring: its head and its bells.
const BESIDE: usize = 2 * 4_096;

/// That of this process.
pub(in crate::client) static PROCESS: Budget = Budget::new(PROCESS_BYTES_MAX);

/// Bytes that may be held, and are.
#[derive(Debug)]
pub(in crate::client) struct Budget {
    held: AtomicUsize,
    max: usize,
    has_said_so: AtomicBool,
}

/// What one ring takes; given back when it is dropped.
#[derive(Debug)]
pub(in crate::client) struct Share {
    budget: &'static Budget,
    bytes: usize,
}

impl Budget {
    pub(in crate::client) const fn new(max: usize) -> Self {
        Self { held: AtomicUsize::new(0), max, has_said_so: AtomicBool::new(false) }
    }

    /// Whether there is room for one more ring. If there is none, a line of the log says so once.
    pub(in crate::client) fn has_room(&self, ring_bytes: usize) -> bool {
        let has_room = self.held.load(Ordering::Relaxed) + ring_bytes + BESIDE <= self.max;
        if !has_room && !self.has_said_so.swap(true, Ordering::Relaxed) {
            let max = self.max;
            crate::log::here!(warn:
                max,
                "the rings of this process's direct links have their most in bytes; what else there is goes through the node"
            );
        }
        has_room
    }

    /// Takes room for one ring; `None` if there is none.
    pub(in crate::client) fn take(&'static self, ring_bytes: usize) -> Option<Share> {
        let bytes = ring_bytes + BESIDE;
        let with = |held: usize| (held + bytes <= self.max).then_some(held + bytes);
        let taken = self.held.fetch_update(Ordering::Relaxed, Ordering::Relaxed, with);
        taken.ok().map(|_| Share { budget: self, bytes })
    }

    #[cfg(test)]
    pub(in crate::client) fn held(&self) -> usize {
        self.held.load(Ordering::Relaxed)
    }
}

impl Drop for Share {
    fn drop(&mut self) {
        self.budget.held.fetch_sub(self.bytes, Ordering::Relaxed);
    }
}
