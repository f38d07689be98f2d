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
//! Whatever the timing, S3 sees W1 or W3 sees S1: the two fences have an order. The waker cannot clear the
//! sleeper's word (the memory is not its own), so it records the number for which it has rung, and rings once
//! for each.
//!
//! A sleeper for a set of rings announces to all of them in one place (`wait_set.rs`). Its number names the place
//! of its wake: 4k+1 for the bell of all its peers, 4k+3 for each peer's own word (`any.rs`), 4k while awake.

use std::sync::atomic::Ordering;

use crate::{
    layout::Word,
    memory::{OwnHeader, Peer, fence},
};

/// The place at which a sleeper is woken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum WakePlace {
    /// The bell that it gave its peers, perhaps the same to all of them: any of them can write it.
    Bell,
    /// The word in the waker's own region, which only the waker can write.
    Own,
}

const ASLEEP: u32 = 1;
const AT_OWN: u32 = 2;
const STEP: u32 = 4;

/// The number that announces the sleep after `number`.
pub(crate) const fn asleep_after(number: u32, wake_place: WakePlace) -> u32 {
    let at = match wake_place {
        WakePlace::Bell => 0,
        WakePlace::Own => AT_OWN,
    };
    (number & !(STEP - 1)).wrapping_add(STEP) | ASLEEP | at
}

/// The number that announces the end of the sleep `number`.
pub(crate) const fn awake_after(number: u32) -> u32 {
    number & !(STEP - 1)
}

/// The fence between the announcement of a sleep and the next check.
pub(crate) fn fence_before_recheck() {
    // SYNC: S2, with W2 in `Waking::needs_ring`.
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

    /// Announces that this side is about to sleep. The awaited state must be checked again after this.
    pub(crate) fn announce(&mut self, own: &impl OwnHeader) {
        self.announce_unfenced(own);
        fence_before_recheck();
    }

    /// The same, without the fence.
    pub(crate) fn announce_unfenced(&mut self, own: &impl OwnHeader) {
        self.number = asleep_after(self.number, WakePlace::Bell);
        own.store(self.word, self.number, Ordering::Relaxed);
    }

    /// Announces that this side is awake. If the waker sees this late, it rings without effect, which is
    /// harmless.
    pub(crate) fn end(&mut self, own: &impl OwnHeader) {
        if self.number & ASLEEP != 0 {
            own.store(self.word, awake_after(self.number), Ordering::Relaxed);
            self.number &= !ASLEEP;
        }
    }
}

/// The other side's sleep, and the number that this side last rang for.
#[derive(Debug)]
pub(crate) struct Waking {
    word: Word,
    rung_for: u32,
}

impl Waking {
    pub(crate) const fn new(word: Word) -> Self {
        Self { word, rung_for: 0 }
    }

    /// Whether the other side must be woken for the last store: then the caller rings.
    pub(crate) fn needs_ring(&mut self, peer: &impl Peer) -> bool {
        // SYNC: W2, with S2 in `Sleep::announce`.
        fence(Ordering::SeqCst);
        let number = peer.load(self.word);
        let needs_ring = number & ASLEEP != 0 && number != self.rung_for;
        if needs_ring {
            self.rung_for = number;
        }
        needs_ring
    }

    /// The number for which a ring was due last.
    pub(crate) const fn rung_for(&self) -> u32 {
        self.rung_for
    }

    /// The place of the other side's sleep for which a ring was due last.
    pub(crate) const fn wake_place(&self) -> WakePlace {
        if self.rung_for & AT_OWN == 0 { WakePlace::Bell } else { WakePlace::Own }
    }
}
