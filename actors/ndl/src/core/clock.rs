//! The offset of a peer's clock from the local one, and its drift, from the four timestamps of each query and its
//! answer.
//!
//! ```text
//! ours    t1 --query-->            t4        offset = ((t2 - t1) + (t3 - t4)) / 2
//! theirs         t2 --answer--> t3           bound  = ((t4 - t1) - (t3 - t2)) / 2, plus the drift from t1 to t4
//! ```
//!
//! Two offsets some time apart give the drift between the clocks in that time. The best sample of each 8 s is kept for
//! some minutes, and each pair of these samples bounds the drift. The drift is the range that all of them allow.
//! spec: NDL-6.1

use std::{collections::VecDeque, time::Duration};

use sinew_runtime::time::Time;

use sinew_model::clocks::{ClockDrift, ClockOffset, DRIFT_PPB_MAX, WANDER_PPB_PER_S, drift_ns_max};

/// Number of samples of which the best one is used.
const SAMPLES_MAX: usize = 8;
/// Duration of a span, in nanoseconds. The best sample of each span is kept for the drift.
const SPAN_NS: u64 = 8_000_000_000;
/// Maximum number of spans. Older drifts are less relevant to the present one.
const SPANS_MAX: usize = 32;

/// The four timestamps of one exchange.
#[derive(Clone, Copy, Debug)]
pub(super) struct Exchange {
    pub(super) query_sent: Time,
    pub(super) query_received: Time,
    pub(super) answer_sent: Time,
    pub(super) answer_received: Time,
}

impl Exchange {
    /// Returns the time on the network, without the peer's processing time, or `None` if the timestamps
    /// contradict each other.
    pub(super) fn round_trip(self) -> Option<Duration> {
        sample(self).map(|sample| sample.round_trip)
    }
}

/// The result of an exchange for a clock.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Measured {
    /// The offset from the local clock.
    Offset,
    /// None: the timestamps contradict each other.
    Nothing,
    /// A value that no clock could have reached since the earlier exchanges. The clock was set, or stopped.
    /// The earlier exchanges are discarded.
    Leap,
}

#[derive(Clone, Copy, Debug)]
struct Sample {
    at: Time,
    offset_ns: i64,
    bound_ns: u64,
    round_trip: Duration,
}

/// The last exchanges with one peer.
#[derive(Debug)]
pub(super) struct PeerClock {
    samples: VecDeque<Sample>,
    round_trip: Option<Duration>,
    /// The best sample of each past span.
    spans: VecDeque<Sample>,
    /// Start of the present span, and its best sample so far.
    span: Option<(Time, Sample)>,
    /// The drift, and the time at which it was computed.
    drift: (Time, ClockDrift),
}

impl Default for PeerClock {
    fn default() -> Self {
        Self {
            samples: VecDeque::new(),
            round_trip: None,
            spans: VecDeque::new(),
            span: None,
            drift: (Time::ZERO, ClockDrift::UNKNOWN),
        }
    }
}

impl PeerClock {
    /// Adds an exchange. // spec: NDL-6
    pub(super) fn measure(&mut self, exchange: Exchange) -> Measured {
        let Some(sample) = sample(exchange) else { return Measured::Nothing };
        if !self.allows(sample) {
            // One of the clocks is steered, for example by NTP. Only the bound that holds for every clock remains.
            (self.drift, self.span) = ((sample.at, ClockDrift::UNKNOWN), None);
            self.spans.clear();
        }
        let is_possible = self.allows(sample);
        if is_possible {
            self.note_drift(sample);
        } else {
            *self = Self { span: Some((sample.at, sample)), ..Self::default() };
        }
        self.round_trip = Some(sample.round_trip);
        if self.samples.len() == SAMPLES_MAX {
            self.samples.pop_front();
        }
        self.samples.push_back(sample);
        if is_possible { Measured::Offset } else { Measured::Leap }
    }

    /// Returns the offset of the peer's clock at `now`, from the most exact sample.
    pub(super) fn offset(&self, now: Time) -> Option<ClockOffset> {
        let (at, drift) = self.drift;
        let offset = |sample: &Sample| {
            let drift = drift.apart(sample.at.as_nanos().abs_diff(at.as_nanos()));
            let (theirs_minus_ours_ns, bound) = (sample.offset_ns, Duration::from_nanos(sample.bound_ns));
            ClockOffset { theirs_minus_ours_ns, bound, at: sample.at, drift }.at(now)
        };
        self.samples.iter().map(offset).min_by_key(|offset| offset.bound)
    }

    /// Returns the network time of the last query and answer, without the peer's processing time.
    pub(super) const fn round_trip(&self) -> Option<Duration> {
        self.round_trip
    }

    /// Returns whether the earlier samples allow the offset of this one.
    fn allows(&self, sample: Sample) -> bool {
        self.offset(sample.at).is_none_or(|expected| {
            let error = expected.theirs_minus_ours_ns.abs_diff(sample.offset_ns);
            u128::from(error) <= expected.bound.as_nanos() + u128::from(sample.bound_ns)
        })
    }

    /// Keeps the best sample of each span, and computes the drift at the end of each span. If no drift is
    /// possible, one of the clocks is steered.
    fn note_drift(&mut self, sample: Sample) {
        match &mut self.span {
            Some((began, best)) if sample.at.as_nanos().saturating_sub(began.as_nanos()) < SPAN_NS => {
                if sample.bound_ns < best.bound_ns {
                    *best = sample;
                }
                return;
            }
            Some(_) | None => {}
        }
        let Some((_, over)) = self.span.replace((sample.at, sample)) else { return };
        let (at, drift) = self.drift;
        let present = drift.apart(over.at.as_nanos().abs_diff(at.as_nanos()));
        let most = Range { least: -i128::from(DRIFT_PPB_MAX), most: i128::from(DRIFT_PPB_MAX) };
        let allowed = (self.spans.iter())
            .fold(most.and(present.into()), |allowed, former| allowed.and(Range::between(former, &over)));
        let drift = allowed.drift();
        if drift.is_none() {
            self.spans.clear();
        }
        if self.spans.len() == SPANS_MAX {
            self.spans.pop_front();
        }
        self.spans.push_back(over);
        self.drift = (over.at, drift.unwrap_or(ClockDrift::UNKNOWN));
    }
}

/// A range of possible drifts, in parts per billion.
#[derive(Clone, Copy, Debug)]
struct Range {
    least: i128,
    most: i128,
}

impl From<ClockDrift> for Range {
    fn from(drift: ClockDrift) -> Self {
        let (ppb, bound) = (i128::from(drift.ppb), i128::from(drift.bound_ppb));
        Self { least: ppb - bound, most: ppb + bound }
    }
}

impl Range {
    /// Returns the range at the later of two samples. It is the mean drift between them, widened by the
    /// errors of both offsets and by the possible change since the middle.
    fn between(former: &Sample, later: &Sample) -> Self {
        let nanos = i128::from(later.at.as_nanos().saturating_sub(former.at.as_nanos())).max(1);
        let moved = i128::from(later.offset_ns) - i128::from(former.offset_ns);
        let error = i128::from(former.bound_ns) + i128::from(later.bound_ns);
        let wandered = nanos * i128::from(WANDER_PPB_PER_S) / 2_000_000_000 + 1;
        let ppb = |moved: i128| moved * 1_000_000_000 / nanos;
        Self { least: ppb(moved - error) - wandered - 1, most: ppb(moved + error) + wandered + 1 }
    }

    fn and(self, other: Self) -> Self {
        Self { least: self.least.max(other.least), most: self.most.min(other.most) }
    }

    /// Returns the middle of the range, or `None` if the range is empty.
    fn drift(self) -> Option<ClockDrift> {
        let width = u64::try_from(self.most - self.least).ok()?;
        let bound_ppb = width.div_ceil(2);
        let ppb = i64::try_from(self.least + i128::from(bound_ppb)).ok()?;
        Some(ClockDrift { ppb, bound_ppb })
    }
}

fn sample(exchange: Exchange) -> Option<Sample> {
    let [t1, t2, t3, t4] =
        [exchange.query_sent, exchange.query_received, exchange.answer_sent, exchange.answer_received]
            .map(|time| i128::from(time.as_nanos()));
    let (there, away) = (t3 - t2, t4 - t1);
    if there < 0 || there > away {
        return None;
    }
    let offset_ns = i64::try_from(((t2 - t1) + (t3 - t4)) / 2).ok()?;
    // Rounded up: a larger bound is safe.
    let half_ns = u64::try_from((away - there + 1) / 2).ok()?;
    let drifted_ns = drift_ns_max(u64::try_from(away).ok()?);
    let (at, bound_ns) = (exchange.answer_received, half_ns.saturating_add(drifted_ns));
    Some(Sample { at, offset_ns, bound_ns, round_trip: Duration::from_nanos(half_ns.saturating_mul(2)) })
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const SECOND: u64 = 1_000_000_000;
    /// The start of the exchanges of a test.
    const BEGIN: u64 = 2_000_000 * SECOND;

    /// A peer's clock with a varying drift.
    struct Truth {
        ahead_ns: i64,
        /// The drift at the beginning of each second, in billionths; between two of these it changes evenly.
        ppb: Vec<i64>,
        /// The accumulated drift of the clocks, in nanoseconds.
        drifted_ns: Vec<f64>,
    }

    impl Truth {
        /// Creates a clock with a drift of `ppb` at the start. Each second it changes by the next of `steps`, which
        /// repeat.
        fn new(ahead_ns: i64, ppb: i64, steps: &[i64]) -> Self {
            const SECONDS: usize = 40_000;
            let most = DRIFT_PPB_MAX.cast_signed();
            let (mut all, mut drifted_ns) = (vec![ppb.clamp(-most, most)], vec![0.0]);
            for at in 0..SECONDS {
                let next = (all[at] + steps[at % steps.len()]).clamp(-most, most);
                drifted_ns.push(drifted_ns[at] + (all[at] + next) as f64 / 2.0);
                all.push(next);
            }
            Self { ahead_ns, ppb: all, drifted_ns }
        }

        /// Returns the offset and the drift at `at`, in our clock.
        fn at(&self, at: Time) -> (i64, f64) {
            let nanos = at.as_nanos() - BEGIN;
            let (second, part) = ((nanos / SECOND) as usize, (nanos % SECOND) as f64 / SECOND as f64);
            let (ppb, next) = (self.ppb[second] as f64, self.ppb[second + 1] as f64);
            let present = ppb + (next - ppb) * part;
            let drifted = self.drifted_ns[second] + (ppb + present) / 2.0 * part;
            (self.ahead_ns + drifted.round() as i64, present)
        }

        fn exchange(&self, at: u64, [there, thinking, back]: [u64; 3]) -> Exchange {
            let theirs = |nanos: u64| {
                let ours = Time::from_nanos(nanos);
                ours.shifted(self.at(ours).0)
            };
            Exchange {
                query_sent: Time::from_nanos(at),
                query_received: theirs(at + there),
                answer_sent: theirs(at + there + thinking),
                answer_received: Time::from_nanos(at + there + thinking + back),
            }
        }

        /// Returns whether the reported clock is right, apart from the rounding of the test itself.
        fn confirms(&self, measured: ClockOffset) -> bool {
            let (offset, ppb) = self.at(measured.at);
            let error = u128::from(measured.theirs_minus_ours_ns.abs_diff(offset));
            error <= measured.bound.as_nanos() + 2
                && (measured.drift.ppb as f64 - ppb).abs() <= measured.drift.bound_ppb as f64 + 1.0
        }
    }

    /// Returns an exchange with a peer's clock that runs as fast as ours.
    fn exchange(at: u64, offset: i64, legs: [u64; 3]) -> Exchange {
        Truth::new(offset, 0, &[0]).exchange(BEGIN + at, legs)
    }

    fn steps() -> impl Strategy<Value = Vec<i64>> {
        let wander = WANDER_PPB_PER_S.cast_signed();
        prop_oneof![
            Just(vec![0]),
            Just(vec![wander]),
            Just(vec![-wander]),
            proptest::collection::vec(-wander..=wander, 1..300)
        ]
    }

    fn legs() -> impl Strategy<Value = [u64; 3]> {
        prop_oneof![
            [0..50_000u64, 0..50_000u64, 0..50_000u64],
            [0..30_000_000u64, 0..1_000_000u64, 0..30_000_000u64]
        ]
    }

    proptest! {
        // spec: NDL-6, NDL-6.1
        #[test]
        fn true_offset_and_drift_stay_within_their_bounds(
            ahead in -1_000_000_000_000_000i64..1_000_000_000_000_000,
            ppb in -200_000i64..=200_000,
            steps in steps(),
            exchanges in proptest::collection::vec((10_000_000u64..10_000_000_000, legs()), 1..200),
            silences in proptest::collection::vec(0..36_000 * SECOND, 3),
        ) {
            let (truth, mut clock, mut now) = (Truth::new(ahead, ppb, &steps), PeerClock::default(), BEGIN);
            for (rest, legs) in exchanges {
                let exchange = truth.exchange(now + rest, legs);
                now = exchange.answer_received.as_nanos();
                prop_assert_eq!(clock.measure(exchange), Measured::Offset);
                let measured = clock.offset(exchange.answer_received).unwrap();
                prop_assert!(truth.confirms(measured), "{measured:?}, and it is {:?}", truth.at(measured.at));
            }
            let last = clock.offset(Time::from_nanos(now)).unwrap();
            for silence in silences {
                let measured = last.at(Time::from_nanos(now + silence));
                prop_assert!(truth.confirms(measured), "{measured:?}, and it is {:?}", truth.at(measured.at));
            }
        }

        #[test]
        fn any_times_are_a_sample_or_refused(times: [[u64; 4]; 20]) {
            let mut clock = PeerClock::default();
            for times in times {
                let [a, b, c, d] = times.map(Time::from_nanos);
                clock.measure(Exchange { query_sent: a, query_received: b, answer_sent: c, answer_received: d });
                clock.offset(a);
            }
        }
    }

    /// Returns the clock of a peer that is queried every half second for this time.
    fn watched(truth: &Truth, seconds: u64) -> ClockOffset {
        let mut clock = PeerClock::default();
        let exchanges =
            (0..2 * seconds).map(|at| truth.exchange(BEGIN + at * SECOND / 2, [60_000, 20_000, 40_000]));
        exchanges.for_each(|exchange| assert_eq!(clock.measure(exchange), Measured::Offset));
        clock.offset(Time::from_nanos(BEGIN + seconds * SECOND)).unwrap()
    }

    #[test]
    fn drift_is_known_precisely_after_a_minute() {
        let truth = Truth::new(-7_000_000_000, 50_000, &[0]);
        let measured = watched(&truth, 5);
        assert_eq!(measured.drift, ClockDrift::UNKNOWN, "nothing is known before there are two spans");
        let measured = watched(&truth, 60);
        assert!(
            measured.drift.ppb.abs_diff(50_000) < 3_000 && measured.drift.bound_ppb < 10_000,
            "{measured:?}"
        );
    }

    #[test]
    fn clock_without_answers_for_an_hour_is_still_followed() {
        let truth = Truth::new(0, 50_000, &[0]);
        let measured = watched(&truth, 300);
        let later = measured.at(measured.at + Duration::from_secs(3_600));
        // By then it is 180 ms further ahead, and this is known.
        let error = later.theirs_minus_ours_ns.abs_diff(truth.at(later.at).0);
        assert!(error < 10_000_000, "{later:?}");
        assert!(later.bound > Duration::from_millis(100), "the drift may have changed: {later:?}");
    }

    #[test]
    fn leaping_clock_is_believed_without_its_old_drift() {
        let (before, after) = (Truth::new(0, 20_000, &[0]), Truth::new(1_000_000_000, 20_000, &[0]));
        let mut clock = PeerClock::default();
        let legs = [60_000, 20_000, 40_000];
        for at in 0..60 {
            assert_eq!(clock.measure(before.exchange(BEGIN + at * SECOND, legs)), Measured::Offset);
        }
        assert_eq!(clock.measure(after.exchange(BEGIN + 60 * SECOND, legs)), Measured::Leap);
        let measured = clock.offset(Time::from_nanos(BEGIN + 60 * SECOND + 120_000)).unwrap();
        assert!(after.confirms(measured) && measured.drift == ClockDrift::UNKNOWN, "{measured:?}");
        assert_eq!(clock.measure(after.exchange(BEGIN + 61 * SECOND, legs)), Measured::Offset);
    }

    #[test]
    fn steered_clock_loses_only_its_old_drift() {
        for ppb in [4_000, 12_000, 40_000, 150_000] {
            // Given: after a minute it runs at another rate.
            let before = Truth::new(0, 0, &[0]);
            let after = Truth::new(-60 * i64::from(ppb), ppb.into(), &[0]);
            let (mut clock, legs) = (PeerClock::default(), [60_000, 20_000, 40_000]);
            for at in 0..180 {
                let truth = if at < 60 { &before } else { &after };
                let measured = clock.measure(truth.exchange(BEGIN + at * SECOND, legs));
                assert_eq!(measured, Measured::Offset, "{ppb} at {at} s");
            }
            let measured = clock.offset(Time::from_nanos(BEGIN + 179 * SECOND + 120_000)).unwrap();
            assert!(after.confirms(measured), "{ppb}: {measured:?}");
        }
    }

    #[test]
    fn quick_exchange_counts_more_than_a_later_slow_one() {
        let mut clock = PeerClock::default();
        clock.measure(exchange(0, 500, [10_000, 0, 10_000]));
        clock.measure(exchange(SECOND, 500, [9_000_000, 0, 1_000]));
        let offset = clock.offset(Time::from_nanos(BEGIN + SECOND)).unwrap();
        assert_eq!(offset.theirs_minus_ours_ns, 500);
        assert!(offset.bound < Duration::from_millis(1), "{offset:?}");
    }

    #[test]
    fn answer_sent_before_its_query_arrived_is_refused() {
        let mut contradictory = exchange(0, 0, [10, 10, 10]);
        contradictory.answer_sent = Time::ZERO;
        assert_eq!(PeerClock::default().measure(contradictory), Measured::Nothing);
    }
}
