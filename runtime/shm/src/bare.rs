//! The reference of the benches: a ring without checks, loans, deadlines or sleeping flags. Four slots in
//! each direction, a count for each, a futex wake for every message or none at all. The omitted features are
//! the ones that the comparison measures; both ends trust each other.

use std::{
    os::fd::{AsFd, OwnedFd},
    sync::atomic::{AtomicU32, Ordering},
};

use memmap2::{MmapOptions, MmapRaw};
use rustix::{
    fs::{MemfdFlags, ftruncate, memfd_create},
    thread::futex::{self, Flags},
};

const SLOTS: usize = 4;
const COUNT_BYTES: usize = 128;

/// How an end waits for a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Waiting {
    /// Sleeps on a futex, which is woken for every message.
    Futex,
    /// Polls; needs no wake.
    Poll,
}

/// Creates memory for both directions, with messages of `bytes` bytes, for two processes: one creates it, the
/// other inherits it.
///
/// # Panics
/// If the system provides no memory.
#[must_use]
pub fn memory(bytes: usize) -> OwnedFd {
    let memory = memfd_create("bare-ring", MemfdFlags::empty()).expect("a memfd");
    ftruncate(&memory, 2 * (COUNT_BYTES + SLOTS * bytes) as u64).expect("a size");
    memory
}

/// One end. A message may be sent only while fewer than four are in flight: round trips keep to this by
/// themselves.
#[derive(Debug)]
pub struct End {
    map: MmapRaw,
    bytes: usize,
    waiting: Waiting,
    /// Messages sent and received so far.
    sent: u32,
    received: u32,
    /// The direction that this end writes.
    outward: usize,
}

impl End {
    /// Creates the end of the process that created the memory.
    #[must_use]
    pub fn first(memory: impl AsFd, bytes: usize, waiting: Waiting) -> Self {
        Self::new(memory, bytes, waiting, 0)
    }

    /// Creates the end of the other process.
    #[must_use]
    pub fn second(memory: impl AsFd, bytes: usize, waiting: Waiting) -> Self {
        Self::new(memory, bytes, waiting, 1)
    }

    fn new(memory: impl AsFd, bytes: usize, waiting: Waiting, outward: usize) -> Self {
        let map = MmapOptions::new().populate().map_raw(&memory.as_fd()).expect("a mapping");
        assert_eq!(map.len(), 2 * (COUNT_BYTES + SLOTS * bytes), "both ends speak of messages of one length");
        Self { map, bytes, waiting, sent: 0, received: 0, outward }
    }

    fn start(&self, direction: usize) -> *mut u8 {
        self.map.as_mut_ptr().wrapping_add(direction * (COUNT_BYTES + SLOTS * self.bytes))
    }

    fn count(&self, direction: usize) -> &AtomicU32 {
        let address = self.start(direction).cast();
        // SAFETY: the memory is mapped as long as `self`; the length of a message is a multiple of 8, so the
        // address is a multiple of 4; all access to it is atomic.
        unsafe { AtomicU32::from_ptr(address) }
    }

    fn slot(&self, direction: usize, number: u32) -> *mut u8 {
        self.start(direction).wrapping_add(COUNT_BYTES + number as usize % SLOTS * self.bytes)
    }

    /// Sends a message; its length must be that given at creation.
    pub fn send(&mut self, payload: &[u8]) {
        assert_eq!(payload.len(), self.bytes, "messages have one length");
        let slot = self.slot(self.outward, self.sent);
        // SAFETY: a slot has as many bytes as the payload, which was checked above; the reader waits for the
        // count.
        unsafe { slot.copy_from_nonoverlapping(payload.as_ptr(), self.bytes) };
        self.sent = self.sent.wrapping_add(1);
        let count = self.count(self.outward);
        // SYNC: Release: a reader that sees the count sees the payload; pairs with `receive`.
        count.store(self.sent, Ordering::Release);
        if self.waiting == Waiting::Futex {
            let _ = futex::wake(count, Flags::empty(), 1);
        }
    }

    /// Waits for a message without a limit; its length must be that given at creation.
    pub fn receive(&mut self, payload: &mut [u8]) {
        assert_eq!(payload.len(), self.bytes, "messages have one length");
        let inward = 1 - self.outward;
        let count = self.count(inward);
        // SYNC: Acquire: pairs with `send`.
        while count.load(Ordering::Acquire) == self.received {
            match self.waiting {
                Waiting::Poll => std::hint::spin_loop(),
                // Returns at once if the count has changed; the count is read again in any case.
                Waiting::Futex => {
                    let _ = futex::wait(count, Flags::empty(), self.received, None);
                }
            }
        }
        let slot = self.slot(inward, self.received);
        // SAFETY: a slot has as many bytes as the payload, which was checked above; the writer waits for the
        // answer.
        unsafe { slot.copy_to_nonoverlapping(payload.as_mut_ptr(), self.bytes) };
        self.received = self.received.wrapping_add(1);
    }
}
