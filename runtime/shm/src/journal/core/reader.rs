//! The reading half: finds whole records in bytes that change at any time, or that are damaged.
//!
//! The state is a position. Each turn either moves it forward, or ends the call:
//!
//! ```text
//! at the position          state          turn
//! a whole record           any            return it
//! a record being written   any            wait for `patience`, then skip it
//! no record                at a boundary  wait for `patience`, then search
//! no record                searching      next multiple of ALIGN
//! wrong length or CRC      any            read once more, then search
//! overwritten meanwhile    any            move to the oldest bytes but an eighth of the ring, then search
//! ```

use std::sync::atomic::Ordering;

use super::super::layout::{ALIGN, Head, RECORD_HEAD, State, hasher, payload_max, record_bytes, stamp};
use crate::memory::fence;

/// Bytes that are read at once.
const CHUNK: u64 = 256 * 1024;
/// Attempts to read bytes before they are overwritten. After them the call returns nothing, and the next one tries.
const REFILLS_MAX: usize = 4;

/// The memory of a journal, as a reader sees it.
pub(crate) trait Source {
    type Error;

    /// Returns the bytes ever reserved.
    fn reserved(&self) -> Result<u64, Self::Error>;

    /// Reads bytes of the ring from this offset; they lie within it.
    fn read(&self, offset: u64, into: &mut [u8]) -> Result<(), Self::Error>;
}

/// A whole record; its payload is in the caller's buffer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Found {
    pub(crate) position: u64,
    pub(crate) head: Head,
}

/// The result of a call.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Next {
    Record(Found),
    /// There is nothing, or nothing yet.
    Nothing,
    /// More of the ring is damaged than any writer leaves.
    Damaged(u64),
}

/// Events that cost a reader records. The numbers of each channel say how many.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ReaderCounts {
    /// Records that their writer did not finish in time: it was preempted or has died.
    pub unfinished: u64,
    /// Records with a wrong length or checksum.
    pub damaged: u64,
    /// Occasions on which the writers overtook this reader.
    pub overruns: u64,
}

/// The position of a reader.
#[derive(Debug)]
pub(crate) struct ReaderCore {
    ring_bytes: u64,
    salt: u64,
    /// Nanoseconds that a record may stay unfinished.
    pub(crate) patience: u64,
    at: u64,
    /// The position at which reading began.
    began: u64,
    reserved: u64,
    chunk: Vec<u8>,
    chunk_at: u64,
    is_searching: bool,
    /// Since when the record at `at` is unfinished.
    stalled: Option<u64>,
    /// The position of a record whose checksum was wrong once.
    failed_at: Option<u64>,
    /// Bytes of all records with wrong checksums: the bound of the work on damaged files.
    failed_bytes: u64,
    pub(crate) counts: ReaderCounts,
}

/// The place of a record that was looked at.
enum Look {
    Record(Head),
    Writing(Option<Head>),
    No,
}

impl ReaderCore {
    /// Begins at the oldest record, or after the newest one.
    pub(crate) fn new(ring_bytes: u64, salt: u64, reserved: u64, is_from_oldest: bool) -> Self {
        let reserved = reserved & !(ALIGN - 1);
        let oldest = reserved.saturating_sub(ring_bytes);
        let at = if is_from_oldest { oldest } else { reserved };
        Self {
            ring_bytes,
            salt,
            patience: 0,
            at,
            began: at,
            reserved,
            chunk: Vec::new(),
            chunk_at: at,
            // The oldest byte is in the middle of a record, unless none was overwritten.
            is_searching: is_from_oldest && oldest > 0,
            stalled: None,
            failed_at: None,
            failed_bytes: 0,
            counts: ReaderCounts::default(),
        }
    }

    /// Returns the next whole record. `now` is in nanoseconds, of any clock that does not go back.
    pub(crate) fn next<S: Source>(
        &mut self,
        source: &S,
        now: u64,
        payload: &mut Vec<u8>,
    ) -> Result<Next, S::Error> {
        let mut is_fresh = false;
        // Each turn moves by `ALIGN` or reads the position once more: at most three times.
        for _ in 0..4 * (self.ring_bytes / ALIGN) {
            if !self.covers(RECORD_HEAD as u64) {
                is_fresh = true;
                if !self.refill(source, RECORD_HEAD as u64)? {
                    return Ok(Next::Nothing);
                }
            }
            match self.look() {
                Look::No if self.is_searching => self.move_by(ALIGN),
                Look::Record(head) => {
                    let bytes = record_bytes(head.length as usize);
                    if !self.covers(bytes) {
                        is_fresh = true;
                        if !self.refill(source, bytes)? {
                            return Ok(Next::Nothing);
                        }
                        // The position may be another one now.
                        continue;
                    }
                    if self.take(head, payload) {
                        let position = self.at;
                        self.move_by(bytes);
                        self.is_searching = false;
                        return Ok(Next::Record(Found { position, head }));
                    }
                    if self.failed_at.replace(self.at) != Some(self.at) {
                        // Its last bytes may have been read before its first ones.
                        self.chunk.clear();
                        continue;
                    }
                    self.failed_bytes = self.failed_bytes.saturating_add(bytes);
                    if self.failed_bytes > self.ring_bytes * 2 + (self.at - self.began) {
                        let at = self.at;
                        self.search();
                        return Ok(Next::Damaged(at));
                    }
                    self.counts.damaged += 1;
                    self.search();
                }
                Look::Writing(_) | Look::No if !is_fresh => {
                    is_fresh = true;
                    self.chunk.clear();
                }
                look @ (Look::Writing(_) | Look::No) => {
                    let since = *self.stalled.get_or_insert(now);
                    if now.saturating_sub(since) < self.patience {
                        return Ok(Next::Nothing);
                    }
                    self.counts.unfinished += 1;
                    match look {
                        Look::Writing(Some(head)) => {
                            self.move_by(record_bytes(head.length as usize));
                            self.is_searching = false;
                        }
                        Look::Writing(None) | Look::No | Look::Record(_) => self.search(),
                    }
                }
            }
        }
        Ok(Next::Nothing)
    }

    fn move_by(&mut self, bytes: u64) {
        self.at = self.at.saturating_add(bytes);
        self.stalled = None;
    }

    fn search(&mut self) {
        self.move_by(ALIGN);
        self.is_searching = true;
    }

    /// Whether so many bytes from the position are in the chunk.
    fn covers(&self, bytes: u64) -> bool {
        let end = self.chunk_at + self.chunk.len() as u64;
        self.at >= self.chunk_at && self.at <= end && end - self.at >= bytes
    }

    /// Reads bytes from the position, at least so many. `false` if they are not there yet.
    fn refill<S: Source>(&mut self, source: &S, bytes: u64) -> Result<bool, S::Error> {
        self.chunk.clear();
        for _ in 0..REFILLS_MAX {
            let reserved = source.reserved()?;
            // No writer takes back a reservation.
            if reserved < self.reserved || reserved % ALIGN != 0 {
                return Ok(false);
            }
            self.reserved = reserved;
            self.leave_overwritten();
            let rest = reserved - self.at;
            if rest < bytes {
                if self.is_searching {
                    self.move_by(rest);
                    self.is_searching = false;
                }
                return Ok(false);
            }
            self.read(source, rest.min(CHUNK.min(self.ring_bytes / 2).max(bytes)))?;
            // SYNC: with `writer::reserve`: if any of these bytes is of a newer record, the next load has its
            // reservation.
            fence(Ordering::Acquire);
            let after = source.reserved()?;
            if after >= reserved && after - self.at <= self.ring_bytes {
                return Ok(true);
            }
            self.chunk.clear();
        }
        Ok(false)
    }

    /// Moves away from bytes that are overwritten, or will be at once.
    fn leave_overwritten(&mut self) {
        if self.reserved - self.at > self.ring_bytes {
            let margin = self.ring_bytes / 8 / ALIGN * ALIGN;
            self.at = self.reserved - self.ring_bytes + margin;
            self.is_searching = true;
            self.stalled = None;
            self.counts.overruns += 1;
        }
    }

    fn read<S: Source>(&mut self, source: &S, bytes: u64) -> Result<(), S::Error> {
        let offset = self.at & (self.ring_bytes - 1);
        let first = bytes.min(self.ring_bytes - offset) as usize;
        self.chunk.resize(bytes as usize, 0);
        self.chunk_at = self.at;
        let (head, tail) = self.chunk.split_at_mut(first);
        source.read(offset, head)?;
        if tail.is_empty() { Ok(()) } else { source.read(0, tail) }
    }

    fn word(&self, offset: usize) -> u64 {
        let at = (self.at - self.chunk_at) as usize + offset;
        let mut bytes = [0; 8];
        bytes.copy_from_slice(&self.chunk[at..at + 8]);
        u64::from_ne_bytes(bytes)
    }

    /// Looks for a record at the position, whose head is in the chunk.
    fn look(&self) -> Look {
        let found = self.word(0);
        let head = || {
            let head = Head::of([self.word(8), self.word(16), self.word(24)])?;
            let bytes = record_bytes(head.length as usize);
            let fits = head.length as usize <= payload_max(self.ring_bytes);
            (fits && bytes <= self.reserved - self.at).then_some(head)
        };
        if found == stamp(self.at, State::Written, self.salt) {
            head().map_or(Look::No, Look::Record)
        } else if found == stamp(self.at, State::Writing, self.salt) {
            Look::Writing(head())
        } else {
            Look::No
        }
    }

    /// Copies the payload, if the checksum is right.
    fn take(&self, head: Head, payload: &mut Vec<u8>) -> bool {
        let at = (self.at - self.chunk_at) as usize + RECORD_HEAD;
        let bytes = &self.chunk[at..at + head.length as usize];
        let mut crc = hasher(self.at, &head);
        crc.update(bytes);
        let is_right = u64::from(crc.finalize()) == self.word(32);
        if is_right {
            payload.clear();
            payload.extend_from_slice(bytes);
        }
        is_right
    }
}
