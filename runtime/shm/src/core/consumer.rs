//! The reading half of a ring: validates everything that the peer has written.

use std::sync::atomic::Ordering;

use super::sleep::{Sleep, Waking};
use crate::{
    error::CorruptError,
    layout::{Capacity, MARK_BYTES, Mark, Word, record_bytes},
    memory::{OwnHeader, Peer, fence},
    wait::Armed,
};

/// A message in the ring. Its bytes lie within the ring, independent of later writes of the peer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Record {
    /// Position of its first byte in the ring.
    pub(crate) position: u32,
    /// Number of its bytes.
    pub(crate) length: u32,
    /// This side's count of consumed bytes after its release.
    end: u32,
}

/// The state of the reading half. It trusts only its own counts.
#[derive(Debug)]
pub(crate) struct ConsumerCore<O, P> {
    pub(crate) own: O,
    pub(crate) peer: P,
    capacity: Capacity,
    /// Bytes ever consumed.
    head: u32,
    /// Consumed bytes that the producer has been told are free again.
    given_back: u32,
    /// Published bytes of the producer at the last check; always at most `capacity` ahead of `head`.
    tail_seen: u32,
    sleep: Sleep,
    waking: Waking,
    corrupt: Option<CorruptError>,
}

impl<O: OwnHeader, P: Peer> ConsumerCore<O, P> {
    pub(crate) fn new(own: O, peer: P, capacity: Capacity) -> Self {
        Self {
            own,
            peer,
            capacity,
            head: 0,
            given_back: 0,
            tail_seen: 0,
            sleep: Sleep::new(Word::ConsumerSleep),
            waking: Waking::new(Word::ProducerSleep),
            corrupt: None,
        }
    }

    pub(crate) const fn capacity(&self) -> Capacity {
        self.capacity
    }

    /// Returns the oldest message that was not released, if there is any.
    pub(crate) fn next(&mut self) -> Result<Option<Record>, CorruptError> {
        if let Some(corrupt) = self.corrupt {
            return Err(corrupt);
        }
        let found = self.find();
        if let Err(corrupt) = found {
            self.corrupt = Some(corrupt);
        }
        found
    }

    /// Returns a message's memory to the producer, and that of the messages kept before it. True when the
    /// producer sleeps and must be woken.
    pub(crate) fn release(&mut self, record: Record) -> bool {
        self.keep(record);
        self.give_back()
    }

    /// Advances to the next message. This one's memory is returned with that of a later one, or together with
    /// all kept messages.
    pub(crate) fn keep(&mut self, record: Record) {
        self.head = record.end;
    }

    /// Returns the memory of the kept messages. True when the producer sleeps and must be woken.
    pub(crate) fn give_back(&mut self) -> bool {
        if self.given_back == self.head {
            return false;
        }
        self.given_back = self.head;
        // SYNC: this side's reads of the records are over for a producer that reads this head and fences:
        // `ProducerCore::look`.
        self.own.store(Word::Head, self.head, Ordering::Release);
        self.waking.needs_ring(&self.peer)
    }

    /// Whether no other message follows this one now. Bytes of a hostile peer are validated when they are read.
    pub(crate) fn is_last(&self, record: Record) -> bool {
        record.end == self.tail_seen && !self.has_moved()
    }

    /// Announces sleep until there is a message.
    pub(crate) fn arm(&mut self) -> Result<Armed, CorruptError> {
        self.sleep.announce(&self.own);
        match self.next() {
            Ok(None) => Ok(Armed::Sleep),
            Ok(Some(_)) => {
                self.sleep.end(&self.own);
                Ok(Armed::Ready)
            }
            Err(corrupt) => {
                self.sleep.end(&self.own);
                Err(corrupt)
            }
        }
    }

    /// Announces sleep to this peer, one of several. After all of them a fence follows, and another check.
    pub(crate) fn announce(&mut self) {
        self.sleep.announce_unfenced(&self.own);
    }

    /// Whether the peer reports a ring for this sleep of a set.
    pub(crate) fn was_rung_for(&self, sleep: u32) -> bool {
        self.peer.load(Word::Rung) == sleep
    }

    /// Whether the peer has reported all messages that were found to this side's wait set.
    pub(crate) fn is_reported(&self) -> bool {
        let reported = self.peer.load(Word::Reported);
        // SYNC: the bit was set before: `ProducerCore::publish`.
        fence(Ordering::Acquire);
        reported.wrapping_sub(self.tail_seen) <= self.capacity.bytes()
    }

    /// Announces that this side is awake again.
    pub(crate) fn disarm(&mut self) {
        self.sleep.end(&self.own);
    }

    /// Whether the producer has published a message since the last check.
    pub(crate) fn has_moved(&self) -> bool {
        self.peer.load(Word::Tail) != self.tail_seen
    }

    /// Sets the counts as if this much had been published and consumed already.
    #[cfg(all(test, not(loom)))]
    pub(super) fn start_at(&mut self, count: u32) {
        (self.head, self.given_back, self.tail_seen) = (count, count, count);
        self.own.store(Word::Head, count, Ordering::Relaxed);
    }

    fn find(&mut self) -> Result<Option<Record>, CorruptError> {
        if self.tail_seen == self.head {
            self.refresh()?;
            if self.tail_seen == self.head {
                return Ok(None);
            }
        }
        match self.mark_at(self.head)? {
            Mark::Message(length) => self.message(self.head, length).map(Some),
            Mark::Skip => self.message_after_skip().map(Some),
        }
    }

    /// Reads the message at the ring's beginning after a skip: a producer publishes both at once.
    fn message_after_skip(&self) -> Result<Record, CorruptError> {
        let (skipped, published) = (self.capacity.rest(self.head), self.published(self.head));
        let corrupt = CorruptError::Skip { skipped, published };
        // Not less: at least a mark follows. And no skip of the whole ring, which no message can need.
        if skipped >= published || skipped == self.capacity.bytes() {
            return Err(corrupt);
        }
        let start = self.head.wrapping_add(skipped);
        match self.mark_at(start)? {
            Mark::Message(length) => self.message(start, length),
            Mark::Skip => Err(corrupt),
        }
    }

    fn message(&self, start: u32, length: u32) -> Result<Record, CorruptError> {
        let most = self.capacity.payload_max() + MARK_BYTES;
        let room = self.published(start).min(self.capacity.rest(start)).min(most);
        match record_bytes(length) {
            Some(record) if record <= room => Ok(Record {
                position: self.capacity.position(start) + MARK_BYTES,
                length,
                end: start.wrapping_add(record),
            }),
            _ => Err(CorruptError::Length { length, room }),
        }
    }

    /// The published bytes between `start` and the tail.
    const fn published(&self, start: u32) -> u32 {
        self.tail_seen.wrapping_sub(start)
    }

    /// Reads a mark once. Counts are multiples of 8, and so are positions.
    fn mark_at(&self, count: u32) -> Result<Mark, CorruptError> {
        let bits = self.peer.mark(self.capacity.position(count));
        Mark::from_bits(bits).ok_or(CorruptError::Mark(bits))
    }

    /// Reads the producer's tail once, and accepts it only if it lies between the last one and the ring's
    /// capacity.
    fn refresh(&mut self) -> Result<(), CorruptError> {
        let tail = self.peer.load(Word::Tail);
        // SYNC: the bytes of all records before this tail are visible: the store of tail in `ProducerCore::publish`.
        fence(Ordering::Acquire);
        let (moved, known) = (tail.wrapping_sub(self.tail_seen), self.tail_seen.wrapping_sub(self.head));
        if moved > self.capacity.bytes() - known || !tail.is_multiple_of(MARK_BYTES) {
            return Err(CorruptError::Tail { tail, seen: self.tail_seen });
        }
        self.tail_seen = tail;
        Ok(())
    }
}
