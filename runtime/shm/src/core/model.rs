//! A region as plain atomics, for tests of the protocol. Both sides share it, and each writes only its own
//! part.

use std::sync::{Arc, atomic::Ordering};

#[cfg(loom)]
use loom::sync::atomic::{AtomicU32, AtomicU64};
#[cfg(not(loom))]
use std::sync::atomic::{AtomicU32, AtomicU64};

use super::{ConsumerCore, ProducerCore, Record, producer::Reserved};
use crate::{
    layout::{Capacity, Word},
    memory::{OwnHeader, OwnRing, Peer},
    wait_set::report,
};

/// One side's region.
#[derive(Debug)]
pub(super) struct Side {
    words: [AtomicU32; 6],
    ring: Vec<AtomicU64>,
}

pub(super) type Shared = Arc<Side>;
pub(super) type Sender = ProducerCore<Shared, Waiting>;
pub(super) type Receiver = ConsumerCore<Shared, Shared>;

impl Side {
    pub(super) fn new(capacity: Capacity) -> Shared {
        let words = std::array::from_fn(|_| AtomicU32::new(0));
        let ring = (0..capacity.bytes() / 8).map(|_| AtomicU64::new(0)).collect();
        Arc::new(Self { words, ring })
    }

    pub(super) const fn word(&self, word: Word) -> &AtomicU32 {
        match word {
            Word::Tail => &self.words[0],
            Word::Head => &self.words[1],
            Word::ConsumerSleep => &self.words[2],
            Word::ProducerSleep => &self.words[3],
            Word::Rung => &self.words[4],
            Word::Reported => &self.words[5],
        }
    }

    pub(super) fn cell(&self, position: u32) -> &AtomicU64 {
        &self.ring[position as usize / 8]
    }
}

impl OwnHeader for Shared {
    fn store(&self, word: Word, value: u32, order: Ordering) {
        self.word(word).store(value, order);
    }
}

impl OwnRing for Shared {
    fn put_mark(&mut self, position: u32, bits: u64) {
        self.cell(position).store(bits, Ordering::Relaxed);
    }
}

/// A set of rings.
#[derive(Debug)]
pub(super) struct Set {
    pub(super) reports: AtomicU32,
    pub(super) sleep: AtomicU32,
}

/// The region of a side that waits for messages, by itself or for a set.
#[derive(Clone, Debug)]
pub(super) struct Waiting {
    side: Shared,
    /// The set, and the bit of this ring.
    set: Option<(Arc<Set>, u32)>,
}

impl Peer for Waiting {
    fn load(&self, word: Word) -> u32 {
        match &self.set {
            Some((set, _)) if word == Word::ConsumerSleep => set.sleep.load(Ordering::Relaxed),
            Some(_) | None => self.side.load(word),
        }
    }

    fn mark(&self, position: u32) -> u64 {
        self.side.mark(position)
    }

    fn report_message(&self) -> bool {
        let Some((set, bit)) = &self.set else { return false };
        report(
            || set.reports.load(Ordering::Relaxed) & bit != 0,
            || {
                set.reports.fetch_or(*bit, Ordering::Release);
            },
        );
        true
    }
}

impl Peer for Shared {
    fn load(&self, word: Word) -> u32 {
        self.word(word).load(Ordering::Relaxed)
    }

    fn mark(&self, position: u32) -> u64 {
        self.cell(position).load(Ordering::Relaxed)
    }
}

/// A ring from one side to another.
pub(super) fn ring(capacity: Capacity) -> (Sender, Receiver) {
    ring_in(None, capacity)
}

/// The same, to a side that waits for a set: this bit is the ring's.
pub(super) fn ring_in(set: Option<(Arc<Set>, u32)>, capacity: Capacity) -> (Sender, Receiver) {
    let (source, target) = (Side::new(capacity), Side::new(capacity));
    let waiting = Waiting { side: Arc::clone(&target), set };
    let sender = ProducerCore::new(Arc::clone(&source), waiting, capacity);
    (sender, ConsumerCore::new(target, source, capacity))
}

/// Writes one number into every word of a reserved message.
pub(super) fn fill(sender: &Sender, reserved: Reserved, number: u64) {
    let start = sender.payload_position(reserved);
    for position in (start..start + reserved.length).step_by(8) {
        sender.own.cell(position).store(number, Ordering::Relaxed);
    }
}

/// The words of a message.
pub(super) fn read(receiver: &Receiver, record: Record) -> Vec<u64> {
    (record.position..record.position + record.length)
        .step_by(8)
        .map(|position| look(receiver.peer.cell(position)))
        .collect()
}

#[cfg(not(loom))]
fn look(cell: &AtomicU64) -> u64 {
    cell.load(Ordering::Relaxed)
}

/// Loads like a non-atomic: loom then also fails when the sender may write it at the same time.
#[cfg(loom)]
fn look(cell: &AtomicU64) -> u64 {
    // SAFETY: loom ends the test when another access does not happen before or after this one.
    unsafe { cell.unsync_load() }
}
