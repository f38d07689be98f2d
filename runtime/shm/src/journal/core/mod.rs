//! The protocol of a journal over any memory: how writers reserve, write and commit, and how a reader finds whole
//! records. No system call, no clock.

pub(crate) mod channels;
pub(crate) mod reader;
pub(crate) mod writer;

#[cfg(all(test, loom))]
mod loom;
#[cfg(test)]
pub(crate) mod model;
#[cfg(all(test, not(loom)))]
mod tests;

#[cfg(loom)]
pub(crate) use loom_atomics::AtomicU64;
#[cfg(not(loom))]
pub(crate) use std::sync::atomic::AtomicU64;

#[cfg(loom)]
use ::loom::sync::atomic as loom_atomics;

/// The memory of a journal, as its writers see it.
pub(crate) trait Memory {
    /// Bytes ever reserved.
    fn reserved(&self) -> &AtomicU64;

    /// The table of channels: a multiple of [`PLACE_WORDS`](super::layout::PLACE_WORDS).
    fn table(&self) -> &[AtomicU64];

    /// The words of the ring: a power of two.
    fn ring(&self) -> &[AtomicU64];
}
