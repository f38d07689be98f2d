//! Waiting for many rings as for one.
//!
//! ```text
//! owner's page, which it alone writes:   the announcement of its sleep, for all peers
//! shared page, which all peers write:    the bell, and a bit for each ring
//!
//! owner                                   peer
//! S1 sleep := next odd number             W1 tail := more
//! S2 full fence                           W2 full fence
//! S3 look at the bits                     W3 bit := 1, unless it is
//! S4 none: sleep at the bell              W4 full fence
//!                                         W5 look at sleep: odd, and not the one rung for last?
//!                                         W6 ring
//! ```
//!
//! So a look and a sleep cost the same for one ring and for a hundred. The owner clears the bits, fences, and reads
//! these rings until they are empty. A peer that finds its bit set before that has published its message before the
//! fence, and the owner reads it.
//!
//! A hostile peer can clear the bits of others. Their messages then wait until the owner checks all rings, at the
//! latest at the end of a sleep of 20 ms. Each peer also reports in its own memory that it has set its bit, so the
//! owner detects the loss. It then checks all rings for a while, each time longer (`trust.rs`).

use std::{
    fmt, io,
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicBool, AtomicU32, AtomicUsize, Ordering},
    },
};

use crate::{
    bell::{BellState, Bells},
    consumer::Consumer,
    core::sleep::{WakePlace, asleep_after, awake_after},
    layout::Word,
    memory::{OwnHeader, fence},
    platform,
};

/// Words of bits.
pub(crate) const READY_WORDS: usize = 4;
/// The most rings in a set.
pub(crate) const SLOTS_MAX: usize = 32 * READY_WORDS;

/// A set of rings that one thread waits for: however many they are, it looks at one place and sleeps at one place.
///
/// Regions join it when they are created with [`Bell::Set`](crate::Bell::Set), and leave it when their
/// [`Consumer`] is dropped. At most 128 are in it. Clones are the same set. One thread at a time waits for it and reads
/// its rings.
#[derive(Clone)]
pub struct WaitSet(Arc<Shared>);

struct Shared {
    /// The bell and the bits, which all peers write.
    page: platform::SharedPage,
    /// The announcement, which this side alone writes.
    announcement: platform::Announcement,
    /// The number that was announced last.
    sleep: AtomicU32,
    /// Rings that were reported, and that the owner has not read empty yet. No peer sees them.
    ready: [AtomicU32; READY_WORDS],
    /// Rings that the owner reads.
    open: [AtomicU32; READY_WORDS],
    /// Words of bits up to the last one that ever had an open ring: mostly one.
    words: AtomicUsize,
    /// Whether another thread of this process has work for the owner.
    is_woken: AtomicBool,
    /// The places that are taken.
    slots: Mutex<[u32; READY_WORDS]>,
}

/// The place of a ring in a set. Dropping it makes room for another one.
pub(crate) struct Slot {
    set: WaitSet,
    number: u8,
}

/// The word and the bit of a place.
pub(crate) const fn bit_of(slot: u8) -> (usize, u32) {
    (slot as usize / 32, 1 << (slot % 32))
}

impl WaitSet {
    /// Creates an empty set.
    ///
    /// # Errors
    /// The error of the system.
    pub fn create() -> io::Result<Self> {
        let (page, announcement) = (platform::SharedPage::create()?, platform::Announcement::create()?);
        let (sleep, slots) = (AtomicU32::new(0), Mutex::default());
        let (ready, open) = (Default::default(), Default::default());
        let (words, is_woken) = (AtomicUsize::new(0), AtomicBool::new(false));
        Ok(Self(Arc::new(Shared { page, announcement, sleep, ready, open, words, is_woken, slots })))
    }

    /// Ends the owner's wait, or its next one, from another thread of this process: the owner has something to do
    /// beside its rings.
    pub fn wake(&self) {
        // SYNC: an owner that finds this has a view of all that was done before.
        self.0.is_woken.store(true, Ordering::Release);
        // After the store: an owner that has not found it sleeps at a word that this changes.
        self.0.page.bells().0.ring();
    }

    /// Returns whether [`wake`](Self::wake) was called since the last call. Until then no wait sleeps.
    #[must_use]
    pub fn take_wake(&self) -> bool {
        self.0.is_woken.load(Ordering::Relaxed) && self.0.is_woken.swap(false, Ordering::Acquire)
    }

    /// Sets whether a ring is read from now on. At first it is not: its messages wait, and nothing reports them here.
    pub fn set_open(&self, consumer: &Consumer, is_open: bool) {
        let Some(slot) = consumer.slot() else { return };
        let (word, bit) = bit_of(slot);
        if is_open {
            self.0.open[word].fetch_or(bit, Ordering::Relaxed);
            self.0.words.fetch_max(word + 1, Ordering::Relaxed);
        } else {
            self.0.open[word].fetch_and(!bit, Ordering::Relaxed);
        }
    }

    /// Looks which rings have reported messages since the last look, at one place for all of them. Returns whether any
    /// open ring is to be read: [`ready`](Self::ready), or whether the owner was woken: [`take_wake`](Self::take_wake).
    pub fn look(&self) -> bool {
        let mut any = self.0.is_woken.load(Ordering::Relaxed);
        let words = self.0.ready.iter().zip(&self.0.open).zip(self.0.page.reports());
        for ((ready, open), reported) in words.take(self.0.words.load(Ordering::Relaxed)) {
            let open = open.load(Ordering::Relaxed);
            if open == 0 {
                // What is reported here stays reported until a ring is open.
                continue;
            }
            let mut own = ready.load(Ordering::Relaxed);
            if reported.load(Ordering::Relaxed) != 0 {
                // SYNC: the tails of the peers that have set these bits are visible: `report`.
                own |= reported.swap(0, Ordering::Acquire);
                ready.store(own, Ordering::Relaxed);
                // SYNC: a peer that has found its bit set before the swap fenced before that: its tail is visible, too.
                fence(Ordering::SeqCst);
            }
            any |= own & open != 0;
        }
        any
    }

    /// Returns whether a ring is to be read, by the last look.
    #[must_use]
    pub fn is_ready(&self, consumer: &Consumer) -> bool {
        consumer.slot().is_none_or(|slot| {
            let (word, bit) = bit_of(slot);
            self.0.ready[word].load(Ordering::Relaxed) & bit != 0
        })
    }

    /// Returns the places of the open rings that are to be read, by the last look, as [`Consumer::slot`] has them.
    #[must_use]
    pub fn ready(&self) -> Ready {
        let Shared { ready, open, .. } = &*self.0;
        let bits = |index: usize| ready[index].load(Ordering::Relaxed) & open[index].load(Ordering::Relaxed);
        Ready(std::array::from_fn(bits))
    }

    /// Returns the place of the open ring that is to be read, by the last look, if it is the only one and the owner was
    /// not woken.
    #[must_use]
    pub fn only_ready(&self) -> Option<u8> {
        let Shared { ready, open, words, is_woken, .. } = &*self.0;
        let mut only = None;
        for index in 0..words.load(Ordering::Relaxed) {
            let bits = ready[index].load(Ordering::Relaxed) & open[index].load(Ordering::Relaxed);
            if bits == 0 {
                continue;
            }
            if only.is_some() || !bits.is_power_of_two() {
                return None;
            }
            only = Some(index as u8 * 32 + bits.trailing_zeros() as u8);
        }
        only.filter(|_| !is_woken.load(Ordering::Relaxed))
    }

    /// Records that a ring was read until it was empty.
    #[inline]
    pub fn was_emptied(&self, consumer: &Consumer) {
        if let Some(slot) = consumer.slot() {
            let (word, bit) = bit_of(slot);
            let ready = &self.0.ready[word];
            ready.store(ready.load(Ordering::Relaxed) & !bit, Ordering::Relaxed);
        }
    }

    /// Records that a ring has a message, whether it was reported or not. Returns whether the report was lost.
    pub(crate) fn has_message(&self, consumer: &Consumer) -> bool {
        let Some(slot) = consumer.slot() else { return false };
        let (word, bit) = bit_of(slot);
        let ready = &self.0.ready[word];
        let before = ready.load(Ordering::Relaxed);
        ready.store(before | bit, Ordering::Relaxed);
        before & bit == 0
            && consumer.is_reported()
            && self.0.page.reports()[word].load(Ordering::Relaxed) & bit == 0
    }

    /// Whether any open ring has reported a message since the last look.
    pub(crate) fn has_reports(&self) -> bool {
        let words = self.0.page.reports().iter().zip(&self.0.open);
        words
            .take(self.0.words.load(Ordering::Relaxed))
            .any(|(reported, open)| reported.load(Ordering::Relaxed) & open.load(Ordering::Relaxed) != 0)
    }

    /// Takes a place, and creates the bells of its region. `None` if all places are taken.
    pub(crate) fn join(&self) -> io::Result<Option<Bells>> {
        let Some(slot) = self.take_slot() else { return Ok(None) };
        let (message, room) = self.0.page.bells();
        let buttons = vec![self.0.page.descriptor()?, self.0.announcement.descriptor()?];
        Ok(Some(Bells { message, room, buttons, slot: Some(slot) }))
    }

    fn take_slot(&self) -> Option<Slot> {
        let mut slots = self.0.slots.lock().unwrap_or_else(PoisonError::into_inner);
        let number = (0..SLOTS_MAX as u8).find(|number| {
            let (word, bit) = bit_of(*number);
            slots[word] & bit == 0
        })?;
        let (word, bit) = bit_of(number);
        slots[word] |= bit;
        Some(Slot { set: self.clone(), number })
    }

    /// The word that a ring changes.
    pub(crate) fn bell(&self) -> &AtomicU32 {
        self.0.page.message_word()
    }

    /// The state of the bell, to be read before the sleep is announced.
    pub(crate) fn listen(&self) -> BellState {
        let seen = BellState(self.bell().load(Ordering::Relaxed));
        // SYNC: a ring that is seen here makes the stores before it visible: `FutexBell::ring`.
        fence(Ordering::Acquire);
        seen
    }

    /// Announces a sleep to all peers, without the fence that must follow.
    pub(crate) fn announce(&self, wake_place: WakePlace) {
        let number = asleep_after(self.0.sleep.load(Ordering::Relaxed), wake_place);
        self.0.sleep.store(number, Ordering::Relaxed);
        self.0.announcement.store(Word::ConsumerSleep, number, Ordering::Relaxed);
    }

    /// The number that was announced last.
    pub(crate) fn announced(&self) -> u32 {
        self.0.sleep.load(Ordering::Relaxed)
    }

    /// Announces that this side is awake.
    pub(crate) fn withdraw(&self) {
        let number = awake_after(self.announced());
        self.0.announcement.store(Word::ConsumerSleep, number, Ordering::Relaxed);
    }
}

/// The places of rings that are to be read.
#[derive(Clone, Copy, Debug)]
pub struct Ready([u32; READY_WORDS]);

impl Iterator for Ready {
    type Item = u8;

    fn next(&mut self) -> Option<u8> {
        let index = self.0.iter().position(|bits| *bits != 0)?;
        let bits = &mut self.0[index];
        let slot = index as u32 * 32 + bits.trailing_zeros();
        *bits &= *bits - 1;
        Some(slot as u8)
    }
}

impl fmt::Debug for WaitSet {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("WaitSet").finish_non_exhaustive()
    }
}

impl Slot {
    pub(crate) const fn number(&self) -> u8 {
        self.number
    }
}

impl Drop for Slot {
    fn drop(&mut self) {
        let (word, bit) = bit_of(self.number);
        let Shared { ready, open, slots, .. } = &*self.set.0;
        for words in [ready, open] {
            words[word].fetch_and(!bit, Ordering::Relaxed);
        }
        slots.lock().unwrap_or_else(PoisonError::into_inner)[word] &= !bit;
    }
}

/// Reports to the owner of a set that a ring has a message: called after the store of its tail.
/// `is_set` loads the bit, relaxed, and `set` sets it, with release.
pub(crate) fn report(is_set: impl FnOnce() -> bool, set: impl FnOnce()) {
    // SYNC: W2. If the bit is found set, the owner has not cleared it yet, and its fence after that comes after this
    // one: `WaitSet::look`.
    fence(Ordering::SeqCst);
    if !is_set() {
        // SYNC: the tail is visible to an owner that finds the bit.
        set();
    }
}
