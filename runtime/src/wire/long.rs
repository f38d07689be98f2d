//! Memory for long payloads: a thread keeps two buffers, each reused once the payload in it is dropped.
//!
//! An allocator returns memory of that length to the system each time, so that every page of the next payload
//! causes a fault. That cost more than all copies of the payload.

use std::cell::RefCell;

use bytes::BytesMut;

/// Minimum length: the allocator itself keeps memory of shorter payloads.
const SHORTEST: usize = 64 * 1024;
/// Maximum length of a reused buffer: a payload of 1 MiB, with its header.
const LONGEST: usize = 1024 * 1024 + 4096;
/// Number of buffers per thread: for one received payload, and one under construction.
const BUFFERS_MAX: usize = 2;

thread_local! {
    static BUFFERS: RefCell<Buffers> = const { RefCell::new(Buffers(Vec::new())) };
}

/// Returns empty memory with room for `length` bytes, and less than for twice as many.
pub(super) fn with_room(length: usize) -> BytesMut {
    reuse(length).unwrap_or_else(|| BytesMut::with_capacity(length))
}

/// Returns zeroed memory of `length` bytes.
pub(super) fn zeroed(length: usize) -> BytesMut {
    let Some(mut memory) = reuse(length) else { return BytesMut::zeroed(length) };
    memory.resize(length, 0);
    memory
}

fn reuse(length: usize) -> Option<BytesMut> {
    if !(SHORTEST..=LONGEST).contains(&length) {
        return None;
    }
    // A thread at its end may have destroyed this variable.
    BUFFERS.try_with(|buffers| buffers.borrow_mut().take(length)).ok().flatten()
}

/// The buffers of a thread.
struct Buffers(Vec<Buffer>);

struct Buffer {
    /// The handle of the memory. It has no capacity itself while a payload has the memory.
    memory: BytesMut,
    /// The size of the memory.
    bytes: usize,
}

impl Buffers {
    /// Returns the memory of a free buffer, or of a new one below the maximum.
    fn take(&mut self, length: usize) -> Option<BytesMut> {
        let fits = |buffer: &Buffer| (length..length * 2).contains(&buffer.bytes);
        let found = self.0.iter_mut().position(|buffer| fits(buffer) && buffer.is_free());
        let place = found.or_else(|| self.place_for(length))?;
        // The handle stays, without capacity of its own.
        Some(self.0[place].memory.split_off(0))
    }

    /// Returns the index of a new buffer, which replaces a free one at the maximum. `None` if all are in use.
    fn place_for(&mut self, length: usize) -> Option<usize> {
        let place = if self.0.len() < BUFFERS_MAX {
            self.0.push(Buffer { memory: BytesMut::new(), bytes: 0 });
            self.0.len() - 1
        } else {
            self.0.iter_mut().position(Buffer::is_free)?
        };
        self.0[place] = Buffer { memory: BytesMut::with_capacity(length), bytes: length };
        Some(place)
    }
}

impl Buffer {
    fn is_free(&mut self) -> bool {
        self.memory.try_reclaim(self.bytes)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn payload(byte: u8, length: usize) -> bytes::Bytes {
        let mut memory = with_room(length);
        assert!(memory.is_empty() && (length..length * 2).contains(&memory.capacity()), "{length}");
        memory.resize(length, byte);
        memory.freeze()
    }

    fn buffers() -> Vec<usize> {
        BUFFERS.with(|buffers| buffers.borrow().0.iter().map(|buffer| buffer.bytes).collect())
    }

    #[test]
    fn freed_long_payload_memory_is_reused_for_similar_lengths() {
        let first = payload(1, 1 << 20);
        let place = first.as_ptr();
        drop(first);
        assert_eq!(payload(2, 1 << 20).as_ptr(), place);
        assert_eq!(payload(3, 600_000).as_ptr(), place);
        assert_ne!(payload(4, 100_000).as_ptr(), place, "it would keep ten times its length");
        assert_eq!(buffers(), [1 << 20, 100_000]);
    }

    #[test]
    fn long_payloads_never_share_memory_and_few_are_kept() {
        let payloads: Vec<_> = (0..9).map(|n| payload(n, 100_000 * (1 + usize::from(n) % 3))).collect();
        for (n, payload) in (0..).zip(&payloads) {
            assert!(payload.iter().all(|byte| *byte == n), "payload {n}");
        }
        drop(payloads);
        assert_eq!(buffers(), [100_000, 200_000]);
    }

    #[test]
    fn unsuitable_buffer_is_replaced_by_a_needed_one() {
        drop((payload(1, 100_000), payload(2, 100_000)));
        let last = payload(3, 1_000_000);
        assert_eq!(buffers(), [1_000_000, 100_000]);
        drop(last);
        assert!(zeroed(1_000_000).iter().all(|byte| *byte == 0), "what was in it is gone");
        assert_eq!((payload(4, 10).len(), payload(5, 3 << 20).len()), (10, 3 << 20));
        assert_eq!(buffers(), [1_000_000, 100_000], "neither short nor very long ones are reused");
    }
}
