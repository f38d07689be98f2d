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
//!
//! Who sleeps for many rings announces to all of them and fences once. Its number says by what it is woken: by the bell of all its peers,
//! or by each peer's own word (`any.rs`): 4k+1 and 4k+3 while it sleeps, 4k awake.

use std::sync::atomic::Ordering;

use crate::{
    layout::Word,
    memory::{OwnHeader, Peer, fence},
};

/// By what a sleeper is woken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Ear {
    /// The bell that it gave its peers, perhaps the same to all of them: any of them can write it.
    Bell,
    /// The word in the waker's own region, which nobody else can write.
    Own,
}

const ASLEEP: u32 = 1;
const AT_OWN: u32 = 2;
const STEP: u32 = 4;

/// Between announcing one's sleep and looking again.
pub(crate) fn fence_before_looking_again() {
    // SYNC: S2, with W2 in `Waking::is_owed`.
    fence(Ordering::SeqCst);
}

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
        self.announce_at(Ear::Bell, own);
        fence_before_looking_again();
    }

    /// The same, without the fence.
    pub(crate) fn announce_at(&mut self, ear: Ear, own: &impl OwnHeader) {
        let at = match ear {
            Ear::Bell => 0,
            Ear::Own => AT_OWN,
        };
        self.number = (self.number & !(STEP - 1)).wrapping_add(STEP) | ASLEEP | at;
        own.store(self.word, self.number, Ordering::Relaxed);
    }

    /// Says that this side is awake. When the waker sees this late, it rings in vain, which harms nobody.
    pub(crate) fn end(&mut self, own: &impl OwnHeader) {
        if self.number & ASLEEP != 0 {
            own.store(self.word, self.number & !(STEP - 1), Ordering::Relaxed);
            self.number &= !ASLEEP;
        }
    }

    /// The number that was announced last.
    pub(crate) const fn announced(&self) -> u32 {
        self.number | ASLEEP
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
        let owed = number & ASLEEP != 0 && number != self.rung_for;
        if owed {
            self.rung_for = number;
        }
        owed
    }

    /// The number for which it was owed last.
    pub(crate) const fn rung_for(&self) -> u32 {
        self.rung_for
    }

    /// Where the other side sleeps for which it was owed last.
    pub(crate) const fn ear(&self) -> Ear {
        if self.rung_for & AT_OWN == 0 { Ear::Bell } else { Ear::Own }
    }
}
