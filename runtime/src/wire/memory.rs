//! Memory for payloads: a few buffers a thread, each used again as soon as nobody holds the payload that was in it.
//!
//! A payload is shared by reference count on its way, so that whoever drops it last, on whatever thread, makes its
//! buffer free: nothing is sent back. A payload that is kept for long keeps its buffer; the thread makes others, up to a
//! bound, and then memory is allocated for each payload.

use std::{
    cell::RefCell,
    io::{self, Write},
};

use bytes::{Bytes, BytesMut};

use super::long;

/// Bytes of a buffer: a payload of 4 KiB and what MessagePack puts around it.
const BUFFER_BYTES: usize = 4 * 1024 + 256;
/// Buffers of one thread. More payloads than that under way at once are allocated one by one.
const BUFFERS_MAX: usize = 64;
/// Buffers that are looked at first: with few payloads under way, the same few are used, which are in the cache.
const FIRST: usize = 4;
/// Buffers that are looked at beyond those, each time others. Payloads end in the order in which they began, mostly: two are enough
/// for those that leave one by one, and where bursts end out of their order, runs of some in use lie between free ones.
const IN_TURN: usize = 8;
/// Bytes to begin with where memory is allocated for one payload.
const SHORT: usize = 128;

thread_local! {
    static BUFFERS: RefCell<Buffers> = const { RefCell::new(Buffers { all: Vec::new(), next: FIRST }) };
}

/// The bytes that `write` writes.
pub(super) fn written<E>(write: impl FnOnce(&mut Writer) -> Result<(), E>) -> Result<Bytes, E> {
    let mut writer = Writer(Buffer::take());
    write(&mut writer)?;
    Ok(writer.0.cut().freeze())
}

/// A payload that is these bytes.
pub(super) fn copied(bytes: &[u8]) -> Bytes {
    if bytes.is_empty() || bytes.len() > BUFFER_BYTES {
        return Bytes::copy_from_slice(bytes);
    }
    let Some(mut buffer) = Buffer::of_thread() else { return Bytes::copy_from_slice(bytes) };
    buffer.memory.extend_from_slice(bytes);
    buffer.cut().freeze()
}

/// Zeroed memory of `length` bytes.
pub(super) fn zeroed(length: usize) -> BytesMut {
    if length > BUFFER_BYTES {
        return long::zeroed(length);
    }
    let mut buffer = Buffer::take();
    buffer.memory.resize(length, 0);
    buffer.cut()
}

/// Writes at the end of a buffer.
pub(super) struct Writer(Buffer);

impl Write for Writer {
    #[inline]
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.write_all(bytes).map(|()| bytes.len())
    }

    #[inline]
    fn write_all(&mut self, bytes: &[u8]) -> io::Result<()> {
        let length = self.0.memory.len() + bytes.len();
        if length > BUFFER_BYTES && self.0.place.is_some() {
            self.0 = self.0.outgrown(length);
        }
        self.0.memory.extend_from_slice(bytes);
        Ok(())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// A buffer in use; it goes back to its thread when this is dropped, at a panic of the payload's own code too.
struct Buffer {
    memory: BytesMut,
    /// Its place among the thread's; `None` if it is not one of them, and grows as it must.
    place: Option<usize>,
}

impl Buffer {
    fn take() -> Self {
        Self::of_thread().unwrap_or_else(|| Self { memory: BytesMut::with_capacity(SHORT), place: None })
    }

    /// One of the thread's, if one is free.
    fn of_thread() -> Option<Self> {
        // A thread that ends has none any more.
        BUFFERS.try_with(|buffers| buffers.borrow_mut().take()).ok().flatten()
    }

    /// Other memory with what was written so far, and room for `length` bytes in all.
    #[cold]
    fn outgrown(&self, length: usize) -> Self {
        let mut memory = BytesMut::with_capacity(length);
        memory.extend_from_slice(&self.memory);
        Self { memory, place: None }
    }

    /// What was written. It keeps the buffer from being used again as long as it lives.
    fn cut(&mut self) -> BytesMut {
        if self.place.is_some() { self.memory.split() } else { std::mem::take(&mut self.memory) }
    }
}

impl Drop for Buffer {
    fn drop(&mut self) {
        let Some(place) = self.place else { return };
        let mut memory = std::mem::take(&mut self.memory);
        memory.clear();
        // A thread that ends has none any more.
        let _ = BUFFERS.try_with(|buffers| buffers.borrow_mut().all[place] = memory);
    }
}

/// The buffers of a thread.
struct Buffers {
    /// Those in use now are empty and have no room.
    all: Vec<BytesMut>,
    /// Which one has its turn when the first few are all in use.
    next: usize,
}

impl Buffers {
    /// A free buffer, or a new one if there may be more.
    fn take(&mut self) -> Option<Buffer> {
        let found = self.free().or_else(|| self.added());
        found.map(|place| Buffer { memory: std::mem::take(&mut self.all[place]), place: Some(place) })
    }

    fn free(&mut self) -> Option<usize> {
        let first = (0..self.all.len().min(FIRST)).find(|place| self.is_free(*place));
        first.or_else(|| (0..IN_TURN).find_map(|_| self.in_turn()))
    }

    /// The buffer that has its turn, if it is free. The turn goes on in any case.
    fn in_turn(&mut self) -> Option<usize> {
        let place = self.next;
        self.next = if place + 1 < self.all.len() { place + 1 } else { FIRST };
        (place < self.all.len() && self.is_free(place)).then_some(place)
    }

    fn is_free(&mut self, place: usize) -> bool {
        self.all[place].try_reclaim(BUFFER_BYTES)
    }

    fn added(&mut self) -> Option<usize> {
        let place = self.all.len();
        (place < BUFFERS_MAX).then(|| {
            self.all.push(BytesMut::with_capacity(BUFFER_BYTES));
            place
        })
    }
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;

    use super::*;

    fn payload(byte: u8, length: usize) -> Bytes {
        written(|writer| writer.write_all(&vec![byte; length])).unwrap()
    }

    fn buffers() -> usize {
        BUFFERS.with(|buffers| buffers.borrow().all.len())
    }

    #[test]
    fn a_payload_that_has_ended_leaves_its_memory_to_the_next() {
        let first = payload(1, 1000);
        let place = first.as_ptr();
        drop(first);
        assert_eq!(payload(2, 4096).as_ptr(), place);
        assert_eq!(zeroed(8).as_ptr(), place);
        assert_eq!(copied(&[1; 4096]).as_ptr(), place);
    }

    #[test]
    fn payloads_that_live_at_once_never_share_memory_however_many_they_are() {
        let mut kept = Vec::new();
        for round in 0..3 {
            kept.extend((0..BUFFERS_MAX + 9).map(|n| payload(n as u8, 1 + n * 67)));
            kept.extend((0..9).map(|n| payload(n as u8, 2 * BUFFER_BYTES)));
            kept.extend((0..9).map(|n| copied(&[n as u8; 100])));
            for (n, payload) in kept.iter().enumerate() {
                assert!(payload.iter().all(|byte| *byte == payload[0]), "payload {n} in round {round}");
            }
            assert_eq!(buffers(), BUFFERS_MAX);
            // Each third one ends, so that free buffers lie between used ones.
            let mut number = 0;
            kept.retain(|_| {
                number += 1;
                number % 3 > 0
            });
        }
    }

    #[test]
    fn few_payloads_at_once_use_few_buffers() {
        let mut in_hand = payload(0, 10);
        for n in 1..100 {
            in_hand = payload(n, in_hand.len());
        }
        assert_eq!(buffers(), 2);
    }

    #[test]
    fn a_free_buffer_is_found_between_runs_of_those_in_use() {
        let mut all: Vec<_> = (0..BUFFERS_MAX).map(|_| payload(1, 1000)).collect();
        let places: HashSet<_> = all.iter().map(|payload| payload.as_ptr()).collect();
        let mut place = 0;
        all.retain(|_| {
            place += 1;
            place <= FIRST || place % IN_TURN != 0
        });
        for _ in all.len()..BUFFERS_MAX {
            all.push(payload(2, 1000));
        }
        assert!(
            all.iter().all(|payload| places.contains(&payload.as_ptr())),
            "memory was allocated while a buffer was free"
        );
    }

    #[test]
    fn a_payload_of_any_length_is_what_was_written() {
        for length in [0, 1, BUFFER_BYTES - 1, BUFFER_BYTES, BUFFER_BYTES + 1, 100_000] {
            let bytes: Vec<u8> = (0..length).map(|n| n as u8).collect();
            let (head, tail) = bytes.split_at(length / 3);
            let payload = written(|writer| writer.write_all(head).and_then(|()| writer.write_all(tail)));
            assert_eq!(payload.unwrap(), bytes);
            assert_eq!(zeroed(length), vec![0; length]);
            assert_eq!(copied(&bytes), bytes);
        }
        assert_eq!(buffers(), 1);
    }

    #[test]
    fn a_payload_whose_own_code_sends_or_panics_costs_no_buffer() {
        let outer = written(|writer| {
            writer.write_all(b"outer")?;
            assert_eq!(payload(7, 3), [7, 7, 7][..]);
            writer.write_all(b" whole")
        });
        assert_eq!(outer.unwrap(), b"outer whole"[..]);
        let panics =
            || written(|writer| writer.write_all(b"lost").map(|()| panic!("a fault of the payload's")));
        for _ in 0..9 {
            let panicked = std::panic::catch_unwind(|| panics().map_err(|error: io::Error| error.kind()));
            assert!(panicked.is_err());
        }
        assert_eq!(payload(1, 2), [1, 1][..]);
        assert_eq!(buffers(), 2);
    }
}
