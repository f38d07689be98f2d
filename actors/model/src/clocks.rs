//! The clock offsets of other nodes relative to this one, and their extrapolation between measurements:
//! written by NDL, read by GNCL.
//!
//! The results are correct under two assumptions about the clocks of hosts. At each moment one runs at most
//! [`DRIFT_PPB_MAX`] faster than the other. This drift changes by at most [`WANDER_PPB_PER_S`] per second.
//! spec: NDL-6.1

use std::{collections::BTreeMap, sync::Mutex, time::Duration};

use sinew_runtime::{
    lock,
    tid::{Incarnation, NodeAddress},
    time::Time,
};

/// Maximum drift between two quartz clocks, in parts per billion; datasheets give +-50 ppm for each, cold and
/// old ones are worse.
pub const DRIFT_PPB_MAX: u64 = 200_000;

/// Maximum change of the drift per second. A quartz changes by one or two ppm per degree far from its best
/// temperature. A board takes ten seconds or more to warm up by one degree.
pub const WANDER_PPB_PER_S: u64 = 100;

/// The offset of a peer's monotonic clock relative to the local one.
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
    /// The peer's clock minus the local clock, in nanoseconds.
    pub theirs_minus_ours_ns: i64,
    /// Maximum error: half a round trip, plus the possible drift since the measurement.
    pub bound: Duration,
    /// When this offset holds, in the local clock.
    pub at: Time,
    /// The drift of the offset at that time.
    pub drift: ClockDrift,
}

/// How much faster a peer's clock runs than the local one.
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
    /// Nanoseconds per second by which the peer's clock runs ahead of the local one; 1000 are 1 ppm.
    pub ppb: i64,
    /// Maximum error. 200,000 (200 ppm) with `ppb` 0: the drift is unknown.
    pub bound_ppb: u64,
}

impl ClockDrift {
    /// The drift of a clock that was not observed for long enough.
    pub const UNKNOWN: Self = Self { ppb: 0, bound_ppb: DRIFT_PPB_MAX };

    /// Returns the same drift this long after or before.
    pub const fn apart(self, nanos: u64) -> Self {
        let bound_ppb = self.bound_ppb.saturating_add(wander_ppb(nanos));
        let most = self.most_wrong_ppb();
        Self { bound_ppb: if bound_ppb < most { bound_ppb } else { most }, ..self }
    }

    /// Returns the maximum error of the drift: no clock exceeds it.
    const fn most_wrong_ppb(self) -> u64 {
        self.ppb.unsigned_abs().saturating_add(DRIFT_PPB_MAX)
    }

    /// Returns the maximum error of an offset this long after or before its measurement, if it moves with this drift.
    const fn error_ns(self, nanos: u64) -> u64 {
        // The mean change of the drift in that time.
        let bound_ppb = self.bound_ppb.saturating_add(wander_ppb(nanos) / 2 + 1);
        let most = self.most_wrong_ppb();
        drifted_ns(nanos, if bound_ppb < most { bound_ppb } else { most })
    }
}

/// Returns the maximum change of a drift in this time.
const fn wander_ppb(nanos: u64) -> u64 {
    (nanos / 1_000_000_000 + 1).saturating_mul(WANDER_PPB_PER_S)
}

/// Returns the nanoseconds by which two clocks drift apart in this time, one running faster by `ppb`; rounded
/// up. Avoids the slow 128-bit division: this runs for each message between nodes.
const fn drifted_ns(nanos: u64, ppb: u64) -> u64 {
    (nanos / 1_000 + 1).saturating_mul(ppb) / 1_000_000 + 2
}

/// Returns the maximum drift of two clocks in this time, in nanoseconds.
pub const fn drift_ns_max(nanos: u64) -> u64 {
    drifted_ns(nanos, DRIFT_PPB_MAX)
}

impl ClockOffset {
    /// Extrapolates the offset to another time, mostly a later one: the drift changes the offset, and the
    /// error bound grows. // spec: NDL-6.1
    #[must_use]
    pub const fn at(self, now: Time) -> Self {
        let apart = now.as_nanos().abs_diff(self.at.as_nanos());
        let error = Duration::from_nanos(self.drift.error_ns(apart));
        Self {
            theirs_minus_ours_ns: self.offset_at(now),
            bound: self.bound.saturating_add(error),
            at: now,
            drift: self.drift.apart(apart),
        }
    }

    /// Returns the offset at another time.
    const fn offset_at(self, now: Time) -> i64 {
        let (since, until) = (self.at.as_nanos(), now.as_nanos());
        let apart = until.abs_diff(since);
        let moved = (apart / 1_000).saturating_mul(self.drift.ppb.unsigned_abs()) / 1_000_000;
        let moved = if moved > i64::MAX.unsigned_abs() { i64::MAX } else { moved.cast_signed() };
        let moved = if (until < since) == (self.drift.ppb < 0) { moved } else { -moved };
        self.theirs_minus_ours_ns.saturating_add(moved)
    }

    /// Converts a past time of the peer's clock to the local clock, with its maximum error. Returns `None` if
    /// by this offset the time is after `now`: then the offset has changed, for example because this host was
    /// suspended.
    pub fn in_our_clock(self, now: Time, theirs: Time) -> Option<(Time, Duration)> {
        self.conversion_at(now).in_our_clock(theirs)
    }

    /// Returns the conversion of times at `now`: the part that is the same for all messages that arrive together.
    pub fn conversion_at(self, now: Time) -> ClockConversion {
        // In whole nanoseconds: a `Duration` is divided into seconds at each step.
        let bound_ns = u64::try_from(self.bound.as_nanos()).unwrap_or(u64::MAX);
        let apart = now.as_nanos().abs_diff(self.at.as_nanos());
        let bound_ns = bound_ns.saturating_add(self.drift.error_ns(apart));
        ClockConversion { now, offset_ns: self.offset_at(now), bound_ns }
    }
}

/// A [`ClockOffset`] at one moment, which converts the times of messages that arrive then.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ClockConversion {
    now: Time,
    /// The peer's clock minus the local clock at `now`.
    offset_ns: i64,
    /// Maximum error of `offset_ns`.
    bound_ns: u64,
}

impl ClockConversion {
    /// Converts a time as [`ClockOffset::in_our_clock`] does. This runs for each message.
    pub fn in_our_clock(self, theirs: Time) -> Option<(Time, Duration)> {
        let Self { now, offset_ns, bound_ns } = self;
        let ours = theirs.shifted(offset_ns.saturating_neg());
        if ours.as_nanos() > now.as_nanos().saturating_add(bound_ns) {
            return None;
        }
        let ours = ours.min(now);
        // The offset was slightly different then.
        let drifted = drift_ns_max(now.as_nanos() - ours.as_nanos());
        Some((ours, Duration::from_nanos(bound_ns.saturating_add(drifted))))
    }
}

/// The clock offsets of the peers, each for one incarnation: the next incarnation of a node may be on another
/// host, with another start of its clock.
#[derive(Debug, Default)]
pub struct ClockOffsets(Mutex<BTreeMap<NodeAddress, (Incarnation, ClockOffset)>>);

impl ClockOffsets {
    /// Returns the offset of this incarnation of `node`, if it is the one that was measured last. // spec: NDL-6
    pub fn get(&self, node: NodeAddress, incarnation: Incarnation) -> Option<ClockOffset> {
        let (of, offset) = lock(&self.0).get(&node).copied()?;
        (of == incarnation).then_some(offset)
    }

    /// Replaces the offset of `node`, regardless of its incarnation.
    pub fn set(&self, node: NodeAddress, incarnation: Incarnation, offset: ClockOffset) {
        lock(&self.0).insert(node, (incarnation, offset));
    }

    /// Removes the offset of this incarnation of `node`. The end of an incarnation may be reported late: the
    /// offset of another one stays.
    pub fn forget(&self, node: NodeAddress, incarnation: Incarnation) {
        let mut offsets = lock(&self.0);
        if offsets.get(&node).is_some_and(|(of, _)| *of == incarnation) {
            offsets.remove(&node);
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

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
    fn unmeasured_offset_degrades_at_most_with_drift() {
        let after = |bound_ppb, seconds: u64| {
            let later = offset(0, bound_ppb).at(Time::from_nanos((3_600 + seconds) * SECOND));
            later.bound - Duration::from_micros(100)
        };
        // 1 ppm, plus its wander: half of 0.1 ppm per second.
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

    proptest! {
        #[test]
        fn time_is_converted_by_the_extrapolated_offset(
            ppb in -200_000_i64..200_000, bound_ppb in 0..200_000_u64,
            at in 0..100_000 * SECOND, theirs in 0..100_000 * SECOND,
        ) {
            let (clock, at, theirs) = (offset(ppb, bound_ppb), Time::from_nanos(at), Time::from_nanos(theirs));
            let present = clock.at(at);
            let ours = theirs.shifted(-present.theirs_minus_ours_ns);
            let converted = (ours <= at + present.bound).then(|| {
                let ours = ours.min(at);
                let drifted = Duration::from_nanos(drift_ns_max(at.as_nanos() - ours.as_nanos()));
                (ours, present.bound + drifted)
            });
            prop_assert_eq!(clock.in_our_clock(at, theirs), converted);
        }
    }

    #[test]
    fn future_send_time_is_unknown() {
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
    fn offset_belongs_to_last_measured_incarnation() {
        let (offsets, node) = (ClockOffsets::default(), NodeAddress::new(7));
        let [former, later] = [1, 2].map(Incarnation);
        let of_both = || [former, later].map(|incarnation| offsets.get(node, incarnation));
        offsets.set(node, former, offset(0, 0));
        assert_eq!(of_both(), [Some(offset(0, 0)), None]);
        offsets.set(node, later, offset(1, 0));
        assert_eq!(of_both(), [None, Some(offset(1, 0))]);
        // The report that the former incarnation is over arrives late.
        offsets.forget(node, former);
        assert_eq!(of_both(), [None, Some(offset(1, 0))]);
        offsets.forget(node, later);
        assert_eq!(of_both(), [None, None]);
    }
}
