//! The two views of shared memory that the protocol needs, and the fence that it uses: real ones in
//! `platform`, modelled ones in tests.

use std::sync::atomic::Ordering;

#[cfg(loom)]
pub(crate) use loom::sync::atomic::fence;
#[cfg(not(loom))]
pub(crate) use std::sync::atomic::fence;

use crate::layout::Word;

/// This side's header: only this side writes it.
pub(crate) trait OwnHeader {
    fn store(&self, word: Word, value: u32, order: Ordering);
}

/// This side's ring: only this side writes it.
pub(crate) trait OwnRing: OwnHeader {
    /// Writes a record's mark at a position that is a multiple of 8 within the ring.
    fn put_mark(&mut self, position: u32, bits: u64);
}

/// The peer's region: every value read here may be false, and different the next time.
pub(crate) trait Peer {
    /// Reads a word once, relaxed: the mapping is read-only, where nothing stronger is defined. An acquire
    /// fence follows where the protocol needs one.
    fn load(&self, word: Word) -> u32;

    /// Reads a mark once, relaxed, at a position that is a multiple of 8 within the ring.
    fn mark(&self, position: u32) -> u64;

    /// Reports to the peer's wait set that this ring has a message. Returns `false` if the peer waits without a set.
    fn report_message(&self) -> bool {
        false
    }
}
