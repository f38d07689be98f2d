//! Memory for payloads: a few buffers per thread, each reused as soon as the payload in it is dropped.
//!
//! A payload is shared by reference count, so dropping its last reference on any thread frees its buffer:
//! nothing is sent back. A payload that is kept for long keeps its buffer. The thread then creates others, up
//! to a bound; after that, memory is allocated for each payload. Copies of a burst share a buffer, which is reused
//! when all of them have ended.

use std::{
    cell::RefCell,
    io::{self, Write},
};

use bytes::{Bytes, BytesMut};

use super::long;

/// Length of a buffer in bytes: a payload of 4 KiB and its MessagePack overhead.
const BUFFER_BYTES: usize = 4 * 1024 + 256;
/// Maximum number of buffers per thread. Further concurrent payloads are allocated one by one.
const BUFFERS_MAX: usize = 64;
/// Number of buffers that are checked first: with few concurrent payloads the same few are used, which are in
/// the cache.
const FIRST: usize = 4;
/// Number of buffers that are checked after those, different ones each time. Payloads mostly end in the order
/// of their creation: two checks are enough for those that end one by one. When bursts end out of order, runs
/// of used buffers lie between free ones.
const IN_TURN: usize = 8;
/// Number of payloads for which the next buffer in turn is checked before the first few, after a payload that
/// found these used. A session keeps each payload until it is acknowledged, so they are used nearly always.
const CROWDED: u8 = 16;
/// Least initial bytes of an allocation for one payload.
const SHORT: usize = 128;

thread_local! {
    static BUFFERS: RefCell<Buffers> = const {
        RefCell::new(Buffers { all: Vec::new(), next: FIRST, crowded: 0, last_copied: 0, alone: [SHORT; 2] })
    };
}

/// Returns the bytes that `write` writes.
pub(super) fn written<E>(write: impl FnOnce(&mut Writer) -> Result<(), E>) -> Result<Bytes, E> {
    let mut writer = Writer(Buffer::take());
    write(&mut writer)?;
    Ok(writer.0.cut().freeze())
}

/// Returns a payload that is a copy of these bytes.
pub(super) fn copied(bytes: &[u8]) -> Bytes {
    if bytes.is_empty() || bytes.len() > BUFFER_BYTES {
        return Bytes::copy_from_slice(bytes);
    }
    // A thread at its end may have destroyed this variable.
    let copy = BUFFERS.try_with(|buffers| buffers.borrow_mut().copied(bytes)).ok().flatten();
    copy.unwrap_or_else(|| Bytes::copy_from_slice(bytes))
}

/// Returns zeroed memory for a payload of `length` bytes: a buffer of this thread, if one is free.
#[must_use]
pub fn zeroed(length: usize) -> BytesMut {
    if length > BUFFER_BYTES {
        return long::zeroed(length);
    }
    if length == 0 {
        return BytesMut::new();
    }
    let Some(mut buffer) = Buffer::of_thread() else { return BytesMut::zeroed(length) };
    buffer.memory.resize(length, 0);
    buffer.cut()
}

/// Returns a payload of `length` bytes, which are zeros that `fill` replaces.
pub(super) fn filled(length: usize, fill: impl FnOnce(&mut [u8])) -> Bytes {
    let mut payload = zeroed(length);
    fill(&mut payload);
    payload.freeze()
}

/// A writer that appends to a buffer.
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

/// A buffer in use. It returns to its thread when this is dropped, also after a panic of the payload's own code.
struct Buffer {
    memory: BytesMut,
    /// The index of the buffer in its thread; `None` if it belongs to no thread, and grows as needed.
    place: Option<usize>,
}

impl Buffer {
    /// Returns a buffer of the thread, or memory of its own if none is free.
    fn take() -> Self {
        let taken = BUFFERS.try_with(|buffers| {
            let mut buffers = buffers.borrow_mut();
            buffers.take().ok_or_else(|| buffers.expected_length())
        });
        // A thread at its end may have destroyed this variable.
        let length = match taken {
            Ok(Ok(buffer)) => return buffer,
            Ok(Err(length)) => length,
            Err(_) => SHORT,
        };
        Self { memory: BytesMut::with_capacity(length), place: None }
    }

    /// Returns a buffer of the thread, if one is free.
    fn of_thread() -> Option<Self> {
        // A thread at its end may have destroyed this variable.
        BUFFERS.try_with(|buffers| buffers.borrow_mut().take()).ok().flatten()
    }

    /// Returns new memory with the bytes written so far, and room for `length` bytes in all.
    #[cold]
    fn outgrown(&self, length: usize) -> Self {
        let mut memory = BytesMut::with_capacity(length);
        memory.extend_from_slice(&self.memory);
        Self { memory, place: None }
    }

    /// Splits off the written bytes. They keep the buffer from being reused while they exist.
    fn cut(&mut self) -> BytesMut {
        if self.place.is_some() {
            return self.memory.split();
        }
        let memory = std::mem::take(&mut self.memory);
        // A thread at its end may have destroyed this variable.
        let _ = BUFFERS.try_with(|buffers| buffers.borrow_mut().note_alone(memory.len()));
        memory
    }
}

impl Drop for Buffer {
    fn drop(&mut self) {
        let Some(place) = self.place else { return };
        let mut memory = std::mem::take(&mut self.memory);
        memory.clear();
        // A thread at its end may have destroyed this variable.
        let _ = BUFFERS.try_with(|buffers| buffers.borrow_mut().all[place] = memory);
    }
}

/// The buffers of a thread.
struct Buffers {
    /// Buffers in use are empty and have no capacity here.
    all: Vec<BytesMut>,
    /// The buffer to check next when the first few are all in use.
    next: usize,
    /// The number of payloads for which that one is checked before the first few.
    crowded: u8,
    /// The buffer of the last copied payload.
    last_copied: usize,
    /// The lengths in bytes of the last two payloads with memory of their own.
    alone: [usize; 2],
}

impl Buffers {
    /// Returns the initial bytes of memory for one payload. In a burst of payloads of one length, this is their
    /// length, so that the memory does not have to grow. Of two lengths it is the smaller one: of short payloads
    /// behind long ones only the first keeps more memory than it needs, at most [`BUFFER_BYTES`].
    fn expected_length(&self) -> usize {
        self.alone[0].min(self.alone[1]).clamp(SHORT, BUFFER_BYTES)
    }

    fn note_alone(&mut self, length: usize) {
        self.alone = [length, self.alone[0]];
    }

    /// Takes a buffer, while code of the payload's type writes to it.
    fn take(&mut self) -> Option<Buffer> {
        let place = self.place()?;
        Some(Buffer { memory: std::mem::take(&mut self.all[place]), place: Some(place) })
    }

    /// Returns a copy of these bytes, at most [`BUFFER_BYTES`]. The buffer stays at its place.
    fn copied(&mut self, bytes: &[u8]) -> Option<Bytes> {
        let place = self.place_of_copy(bytes.len())?;
        self.last_copied = place;
        let memory = &mut self.all[place];
        memory.extend_from_slice(bytes);
        Some(memory.split().freeze())
    }

    /// Returns the index of a buffer with room for `length` bytes. While the first few are used, the buffer of the
    /// last copy is filled to its end, because the copies of a burst mostly end together.
    fn place_of_copy(&mut self, length: usize) -> Option<usize> {
        if self.crowded == 0
            && let Some(first) = self.first_free()
        {
            return Some(first);
        }
        if self.all.get(self.last_copied).is_some_and(|memory| memory.capacity() >= length) {
            self.crowded = self.crowded.checked_sub(1).unwrap_or(CROWDED);
            return Some(self.last_copied);
        }
        self.place()
    }

    /// Returns the index of a free buffer, or of a new one below the maximum.
    fn place(&mut self) -> Option<usize> {
        self.free().or_else(|| self.added())
    }

    fn free(&mut self) -> Option<usize> {
        if self.crowded > 0 {
            self.crowded -= 1;
            if let Some(place) = self.in_turn() {
                return Some(place);
            }
        }
        self.first_free().or_else(|| {
            let found = (0..IN_TURN).find_map(|_| self.in_turn());
            self.crowded = if found.is_some() { CROWDED } else { 0 };
            found
        })
    }

    /// Returns the index of a free buffer of the first few.
    fn first_free(&mut self) -> Option<usize> {
        (0..self.all.len().min(FIRST)).find(|place| self.is_free(*place))
    }

    /// Returns the index of the next buffer to check, if it is free. Advances in any case.
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
    use std::collections::{HashSet, VecDeque};

    use super::*;

    fn payload(byte: u8, length: usize) -> Bytes {
        written(|writer| writer.write_all(&vec![byte; length])).unwrap()
    }

    fn buffers() -> usize {
        BUFFERS.with(|buffers| buffers.borrow().all.len())
    }

    #[test]
    fn freed_payload_memory_is_reused() {
        let first = payload(1, 1000);
        let place = first.as_ptr();
        drop(first);
        assert_eq!(payload(2, 4096).as_ptr(), place);
        assert_eq!(zeroed(8).as_ptr(), place);
        assert_eq!(copied(&[1; 4096]).as_ptr(), place);
    }

    #[test]
    fn live_payloads_never_share_memory() {
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
    fn first_buffers_are_used_again_after_a_crowd() {
        let mut live: VecDeque<_> = (0..10).map(|_| payload(1, 1000)).collect();
        let first: Vec<_> = live.iter().take(FIRST).map(|payload| payload.as_ptr()).collect();
        for _ in 0..100 {
            live.push_back(payload(2, 1000));
            live.pop_front();
        }
        assert_eq!(buffers(), 11, "a free one was not found");
        live.clear();
        for _ in 0..CROWDED {
            let _ = payload(3, 1000);
        }
        assert!(first.contains(&payload(4, 1000).as_ptr()));
    }

    #[test]
    fn copies_of_a_burst_share_buffers() {
        let copies: Vec<_> = (0..200).map(|n| copied(&[n; 1000])).collect();
        assert!(copies.iter().zip(0..).all(|(copy, n)| copy[..] == [n; 1000]));
        assert!(buffers() < 60, "{} buffers for 200 copies, of which four fit in each", buffers());
        // A buffer is free only after its last copy.
        let (places, all) = (copies.iter().map(|copy| copy.as_ptr()).collect::<HashSet<_>>(), buffers());
        let kept: Vec<_> = copies.into_iter().skip(3).step_by(4).collect();
        let later: Vec<_> = (0..100).map(|_| copied(&[9; 1000])).collect();
        assert!(kept.iter().zip((3..).step_by(4)).all(|(copy, n)| copy[..] == [n; 1000]));
        assert!(places.len() == 200 && later.iter().all(|copy| copy[..] == [9; 1000]) && buffers() >= all);
        drop((kept, later));
        for _ in 0..=CROWDED {
            let _ = copied(&[1; 1000]);
        }
        let place = copied(&[1; 1000]).as_ptr();
        assert_eq!(copied(&[1; 1000]).as_ptr(), place, "a single copy uses the first buffer again");
    }

    #[test]
    fn free_buffer_is_found_between_used_ones() {
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
    fn payloads_beyond_the_buffers_get_the_memory_they_need() {
        let _used: Vec<_> = (0..BUFFERS_MAX).map(|_| payload(1, 1000)).collect();
        let capacity = || {
            let writer = Writer(Buffer::take());
            assert!(writer.0.place.is_none());
            writer.0.memory.capacity()
        };
        assert_eq!(capacity(), SHORT);
        let _first = payload(1, 1000);
        assert_eq!(capacity(), SHORT, "a single long one");
        let _second = payload(1, 900);
        assert_eq!(capacity(), 900);
        let _short = payload(1, 10);
        assert_eq!(capacity(), SHORT);
        let _long = [payload(1, 100_000), payload(1, 100_000)];
        assert_eq!(capacity(), BUFFER_BYTES);
    }

    #[test]
    fn payload_of_any_length_round_trips() {
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
    fn payload_code_that_sends_or_panics_leaks_no_buffer() {
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
