//! Memory for long payloads: a thread keeps two buffers, each of which is used again once nobody holds the payload that was in it.
//!
//! An allocator gives memory of that length back to the system each time, so that every page of the next payload is a fault:
//! that cost more than all copies of it.

use std::cell::RefCell;

use bytes::BytesMut;

/// Memory of shorter payloads an allocator keeps by itself.
const SHORTEST: usize = 64 * 1024;
/// The longest buffer that is kept: a payload of 1 MiB, with its header.
const LONGEST: usize = 1024 * 1024 + 4096;
/// Buffers of one thread: for one payload that has come, and one that is being made.
const BUFFERS_MAX: usize = 2;

thread_local! {
    static KEPT: RefCell<Kept> = const { RefCell::new(Kept(Vec::new())) };
}

/// Empty memory with room for `length` bytes, and less than for twice as many.
pub(super) fn with_room(length: usize) -> BytesMut {
    kept(length).unwrap_or_else(|| BytesMut::with_capacity(length))
}

/// Zeroed memory of `length` bytes.
pub(super) fn zeroed(length: usize) -> BytesMut {
    let Some(mut memory) = kept(length) else { return BytesMut::zeroed(length) };
    memory.resize(length, 0);
    memory
}

fn kept(length: usize) -> Option<BytesMut> {
    if !(SHORTEST..=LONGEST).contains(&length) {
        return None;
    }
    // A thread that ends has none any more.
    KEPT.try_with(|kept| kept.borrow_mut().take(length)).ok().flatten()
}

/// The buffers of a thread.
struct Kept(Vec<Buffer>);

struct Buffer {
    /// Its handle. It has no room itself while a payload has the memory.
    memory: BytesMut,
    /// How much memory that is.
    bytes: usize,
}

impl Kept {
    /// Memory of one that nobody holds, or of a new one if there may be more.
    fn take(&mut self, length: usize) -> Option<BytesMut> {
        let fits = |buffer: &Buffer| (length..length * 2).contains(&buffer.bytes);
        let found = self.0.iter_mut().position(|buffer| fits(buffer) && buffer.is_free());
        let place = found.or_else(|| self.place_for(length))?;
        // The handle stays, without room of its own.
        Some(self.0[place].memory.split_off(0))
    }

    /// Where a new one is, in the place of one that does not fit if there must not be more; `None` if all are held.
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
        KEPT.with(|kept| kept.borrow().0.iter().map(|buffer| buffer.bytes).collect())
    }

    #[test]
    fn a_long_payload_that_has_ended_leaves_its_memory_to_the_next_of_about_its_length() {
        let first = payload(1, 1 << 20);
        let place = first.as_ptr();
        drop(first);
        assert_eq!(payload(2, 1 << 20).as_ptr(), place);
        assert_eq!(payload(3, 600_000).as_ptr(), place);
        assert_ne!(payload(4, 100_000).as_ptr(), place, "it would keep ten times its length");
        assert_eq!(buffers(), [1 << 20, 100_000]);
    }

    #[test]
    fn long_payloads_that_live_at_once_never_share_memory_and_few_of_them_are_kept() {
        let payloads: Vec<_> = (0..9).map(|n| payload(n, 100_000 * (1 + usize::from(n) % 3))).collect();
        for (n, payload) in (0..).zip(&payloads) {
            assert!(payload.iter().all(|byte| *byte == n), "payload {n}");
        }
        drop(payloads);
        assert_eq!(buffers(), [100_000, 200_000]);
    }

    #[test]
    fn what_does_not_fit_gives_its_place_to_what_is_needed_now() {
        drop((payload(1, 100_000), payload(2, 100_000)));
        let last = payload(3, 1_000_000);
        assert_eq!(buffers(), [1_000_000, 100_000]);
        drop(last);
        assert!(zeroed(1_000_000).iter().all(|byte| *byte == 0), "what was in it is gone");
        assert_eq!((payload(4, 10).len(), payload(5, 3 << 20).len()), (10, 3 << 20));
        assert_eq!(buffers(), [1_000_000, 100_000], "neither short nor very long ones are kept");
    }
}
