//! The latch of a node's stop, which its guarded outputs read without a lock.

use std::{
    collections::BTreeMap,
    sync::{
        Mutex,
        atomic::{AtomicU64, AtomicUsize, Ordering},
    },
};

use super::safe_output::wake;
use crate::{lock, stop::StopState, tid::Tid};

/// Maximum number of applications with outputs that have acknowledged a stop. Beyond it the outputs that they make
/// later have to be acknowledged again.
const ACKNOWLEDGED_MAX: usize = 1_024;
/// Bits of the state in the word; the others count the presses.
const STATE_BITS: u32 = 2;
const RELEASED: u64 = 0;
const HELD: u64 = 1;
const STOPPED: u64 = 2;
/// Held from the start of the node on: nothing was released yet.
const STARTING: u64 = 3;
const STATE: u64 = (1 << STATE_BITS) - 1;

/// The latch of one node's stop.
///
/// An output compares the number of presses with the one that its application has acknowledged. So it becomes safe also
/// after a press that was released before the output was looked at.
#[derive(Debug, Default)]
pub struct StopLatch {
    /// The number of presses, and the state.
    ///
    /// SYNC: sequentially consistent, as is `not_safe`: a thread that arms an output counts it there and then reads
    /// this word; one that presses writes this word and then reads the count. So one of them sees the other.
    word: AtomicU64,
    /// Number of outputs that are live, or of which the safe function has failed.
    not_safe: AtomicUsize,
    /// The numbers of presses that applications have acknowledged, for the outputs that they make later. A press does
    /// not take this lock.
    acknowledged: Mutex<BTreeMap<Tid, u64>>,
}

/// The state of a latch at one moment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Latched(u64);

impl Latched {
    /// Returns the number of presses so far.
    #[must_use]
    #[inline]
    pub const fn presses(self) -> u64 {
        self.0 >> STATE_BITS
    }

    /// Returns whether outputs may be armed.
    #[inline]
    pub(crate) const fn is_released(self) -> bool {
        self.0 & STATE == RELEASED
    }

    /// Returns whether a stop is in force.
    #[must_use]
    #[inline]
    pub const fn is_stopped(self) -> bool {
        self.0 & STATE == STOPPED
    }

    /// Returns whether the node is held since its start: outputs of other processes, too, must not be armed.
    pub(crate) const fn is_starting(self) -> bool {
        self.0 & STATE == STARTING
    }

    /// Returns the state, for reports.
    #[must_use]
    pub const fn state(self) -> StopState {
        match self.0 & STATE {
            RELEASED => StopState::Released,
            HELD | STARTING => StopState::Held,
            _ => StopState::Stopped,
        }
    }

    const fn of(presses: u64, state: u64) -> u64 {
        presses << STATE_BITS | state
    }
}

impl StopLatch {
    /// Reads the latch.
    #[must_use]
    #[inline]
    pub fn read(&self) -> Latched {
        Latched(self.word.load(Ordering::SeqCst))
    }

    /// Stops: all outputs of the node become safe. It takes no lock and allocates nothing, so any thread may call it.
    /// Returns its state by this press.
    pub fn press(&self) -> Latched {
        let pressed = |word| Latched::of(Latched(word).presses() + 1, STOPPED);
        let before = self.word.fetch_update(Ordering::SeqCst, Ordering::SeqCst, |word| Some(pressed(word)));
        wake();
        // It always succeeds, as the closure returns a value.
        Latched(pressed(before.unwrap_or_default()))
    }

    /// Ends the stop that `seen` was read in. Returns `false` if another press came after that: the latch stays.
    /// Outputs stay safe until their applications acknowledge the stop and arm them.
    pub fn release(&self, seen: Latched) -> bool {
        let released = Latched::of(seen.presses(), HELD);
        let (ordering, failed) = (Ordering::SeqCst, Ordering::SeqCst);
        seen.is_stopped() && self.word.compare_exchange(seen.0, released, ordering, failed).is_ok()
    }

    /// Begins the hold at the start of a node. It ends as any other one.
    pub fn begin(&self) {
        let (ordering, failed) = (Ordering::SeqCst, Ordering::SeqCst);
        // A press stays.
        let _ = self.word.compare_exchange(RELEASED, STARTING, ordering, failed);
    }

    /// Permits or forbids to arm outputs while no stop is in force. Outputs that are live stay so.
    pub fn hold(&self, is_held: bool) {
        let state = if is_held { HELD } else { RELEASED };
        // A stop stays: only a release ends it. The hold at the start is one already.
        let _ = self.word.fetch_update(Ordering::SeqCst, Ordering::SeqCst, |word| {
            let now = Latched(word);
            let stays = now.is_stopped() || is_held && now.is_starting();
            (!stays).then(|| Latched::of(now.presses(), state))
        });
    }

    /// Returns the number of outputs that are live, or of which the safe function has failed. After
    /// [`press`](Self::press) zero means that all are safe.
    #[must_use]
    pub fn not_safe(&self) -> usize {
        self.not_safe.load(Ordering::SeqCst)
    }

    /// Returns the number of presses that `app` has acknowledged: an output that it makes after a stop, for instance
    /// because it was restarted, is not armed without the acknowledgement either.
    pub(crate) fn acknowledged(&self, app: Tid) -> u64 {
        lock(&self.acknowledged).get(&app).copied().unwrap_or(0)
    }

    /// Records that `app` has acknowledged this number of presses.
    pub(crate) fn record_acknowledged(&self, app: Tid, presses: u64) {
        let mut acknowledged = lock(&self.acknowledged);
        if acknowledged.len() >= ACKNOWLEDGED_MAX && !acknowledged.contains_key(&app) {
            acknowledged.clear();
        }
        acknowledged.insert(app, presses);
    }

    /// Counts an output that begins to be live, or that cannot be made safe.
    pub(crate) fn count(&self) {
        self.not_safe.fetch_add(1, Ordering::SeqCst);
    }

    /// Counts an output that is safe again.
    pub(crate) fn discount(&self) {
        self.not_safe.fetch_sub(1, Ordering::SeqCst);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn press_between_reading_and_release_wins() {
        let latch = StopLatch::default();
        latch.press();
        let seen = latch.read();
        latch.press();
        assert!(!latch.release(seen) && latch.read().is_stopped());
        assert!(latch.release(latch.read()) && !latch.read().is_stopped());
    }

    #[test]
    fn release_permits_nothing_before_the_hold_ends() {
        let latch = StopLatch::default();
        assert!(latch.read().is_released(), "a process without a node is not held");
        latch.press();
        latch.hold(false);
        assert!(latch.read().is_stopped(), "the end of a hold is no release");
        assert!(latch.release(latch.read()) && !latch.read().is_released());
        latch.hold(false);
        assert!(latch.read().is_released());
        latch.hold(true);
        assert!(!latch.read().is_released() && !latch.read().is_stopped());
    }

    #[test]
    fn hold_at_the_start_ends_once() {
        let latch = StopLatch::default();
        latch.begin();
        latch.hold(true);
        assert!(latch.read().is_starting() && latch.read().state() == StopState::Held);
        latch.hold(false);
        latch.hold(true);
        assert!(!latch.read().is_starting() && !latch.read().is_released());
        // A press ends it, too
        let pressed = StopLatch::default();
        pressed.begin();
        pressed.press();
        pressed.begin();
        assert!(pressed.release(pressed.read()) && !pressed.read().is_starting());
    }

    #[test]
    fn release_without_a_stop_changes_nothing() {
        let latch = StopLatch::default();
        assert!(!latch.release(latch.read()));
        assert_eq!(latch.read().presses(), 0);
    }
}
