//! Whether the watchdog may check seldom: a node at rest is woken no more often than its time limits require. Pure.
//!
//! ```text
//!  Alert ── quiet for a second ──► Marking ── still quiet ──► Resting
//!    ▲ ────────────────────── anything else ─────────────────────┘
//! ```
//!
//! While the watchdog rests, actors record when their turns begin. Mailboxes record when messages begin to wait, and
//! when one is taken and others are left. So a hang is found at the same time as by frequent checks.

use std::time::Duration;

use crate::time::Time;

/// Turns of all actors that are allowed for each second between two checks of a node at rest. Discovery and the pings
/// of 15 other nodes take some 80. Beyond, the checks cost little beside the turns.
const TURNS_PER_S_MAX: u32 = 200;
/// Turns that are allowed besides, between any two checks: with checks every 40 ms they are half of all.
const TURNS_AT_ONCE: u64 = 8;
/// Time without anything open after which the checks become rare.
const QUIET: Duration = Duration::from_secs(1);
/// Minimum time between the order to record and the first long sleep. A turn that began without a record is then
/// visible to a check before that sleep.
const SETTLE: Duration = Duration::from_millis(5);

/// How the watchdog checks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) enum Pace {
    /// Often.
    #[default]
    Alert,
    /// Often, and actors record their turns.
    Marking,
    /// Rarely, and actors record their turns.
    Resting,
}

impl Pace {
    /// Returns whether actors record when their turns begin.
    pub(super) const fn is_marked(self) -> bool {
        match self {
            Self::Alert => false,
            Self::Marking | Self::Resting => true,
        }
    }
}

/// The decision, from one check to the next.
#[derive(Debug, Default)]
pub(super) struct Rest {
    pace: Pace,
    /// Since when nothing was open, or since when turns are recorded.
    since: Time,
    checked: Time,
    turns: u64,
}

impl Rest {
    /// Returns the pace since the last check.
    pub(super) const fn pace(&self) -> Pace {
        self.pace
    }

    /// Handles a check, and returns the pace from now on. `turns` is the sum of all turn numbers, which rise by
    /// two with each turn. `may_rest`: nothing was open, no message waited, and no incarnation began or ended.
    pub(super) fn check(&mut self, now: Time, turns: u64, may_rest: bool) -> Pace {
        let most = now.since(self.checked).saturating_mul(TURNS_PER_S_MAX).as_secs() + TURNS_AT_ONCE;
        let is_quiet = may_rest && turns.wrapping_sub(self.turns) / 2 <= most;
        (self.checked, self.turns) = (now, turns);
        let lasted = now.since(self.since);
        let next = match self.pace {
            Pace::Alert | Pace::Marking | Pace::Resting if !is_quiet => Pace::Alert,
            Pace::Alert if lasted >= QUIET => Pace::Marking,
            Pace::Marking if lasted >= SETTLE => Pace::Resting,
            Pace::Alert | Pace::Marking | Pace::Resting => self.pace,
        };
        if !is_quiet || next != self.pace {
            self.since = now;
        }
        self.pace = next;
        next
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const fn at(ms: u64) -> Time {
        Time::from_nanos(1_000_000_000 + ms * 1_000_000)
    }

    /// A check after so many milliseconds and turns, and whether something was open.
    fn any_check() -> impl Strategy<Value = (u64, u64, bool)> {
        (1_u64..400, prop_oneof![9 => 0_u64..8, 1 => 0_u64..200], prop::bool::weighted(0.9))
    }

    proptest! {
        #[test]
        fn rest_follows_a_quiet_second_and_a_marked_check(
            checks in proptest::collection::vec(any_check(), 1..200),
        ) {
            let (mut rest, mut now, mut turns) = (Rest::default(), 0, 0);
            rest.check(at(0), 0, false);
            let (mut disturbed, mut marked) = (at(0), None);
            for (ms, more, may_rest) in checks {
                (now, turns) = (now + ms, turns + 2 * more);
                let former = rest.pace();
                let pace = rest.check(at(now), turns, may_rest);
                let is_flood = more > TURNS_AT_ONCE + ms * u64::from(TURNS_PER_S_MAX) / 1_000;
                if !may_rest || is_flood {
                    disturbed = at(now);
                    prop_assert_eq!(pace, Pace::Alert);
                }
                marked = if pace.is_marked() { marked.or_else(|| Some(at(now))) } else { None };
                if pace == Pace::Resting {
                    prop_assert!(former.is_marked(), "a check with records comes first");
                    prop_assert!(marked.is_some_and(|marked| at(now).since(marked) >= SETTLE));
                    prop_assert!(at(now).since(disturbed) >= QUIET + SETTLE);
                }
            }
        }
    }

    #[test]
    fn quiet_node_comes_to_rest_and_stays_there() {
        let mut rest = Rest::default();
        rest.check(at(0), 0, false);
        let paces = (1..=30).map(|check| rest.check(at(check * 40), check * 4, true));
        let paces: Vec<_> = paces.collect();
        assert_eq!(paces.iter().position(|pace| *pace == Pace::Marking), Some(24), "after 1 s");
        assert!(paces[25..].iter().all(|pace| *pace == Pace::Resting));
    }

    #[test]
    fn wake_soon_after_order_does_not_start_rest() {
        let mut rest = Rest::default();
        rest.check(at(0), 0, false);
        assert_eq!(rest.check(at(1_000), 0, true), Pace::Marking);
        assert_eq!(rest.check(at(1_004), 0, true), Pace::Marking);
        assert_eq!(rest.check(at(1_005), 0, true), Pace::Resting);
    }

    #[test]
    fn end_of_an_incarnation_ends_the_rest() {
        let mut rest = Rest::default();
        rest.check(at(0), 900, false);
        assert_eq!(rest.check(at(2_000), 900, true), Pace::Marking);
        assert_eq!(rest.check(at(2_040), 900, true), Pace::Resting);
        // The sum of the turns is smaller without it.
        assert_eq!(rest.check(at(2_290), 400, true), Pace::Alert);
    }
}
