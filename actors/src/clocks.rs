//! How far other nodes' clocks are from ours, and how that goes on while nobody measures: written by NDL, read by GNCL.
//!
//! What is said here is right as long as two clocks do as clocks of hosts do: at each moment one runs at most [`DRIFT_PPB_MAX`] faster than the
//! other, and by how much that is changes by [`WANDER_PPB_PER_S`] in a second at most. // spec: NDL-6.1

use std::{collections::BTreeMap, sync::Mutex, time::Duration};

use sinew_runtime::{
    tid::{Incarnation, NodeAddress},
    time::Time,
};

use crate::stores::lock;

/// Two quartz clocks drift apart by at most this, in billionths; datasheets say +-50 millionths for each, cold and old ones do worse.
pub(crate) const DRIFT_PPB_MAX: u64 = 200_000;

/// How much that changes in a second, at most: a quartz changes by a millionth or two for each degree far from its best temperature, and a
/// board takes ten seconds and more to become a degree warmer.
pub(crate) const WANDER_PPB_PER_S: u64 = 100;

/// How far a peer's monotonic clock is from ours.
///
/// # Examples
///
/// ```
/// use sinew::{prelude::*, time::{ClockDrift, ClockOffset}};
///
/// let drift = ClockDrift { ppb: 0, bound_ppb: 20_000 };
/// let at = Time::from_nanos(1_000_000_000);
/// let measured = ClockOffset { theirs_minus_ours_ns: -350_000, bound: Duration::from_micros(40), at, drift };
/// // A second later the clocks may have drifted apart by 20 us.
/// let later = measured.at(at + Duration::from_secs(1));
/// assert!(later.bound >= Duration::from_micros(60));
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ClockOffset {
    /// Their clock minus ours, in nanoseconds.
    pub theirs_minus_ours_ns: i64,
    /// The error is at most this: half a round trip, and what the clocks may have drifted apart since that was measured.
    pub bound: Duration,
    /// When this holds, in our clock.
    pub at: Time,
    /// How fast that changes then.
    pub drift: ClockDrift,
}

/// How much faster a peer's clock runs than ours.
///
/// # Examples
///
/// ```
/// use sinew::time::ClockDrift;
///
/// let drift = ClockDrift { ppb: 1_500, bound_ppb: 200 };
/// println!("their clock gains {} us an hour", drift.ppb * 3_600 / 1_000);
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ClockDrift {
    /// Nanoseconds in a second by which theirs goes ahead of ours; 1000 are 1 ppm.
    pub ppb: i64,
    /// The error is at most this. 200,000 (200 ppm) with `ppb` 0: nothing is known.
    pub bound_ppb: u64,
}

impl ClockDrift {
    /// Of a clock that was not watched for long enough.
    pub(crate) const UNKNOWN: Self = Self { ppb: 0, bound_ppb: DRIFT_PPB_MAX };

    /// The same drift so long after or before.
    pub(crate) const fn apart(self, nanos: u64) -> Self {
        let bound_ppb = self.bound_ppb.saturating_add(wander_ppb(nanos));
        let most = self.most_wrong_ppb();
        Self { bound_ppb: if bound_ppb < most { bound_ppb } else { most }, ..self }
    }

    /// No clock runs so that it were more wrong.
    const fn most_wrong_ppb(self) -> u64 {
        self.ppb.unsigned_abs().saturating_add(DRIFT_PPB_MAX)
    }

    /// By how much at most an offset is wrong so long after it was right, or before, if it moves with this drift.
    const fn error_ns(self, nanos: u64) -> u64 {
        // The mean of what it wanders in that time.
        let bound_ppb = self.bound_ppb.saturating_add(wander_ppb(nanos) / 2 + 1);
        let most = self.most_wrong_ppb();
        drifted_ns(nanos, if bound_ppb < most { bound_ppb } else { most })
    }
}

/// By how much a drift changes in so long at most.
const fn wander_ppb(nanos: u64) -> u64 {
    (nanos / 1_000_000_000 + 1).saturating_mul(WANDER_PPB_PER_S)
}

/// Nanoseconds by which two clocks drift apart in so long, one running faster by `ppb`; rounded up. Without the slow division of 128 bits: this
/// is on the way of each message between nodes.
const fn drifted_ns(nanos: u64, ppb: u64) -> u64 {
    (nanos / 1_000 + 1).saturating_mul(ppb) / 1_000_000 + 2
}

/// Nanoseconds by which two clocks drift apart in this time at most.
pub(crate) const fn drift_ns_max(nanos: u64) -> u64 {
    drifted_ns(nanos, DRIFT_PPB_MAX)
}

impl ClockOffset {
    /// The same as it is at another time, mostly a later one, as far as is known: it has moved by what the clocks drift apart, and is less
    /// exactly known. // spec: NDL-6.1
    #[must_use]
    pub const fn at(self, now: Time) -> Self {
        let (since, until) = (self.at.as_nanos(), now.as_nanos());
        let apart = until.abs_diff(since);
        let moved = (apart / 1_000).saturating_mul(self.drift.ppb.unsigned_abs()) / 1_000_000;
        let moved = if moved > i64::MAX.unsigned_abs() { i64::MAX } else { moved.cast_signed() };
        let moved = if (until < since) == (self.drift.ppb < 0) { moved } else { -moved };
        let error = Duration::from_nanos(self.drift.error_ns(apart));
        Self {
            theirs_minus_ours_ns: self.theirs_minus_ours_ns.saturating_add(moved),
            bound: self.bound.saturating_add(error),
            at: now,
            drift: self.drift.apart(apart),
        }
    }

    /// A time of theirs that is past at `now`, in our clock, and how wrong that may be; `None` if by this offset it is still to come: then
    /// the offset is another one by now, as this host has slept, say.
    pub(crate) fn in_our_clock(self, now: Time, theirs: Time) -> Option<(Time, Duration)> {
        let present = self.at(now);
        let ours = theirs.shifted(present.theirs_minus_ours_ns.saturating_neg());
        if ours > now + present.bound {
            return None;
        }
        let ours = ours.min(now);
        // It was another offset then, if only by a little.
        let drifted = drift_ns_max(now.as_nanos() - ours.as_nanos());
        Some((ours, present.bound.saturating_add(Duration::from_nanos(drifted))))
    }
}

/// The offsets of the peers' clocks against ours, each of one life: the next life of a node may be on another host, whose clock began at
/// another time.
#[derive(Debug, Default)]
pub(crate) struct ClockOffsets(Mutex<BTreeMap<NodeAddress, (Incarnation, ClockOffset)>>);

impl ClockOffsets {
    /// The offset of this life of `node`, if it is the one that was measured last. // spec: NDL-6
    pub(crate) fn get(&self, node: NodeAddress, life: Incarnation) -> Option<ClockOffset> {
        let (of, offset) = lock(&self.0).get(&node).copied()?;
        (of == life).then_some(offset)
    }

    /// Replaces the offset of `node`, whichever life that was of.
    pub(crate) fn set(&self, node: NodeAddress, life: Incarnation, offset: ClockOffset) {
        lock(&self.0).insert(node, (life, offset));
    }

    /// Forgets the offset of this life of `node`. It may be heard late that a life is over: that of another one stays.
    pub(crate) fn forget(&self, node: NodeAddress, life: Incarnation) {
        let mut offsets = lock(&self.0);
        if offsets.get(&node).is_some_and(|(of, _)| *of == life) {
            offsets.remove(&node);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: u64 = 1_000_000_000;

    fn offset(ppb: i64, bound_ppb: u64) -> ClockOffset {
        let drift = ClockDrift { ppb, bound_ppb };
        let (at, bound) = (Time::from_nanos(3_600 * SECOND), Duration::from_micros(100));
        ClockOffset { theirs_minus_ours_ns: 7_000_000_000, bound, at, drift }
    }

    #[test]
    fn an_offset_moves_with_the_drift_in_both_directions() {
        let after = |ppb, seconds: u64| {
            let at = Time::from_nanos(3_600 * SECOND + seconds * SECOND);
            offset(ppb, 0).at(at).theirs_minus_ours_ns - 7_000_000_000
        };
        assert_eq!((after(50_000, 3_600), after(-50_000, 3_600)), (180_000_000, -180_000_000));
        let before =
            |ppb| offset(ppb, 0).at(Time::from_nanos(3_599 * SECOND)).theirs_minus_ours_ns - 7_000_000_000;
        assert_eq!((before(50_000), before(-50_000)), (-50_000, 50_000));
    }

    #[test]
    fn what_nobody_measures_is_known_ever_less_exactly_and_never_worse_than_clocks_drift() {
        let after = |bound_ppb, seconds: u64| {
            let later = offset(0, bound_ppb).at(Time::from_nanos((3_600 + seconds) * SECOND));
            later.bound - Duration::from_micros(100)
        };
        // 1 ppm, and what it wanders: half of 0.1 ppm for each second.
        assert!(after(1_000, 10) > Duration::from_micros(15) && after(1_000, 10) < Duration::from_micros(17));
        let hour = after(1_000, 3_600);
        assert!(hour > Duration::from_millis(640) && hour < Duration::from_millis(660), "{hour:?}");
        let day = after(1_000, 86_400);
        assert!(day >= Duration::from_secs(17) && day < Duration::from_secs(18), "{day:?}");
        assert_eq!(ClockDrift::UNKNOWN.apart(u64::MAX), ClockDrift::UNKNOWN);
    }

    #[test]
    fn any_times_make_an_offset() {
        let far = ClockOffset { theirs_minus_ours_ns: i64::MAX, ..offset(i64::MIN, u64::MAX) };
        for at in [Time::ZERO, Time::MAX] {
            for theirs in [Time::ZERO, Time::MAX] {
                let times = far.in_our_clock(at, theirs);
                assert!(times.is_none_or(|(ours, _)| ours <= at), "{times:?}");
            }
        }
    }

    #[test]
    fn a_send_time_that_is_still_to_come_is_not_known() {
        // Given: an offset that is exact to 100 us; this host has slept for three seconds since.
        let (clock, now) = (offset(0, 0), Time::from_nanos(3_600 * SECOND));
        let theirs = |ours: u64| Time::from_nanos(ours + 7 * SECOND);
        let sent = 3_600 * SECOND;
        assert!(clock.in_our_clock(now, theirs(sent - SECOND)).is_some());
        assert_eq!(
            clock.in_our_clock(now, theirs(sent + 50_000)).map(|(at, _)| at),
            Some(now),
            "by its error"
        );
        assert_eq!(clock.in_our_clock(now, theirs(sent + 3 * SECOND)), None);
        assert_eq!(clock.in_our_clock(now, Time::MAX), None);
    }

    // spec: NDL-6
    #[test]
    fn an_offset_is_that_of_the_life_that_was_measured_last_and_of_no_other() {
        let (offsets, node) = (ClockOffsets::default(), NodeAddress::new(7));
        let [former, later] = [1, 2].map(Incarnation);
        let of_both = || [former, later].map(|life| offsets.get(node, life));
        offsets.set(node, former, offset(0, 0));
        assert_eq!(of_both(), [Some(offset(0, 0)), None]);
        offsets.set(node, later, offset(1, 0));
        assert_eq!(of_both(), [None, Some(offset(1, 0))]);
        // That the former one is over is heard late.
        offsets.forget(node, former);
        assert_eq!(of_both(), [None, Some(offset(1, 0))]);
        offsets.forget(node, later);
        assert_eq!(of_both(), [None, None]);
    }
}
