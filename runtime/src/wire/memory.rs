//! Memory for payloads: a few buffers per thread, each reused as soon as the payload in it is dropped.
//!
//! A payload is shared by reference count, so dropping its last reference on any thread frees its buffer:
//! nothing is sent back. A payload that is kept for long keeps its buffer. The thread then creates others, up
//! to a bound; after that, memory is allocated, for each payload or for several together. Copies of a burst share
//! a buffer, which is reused when all of them have ended.

#[cfg(test)]
mod tests;

use std::{
    cell::RefCell,
    io::{self, Write},
    ops::RangeInclusive,
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
/// Number of payloads with memory of their own or shared memory before the buffers are searched again. In a flood a
/// session keeps hundreds of payloads, and a search finds none of the buffers free.
const FULL: u8 = 16;
/// Least initial bytes of an allocation for one payload.
const SHORT: usize = 128;
/// Lengths in bytes of the payloads that share an allocation of [`BUFFER_BYTES`] while all buffers are used: two to
/// eight of them. A shorter one that is kept for long would keep many times its own length.
const SHARED: RangeInclusive<usize> = BUFFER_BYTES / 8..=BUFFER_BYTES / 2;

thread_local! {
    static BUFFERS: RefCell<Buffers> = const {
        RefCell::new(Buffers {
            all: Vec::new(),
            next: FIRST,
            crowded: 0,
            full: 0,
            last_copied: 0,
            shared: None,
            alone: [SHORT; 2],
        })
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
        if length > self.0.memory.capacity() && self.0.home != Home::Payload {
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
    home: Home,
}

/// The owner of a buffer's memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Home {
    /// The thread, which has the buffer at this index.
    Place(usize),
    /// The thread, for several payloads.
    Shared,
    /// The payload alone; the memory grows as needed.
    Payload,
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
        Self { memory: BytesMut::with_capacity(length), home: Home::Payload }
    }

    /// Returns a buffer of the thread, if one is free.
    fn of_thread() -> Option<Self> {
        // A thread at its end may have destroyed this variable.
        BUFFERS.try_with(|buffers| buffers.borrow_mut().take_own()).ok().flatten()
    }

    /// Returns new memory with the bytes written so far, and room for `length` bytes in all.
    #[cold]
    fn outgrown(&self, length: usize) -> Self {
        let mut memory = BytesMut::with_capacity(length);
        memory.extend_from_slice(&self.memory);
        Self { memory, home: Home::Payload }
    }

    /// Splits off the written bytes. They keep the buffer from being reused while they exist.
    fn cut(&mut self) -> BytesMut {
        let written = match self.home {
            Home::Place(_) => return self.memory.split(),
            Home::Shared => self.memory.split(),
            Home::Payload => std::mem::take(&mut self.memory),
        };
        // A thread at its end may have destroyed this variable.
        let _ = BUFFERS.try_with(|buffers| buffers.borrow_mut().note_alone(written.len()));
        written
    }
}

impl Drop for Buffer {
    fn drop(&mut self) {
        if self.home == Home::Payload {
            return;
        }
        let mut memory = std::mem::take(&mut self.memory);
        memory.clear();
        // A thread at its end may have destroyed this variable.
        let _ = BUFFERS.try_with(|buffers| buffers.borrow_mut().put_back(self.home, memory));
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
    /// The number of payloads for which no buffer is searched.
    full: u8,
    /// The rest of the memory that several payloads share.
    shared: Option<BytesMut>,
    /// The buffer of the last copied payload.
    last_copied: usize,
    /// The lengths in bytes of the last two payloads that were written to no buffer.
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

    /// Takes a buffer or shared memory, while code of the payload's type writes to it.
    fn take(&mut self) -> Option<Buffer> {
        self.take_own().or_else(|| {
            let memory = self.take_shared(self.expected_length())?;
            Some(Buffer { memory, home: Home::Shared })
        })
    }

    /// Takes a buffer.
    fn take_own(&mut self) -> Option<Buffer> {
        let place = self.place()?;
        Some(Buffer { memory: std::mem::take(&mut self.all[place]), home: Home::Place(place) })
    }

    /// Takes the memory that payloads share, with room for `length` bytes; `None` if no payload of this length shares
    /// memory. Former memory without room is freed with its last payload.
    fn take_shared(&mut self, length: usize) -> Option<BytesMut> {
        let has_room = |memory: &BytesMut| memory.capacity() >= length;
        SHARED.contains(&length).then(|| {
            self.shared.take().filter(has_room).unwrap_or_else(|| BytesMut::with_capacity(BUFFER_BYTES))
        })
    }

    /// Takes memory back. While code of a payload sends another one, two have shared memory: that with more room stays.
    fn put_back(&mut self, home: Home, memory: BytesMut) {
        match home {
            Home::Place(place) => self.all[place] = memory,
            Home::Shared if self.shared.as_ref().is_none_or(|other| other.capacity() < memory.capacity()) => {
                self.shared = Some(memory);
            }
            Home::Shared | Home::Payload => {}
        }
    }

    /// Returns a copy of these bytes, at most [`BUFFER_BYTES`]. The buffer stays at its place.
    fn copied(&mut self, bytes: &[u8]) -> Option<Bytes> {
        let Some(place) = self.place_of_copy(bytes.len()) else {
            let mut memory = self.take_shared(bytes.len())?;
            memory.extend_from_slice(bytes);
            let copy = memory.split().freeze();
            self.shared = Some(memory);
            return Some(copy);
        };
        self.last_copied = place;
        let memory = &mut self.all[place];
        memory.extend_from_slice(bytes);
        Some(memory.split().freeze())
    }

    /// Returns the index of a buffer with room for `length` bytes. While the first few are used, the buffer of the
    /// last copy is filled to its end, because the copies of a burst mostly end together.
    fn place_of_copy(&mut self, length: usize) -> Option<usize> {
        let last_has_room = self.all.get(self.last_copied).is_some_and(|memory| memory.capacity() >= length);
        if self.full > 0 {
            self.full -= 1;
            return last_has_room.then_some(self.last_copied);
        }
        if self.crowded == 0
            && let Some(first) = self.first_free()
        {
            return Some(first);
        }
        if last_has_room {
            self.crowded = self.crowded.checked_sub(1).unwrap_or(CROWDED);
            return Some(self.last_copied);
        }
        self.place()
    }

    /// Returns the index of a free buffer, or of a new one below the maximum. After a search that found none, there
    /// is none for the next few payloads.
    fn place(&mut self) -> Option<usize> {
        if self.full > 0 {
            self.full -= 1;
            return None;
        }
        let place = self.free().or_else(|| self.added());
        self.full = if place.is_none() { FULL } else { 0 };
        place
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
