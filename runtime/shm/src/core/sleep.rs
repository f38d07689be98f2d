//! Sleeping and waking: a system call is made only when the other side sleeps, and no wake is lost.
//!
//! Sleeper and waker each write one word and read the other's, with a full fence between:
//!
//! ```text
//! sleeper                         waker
//! S1 sleep := next odd number     W1 tail := more            (or head)
//! S2 full fence                   W2 full fence
//! S3 look at tail again           W3 look at sleep: odd, and not the one rung for last?
//! S4 nothing new: sleep           W4 ring
//! ```
//!
//! Whatever the timing, S3 sees W1 or W3 sees S1: the two fences have an order. The waker cannot clear the sleeper's word
//! (the memory is not its own), so it remembers for which number it has rung, and rings once for each.

use std::sync::atomic::Ordering;

use crate::{
    layout::Word,
    memory::{OwnHeader, Peer, fence},
};

/// This side's sleep.
#[derive(Debug)]
pub(crate) struct Sleep {
    word: Word,
    number: u32,
}

impl Sleep {
    pub(crate) const fn new(word: Word) -> Self {
        Self { word, number: 0 }
    }

    /// Says that this side is about to sleep. What it waits for has to be looked at again after this.
    pub(crate) fn announce(&mut self, own: &impl OwnHeader) {
        self.number = self.number.wrapping_add(1) | 1;
        own.store(self.word, self.number, Ordering::Relaxed);
        // SYNC: S2, with W2 in `Waking::is_owed`.
        fence(Ordering::SeqCst);
    }

    /// Says that this side is awake. When the waker sees this late, it rings in vain, which harms nobody.
    pub(crate) fn end(&mut self, own: &impl OwnHeader) {
        if self.number % 2 == 1 {
            self.number = self.number.wrapping_add(1);
            own.store(self.word, self.number, Ordering::Relaxed);
        }
    }
}

/// The other side's sleep, and what this side has done about it.
#[derive(Debug)]
pub(crate) struct Waking {
    word: Word,
    rung_for: u32,
}

impl Waking {
    pub(crate) const fn new(word: Word) -> Self {
        Self { word, rung_for: 0 }
    }

    /// Whether the other side has to be woken for what was just stored: then the caller rings.
    pub(crate) fn is_owed(&mut self, peer: &impl Peer) -> bool {
        // SYNC: W2, with S2 in `Sleep::announce`.
        fence(Ordering::SeqCst);
        let number = peer.load(self.word);
        let owed = number % 2 == 1 && number != self.rung_for;
        if owed {
            self.rung_for = number;
        }
        owed
    }
}
