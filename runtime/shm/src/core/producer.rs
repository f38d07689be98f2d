//! The writing half of a ring.

use std::sync::atomic::Ordering;

use super::sleep::{Sleep, WakePlace, Waking};
use crate::{
    error::{CorruptError, LoanError},
    layout::{Capacity, MARK_BYTES, Mark, Word, record_bytes},
    memory::{OwnRing, Peer, fence},
    wait::Armed,
};

/// Room for one message that is not published yet.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Reserved {
    /// Bytes to the ring's end that are left empty before it.
    skip: u32,
    /// Bytes of the message.
    pub(crate) length: u32,
}

/// The state of the writing half. It trusts only its own counts.
#[derive(Debug)]
pub(crate) struct ProducerCore<O, P> {
    pub(crate) own: O,
    pub(crate) peer: P,
    capacity: Capacity,
    /// Bytes ever published.
    tail: u32,
    /// Consumed bytes of the consumer at the last check; always at most `capacity` behind `tail`.
    head_seen: u32,
    reserved: Option<Reserved>,
    sleep: Sleep,
    waking: Waking,
    corrupt: Option<CorruptError>,
}

impl<O: OwnRing, P: Peer> ProducerCore<O, P> {
    pub(crate) fn new(own: O, peer: P, capacity: Capacity) -> Self {
        Self {
            own,
            peer,
            capacity,
            tail: 0,
            head_seen: 0,
            reserved: None,
            sleep: Sleep::new(Word::ProducerSleep),
            waking: Waking::new(Word::ConsumerSleep),
            corrupt: None,
        }
    }

    pub(crate) const fn capacity(&self) -> Capacity {
        self.capacity
    }

    /// The error of the peer, if one was detected.
    pub(crate) const fn corrupt(&self) -> Option<CorruptError> {
        self.corrupt
    }

    /// The reserved room, if any.
    pub(crate) const fn reserved(&self) -> Option<Reserved> {
        self.reserved
    }

    /// Reserves room for a message of `length` bytes. Discards an earlier reservation that was not published.
    pub(crate) fn reserve(&mut self, length: usize) -> Result<Reserved, LoanError> {
        self.intact()?;
        self.reserved = None;
        let (length, record) = self.record_for(length)?;
        let rest = self.capacity.rest(self.tail);
        let skip = if record > rest { rest } else { 0 };
        if record + skip > self.free() {
            self.refresh()?;
        }
        if record + skip > self.free() {
            return Err(LoanError::Full { asked: length as usize, free: self.longest_now() });
        }
        let reserved = Reserved { skip, length };
        self.reserved = Some(reserved);
        Ok(reserved)
    }

    /// Position of the reserved message's bytes in the ring.
    pub(crate) const fn payload_position(&self, reserved: Reserved) -> u32 {
        self.capacity.position(self.tail.wrapping_add(reserved.skip)) + MARK_BYTES
    }

    /// Makes the reserved message shorter than requested.
    pub(crate) fn shorten(&mut self, length: u32) {
        if let Some(reserved) = &mut self.reserved {
            reserved.length = reserved.length.min(length);
        }
    }

    /// Publishes the reserved room as a message. True when the consumer sleeps and must be woken.
    pub(crate) fn publish(&mut self) -> bool {
        let Some(Reserved { skip, length }) = self.reserved.take() else {
            return false;
        };
        if skip > 0 {
            self.own.put_mark(self.capacity.position(self.tail), Mark::Skip.to_bits());
        }
        let start = self.tail.wrapping_add(skip);
        self.own.put_mark(self.capacity.position(start), Mark::Message(length).to_bits());
        let record = record_bytes(length).expect("it was counted when it was reserved");
        self.tail = start.wrapping_add(record);
        // SYNC: the record's bytes become visible to a consumer that reads this tail and fences:
        // `ConsumerCore::look`.
        self.own.store(Word::Tail, self.tail, Ordering::Release);
        if self.peer.report_message() {
            // SYNC: a consumer that reads this count and finds no bit has lost the bit to another peer: `is_reported`.
            self.own.store(Word::Reported, self.tail, Ordering::Release);
        }
        self.waking.needs_ring(&self.peer)
    }

    /// Discards the reserved room; it was never visible to the consumer.
    pub(crate) fn give_back(&mut self) {
        self.reserved = None;
    }

    /// The sleeping place of the consumer that must be woken.
    pub(crate) const fn wake_place(&self) -> WakePlace {
        self.waking.wake_place()
    }

    /// Whether the consumer has announced that it sleeps.
    #[cfg(all(test, not(any(loom, miri))))]
    pub(crate) fn peer_sleeps(&self) -> bool {
        self.peer.load(Word::ConsumerSleep) % 2 == 1
    }

    /// Reports the sleep of the consumer for which this side has rung.
    pub(crate) fn report_ring(&self) {
        // SYNC: a consumer that sleeps at this word and sees it also sees the stores before the ring.
        self.own.store(Word::Rung, self.waking.rung_for(), Ordering::Release);
    }

    /// The same for a sleep that need not have been announced: for a side that is about to leave.
    pub(crate) fn force_ring_report(&self) {
        self.own.store(Word::Rung, self.peer.load(Word::ConsumerSleep), Ordering::Release);
    }

    /// Announces sleep until there is room for `length` bytes.
    pub(crate) fn arm(&mut self, length: usize) -> Result<Armed, LoanError> {
        self.sleep.announce(&self.own);
        let found = self.intact().map_err(LoanError::from).and_then(|()| self.check_room(length));
        match found {
            Ok(false) => Ok(Armed::Sleep),
            Ok(true) => {
                self.sleep.end(&self.own);
                Ok(Armed::Ready)
            }
            Err(error) => {
                self.sleep.end(&self.own);
                Err(error)
            }
        }
    }

    /// Announces that this side is awake again.
    pub(crate) fn disarm(&mut self) {
        self.sleep.end(&self.own);
    }

    /// Bytes ever published, including the gaps between messages; wraps.
    pub(crate) const fn published(&self) -> u32 {
        self.tail
    }

    /// Bytes that are published and not consumed.
    pub(crate) fn unread(&mut self) -> Result<u32, CorruptError> {
        self.refresh()?;
        Ok(self.tail.wrapping_sub(self.head_seen))
    }

    /// Whether the consumer has consumed a message since the last check.
    pub(crate) fn has_moved(&self) -> bool {
        self.peer.load(Word::Head) != self.head_seen
    }

    /// Sets the counts as if this much had been published and consumed already.
    #[cfg(all(test, not(loom)))]
    pub(super) fn start_at(&mut self, count: u32) {
        (self.tail, self.head_seen) = (count, count);
        self.own.store(Word::Tail, count, Ordering::Relaxed);
    }

    fn check_room(&mut self, length: usize) -> Result<bool, LoanError> {
        self.refresh()?;
        let (_, record) = self.record_for(length)?;
        let rest = self.capacity.rest(self.tail);
        let skip = if record > rest { rest } else { 0 };
        Ok(record + skip <= self.free())
    }

    fn record_for(&self, asked: usize) -> Result<(u32, u32), LoanError> {
        let max = self.capacity.payload_max();
        let fits = u32::try_from(asked).ok().filter(|length| *length <= max);
        fits.and_then(|length| record_bytes(length).map(|record| (length, record)))
            .ok_or(LoanError::TooLong { asked, max: max as usize })
    }

    const fn free(&self) -> u32 {
        self.capacity.bytes() - self.tail.wrapping_sub(self.head_seen)
    }

    /// The longest message that fits now, before or after the ring's end.
    fn longest_now(&self) -> usize {
        let (free, rest) = (self.free(), self.capacity.rest(self.tail));
        let before = free.min(rest).saturating_sub(MARK_BYTES);
        let after = free.saturating_sub(rest).saturating_sub(MARK_BYTES);
        before.max(after).min(self.capacity.payload_max()) as usize
    }

    /// Reads the consumer's head once, and accepts it only if it lies between the last one and the tail.
    fn refresh(&mut self) -> Result<(), CorruptError> {
        let head = self.peer.load(Word::Head);
        // SYNC: the consumer's reads of the consumed messages are over: its store of head in
        // `ConsumerCore::release`.
        fence(Ordering::Acquire);
        let (moved, most) = (head.wrapping_sub(self.head_seen), self.tail.wrapping_sub(self.head_seen));
        if moved > most || !head.is_multiple_of(MARK_BYTES) {
            let corrupt = CorruptError::Head { head, seen: self.head_seen, tail: self.tail };
            self.corrupt = Some(corrupt);
            return Err(corrupt);
        }
        self.head_seen = head;
        Ok(())
    }

    fn intact(&self) -> Result<(), CorruptError> {
        self.corrupt.map_or(Ok(()), Err)
    }
}
