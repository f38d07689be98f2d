//! One sleep for all rings of a set, and the check of each ring where a report may be lost.

use std::{
    sync::atomic::{AtomicU32, Ordering},
    time::{Duration, Instant},
};

use crate::{
    any::{Any, Ends, HANG_UP_CHECK, Waiter, Words},
    bell::{BellState, Woken},
    consumer::Consumer,
    core::sleep::{WakePlace, fence_before_recheck},
    error::AnyError,
    memory::fence,
    platform,
    wait_set::WaitSet,
};

impl Waiter {
    /// Checks the rings of a set one by one, and records those with a message. Returns whether there is any.
    pub(crate) fn find_unreported(&mut self, set: &WaitSet, ends: &mut impl Ends) -> Result<bool, AnyError> {
        let (mut any, mut is_lost) = (false, false);
        for index in 0..ends.count() {
            let has_message = ends.consumer_mut(index).is_ready();
            if has_message.map_err(|cause| AnyError::Corrupt { index, cause })? {
                any = true;
                is_lost |= set.has_message(ends.consumer(index));
            }
        }
        if is_lost {
            self.trust.doubt(Instant::now());
        }
        Ok(any)
    }

    /// Sleeps once, for all rings of a set.
    pub(crate) fn sleep_for_set(
        &mut self,
        set: &WaitSet,
        ends: &mut impl Ends,
        left: Duration,
    ) -> Result<Any, AnyError> {
        let wake_place = self.trust.wake_place(Instant::now);
        let woken = if left.is_zero() {
            Woken::TimedOut
        } else {
            let words = SetWords::read(set, ends, wake_place)?;
            // Announced after the words were read: every ring from now on ends the sleep.
            set.announce(wake_place);
            fence_before_recheck();
            let found = match wake_place {
                WakePlace::Bell => Ok(set.look()),
                // Work of another thread, and messages that were taken but not handled, are in no ring.
                WakePlace::Own if set.look() => Ok(true),
                WakePlace::Own => self.find_unreported(set, ends),
            };
            let slept = match found {
                Ok(true) => Ok(Woken::Rung),
                Ok(false) => words.sleep(set, ends, left.min(HANG_UP_CHECK)),
                Err(error) => Err(error),
            };
            set.withdraw();
            if slept.as_ref().is_ok_and(|woken| *woken == Woken::TimedOut)
                && words.has_lost_ring(set, ends, set.announced())
            {
                self.trust.doubt(Instant::now());
            }
            slept?
        };
        // The end of a nap, or a ring without a report: of a peer that leaves, or whose report is lost.
        if set.look() || self.find_unreported(set, ends)? {
            return Ok(Any::Ready);
        }
        if woken == Woken::TimedOut && left < HANG_UP_CHECK {
            return Ok(Any::TimedOut);
        }
        self.check_hang_ups(ends)
    }
}

/// Where a sleeper for a set sleeps, and the values there.
enum SetWords {
    /// At the bell of the set.
    Bell(BellState),
    /// At the words of the peers' own regions.
    Own(Box<Words>),
}

impl SetWords {
    fn read(set: &WaitSet, ends: &impl Ends, wake_place: WakePlace) -> Result<Self, AnyError> {
        match wake_place {
            WakePlace::Bell => Ok(Self::Bell(set.listen())),
            WakePlace::Own => Words::read(ends, own_word).map(Box::new).map(Self::Own),
        }
    }

    fn sleep(&self, set: &WaitSet, ends: &impl Ends, left: Duration) -> Result<Woken, AnyError> {
        match self {
            Self::Bell(seen) => platform::sleep_at(set.bell(), *seen, left).map_err(AnyError::System),
            Self::Own(words) => words.sleep(ends, own_word, left),
        }
    }

    /// Whether a peer has rung for this sleep while the bell is unchanged: a peer changes the bell first and reports
    /// the ring afterwards.
    fn has_lost_ring(&self, set: &WaitSet, ends: &impl Ends, sleep: u32) -> bool {
        let Self::Bell(seen) = self else { return false };
        let was_rung = (0..ends.count()).any(|index| ends.consumer(index).was_rung_for(sleep));
        // SYNC: the peer's stores before its report are visible: `ProducerCore::report_ring`.
        fence(Ordering::Acquire);
        was_rung && set.bell().load(Ordering::Relaxed) == seen.0
    }
}

#[expect(clippy::unnecessary_wraps, reason = "a bell of another kind has no word")]
fn own_word(consumer: &Consumer) -> Option<&AtomicU32> {
    Some(consumer.own_word())
}
