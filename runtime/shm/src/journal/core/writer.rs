//! The writing half: any number of threads, of which none waits for another one.

use std::sync::atomic::Ordering;

use super::{
    super::layout::{Head, RECORD_HEAD, State, hasher, record_bytes, stamp},
    AtomicU64, Memory,
};
use crate::memory::fence;

/// A record's place in the ring, that one writer has.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Reserved {
    pub(crate) position: u64,
    head: Head,
}

/// Reserves the place of a record: one addition, after which every record before is at most a ring away.
pub(crate) fn reserve(memory: &impl Memory, head: Head) -> Reserved {
    let bytes = record_bytes(head.length as usize);
    let position = memory.reserved().fetch_add(bytes, Ordering::Relaxed);
    // SYNC: a reader that sees any later store of this writer, and fences, sees the addition too, and knows that the
    // record that was here is overwritten: `ReaderCore::refill`.
    fence(Ordering::Release);
    Reserved { position, head }
}

/// Announces the record, so that a reader can skip it if its writer dies.
pub(crate) fn begin(memory: &impl Memory, reserved: Reserved, salt: u64) {
    let mut cursor = Cursor::at(memory.ring(), reserved.position + 8);
    reserved.head.words().into_iter().for_each(|word| cursor.put(word));
    let stamp = stamp(reserved.position, State::Writing, salt);
    // SYNC: the words before are there for a reader that sees this and fences.
    word_at(memory.ring(), reserved.position).store(stamp, Ordering::Release);
}

/// Copies the payload, and marks the record as whole.
pub(crate) fn finish(memory: &impl Memory, reserved: Reserved, parts: &[&[u8]], salt: u64) {
    let Reserved { position, head } = reserved;
    let mut crc = hasher(position, &head);
    let mut cursor = Cursor::at(memory.ring(), position + RECORD_HEAD as u64);
    for part in parts {
        crc.update(part);
        cursor.copy(part);
    }
    cursor.flush();
    let word = |offset| word_at(memory.ring(), position + offset);
    word(32).store(u64::from(crc.finalize()), Ordering::Relaxed);
    // SYNC: the whole record is there for a reader that sees this and fences. A writer that was preempted for a whole
    // turn of the ring damages one newer record, whose checksum shows it.
    word(0).store(stamp(position, State::Written, salt), Ordering::Release);
}

fn word_at(ring: &[AtomicU64], position: u64) -> &AtomicU64 {
    &ring[(position / 8) as usize & (ring.len() - 1)]
}

/// Writes bytes into consecutive words of the ring, and continues at its start.
struct Cursor<'a> {
    ring: &'a [AtomicU64],
    /// Index of the next word.
    at: usize,
    /// Bytes that do not fill a word yet.
    rest: [u8; 8],
    rest_len: usize,
}

impl<'a> Cursor<'a> {
    fn at(ring: &'a [AtomicU64], position: u64) -> Self {
        Self { ring, at: (position / 8) as usize & (ring.len() - 1), rest: [0; 8], rest_len: 0 }
    }

    /// SYNC: Relaxed, as all words of a record: its stamp publishes them.
    fn put(&mut self, word: u64) {
        self.ring[self.at].store(word, Ordering::Relaxed);
        self.at = (self.at + 1) & (self.ring.len() - 1);
    }

    fn copy(&mut self, mut bytes: &[u8]) {
        if self.rest_len > 0 {
            let (lead, others) = bytes.split_at(bytes.len().min(8 - self.rest_len));
            self.rest[self.rest_len..][..lead.len()].copy_from_slice(lead);
            self.rest_len += lead.len();
            bytes = others;
            if self.rest_len < 8 {
                return;
            }
            self.put_rest();
        }
        let (mut words, rest) = bytes.as_chunks::<8>();
        // At most two runs: up to the ring's end, and from its start. A copy of one run has no check of each index.
        while !words.is_empty() {
            let run = &self.ring[self.at..];
            let (now, later) = words.split_at(words.len().min(run.len()));
            for (target, word) in run.iter().zip(now) {
                target.store(u64::from_ne_bytes(*word), Ordering::Relaxed);
            }
            self.at = (self.at + now.len()) & (self.ring.len() - 1);
            words = later;
        }
        self.rest[..rest.len()].copy_from_slice(rest);
        self.rest_len = rest.len();
    }

    fn put_rest(&mut self) {
        self.put(u64::from_ne_bytes(self.rest));
        (self.rest, self.rest_len) = ([0; 8], 0);
    }

    /// Writes the last word, filled with zeros.
    fn flush(&mut self) {
        if self.rest_len > 0 {
            self.rest[self.rest_len..].fill(0);
            self.put_rest();
        }
    }
}
