//! How far a peer's clock is from ours, from the four times of a query and its answer.
//!
//! ```text
//! ours    t1 --query-->            t4        offset = ((t2 - t1) + (t3 - t4)) / 2
//! theirs         t2 --answer--> t3           bound  = ((t4 - t1) - (t3 - t2)) / 2, and what the clocks drift apart from t1 to t4
//! ```

use std::{collections::VecDeque, time::Duration};

use sinew_runtime::time::Time;

use crate::stores::ClockOffset;

/// Samples of which the best one counts.
const SAMPLES_MAX: usize = 8;

/// Two quartz clocks drift apart by at most this; datasheets say +-50 for each, cold and old ones do worse.
const DRIFT_PPM: u64 = 200;

/// The four times of one exchange.
#[derive(Clone, Copy, Debug)]
pub(super) struct Exchange {
    pub(super) query_sent: Time,
    pub(super) query_received: Time,
    pub(super) answer_sent: Time,
    pub(super) answer_received: Time,
}

impl Exchange {
    /// Time on the network, the peer's thinking time not counted; `None` if the times contradict each other.
    pub(super) fn round_trip(self) -> Option<Duration> {
        sample(self).map(|sample| sample.round_trip)
    }
}

#[derive(Clone, Copy, Debug)]
struct Sample {
    at: Time,
    offset_ns: i64,
    bound_ns: u64,
    round_trip: Duration,
}

impl Sample {
    /// The bound now: the clocks drift on since the sample was taken.
    fn bound_at(&self, now: Time) -> u64 {
        self.bound_ns.saturating_add(drift_ns(now.since(self.at)))
    }
}

/// The last exchanges with one peer.
#[derive(Debug, Default)]
pub(super) struct PeerClock {
    samples: VecDeque<Sample>,
    round_trip: Option<Duration>,
}

impl PeerClock {
    /// Takes in an exchange; `false` if its times contradict each other. // spec: NDL-6
    pub(super) fn measure(&mut self, exchange: Exchange) -> bool {
        let Some(sample) = sample(exchange) else { return false };
        self.round_trip = Some(sample.round_trip);
        if self.samples.len() == SAMPLES_MAX {
            self.samples.pop_front();
        }
        self.samples.push_back(sample);
        true
    }

    /// The offset with the smallest bound, the bound as it will be `horizon` from now.
    pub(super) fn offset(&self, now: Time, horizon: Duration) -> Option<ClockOffset> {
        let best = self.samples.iter().min_by_key(|sample| sample.bound_at(now))?;
        let bound = Duration::from_nanos(best.bound_at(now + horizon));
        Some(ClockOffset { theirs_minus_ours_ns: best.offset_ns, bound })
    }

    /// Time of the last query and answer on the network, the peer's thinking time not counted.
    pub(super) const fn round_trip(&self) -> Option<Duration> {
        self.round_trip
    }
}

/// Nanoseconds by which two clocks drift apart in this time at most, rounded up.
fn drift_ns(time: Duration) -> u64 {
    let micros = u64::try_from(time.as_micros()).unwrap_or(u64::MAX).saturating_add(1);
    micros.saturating_mul(DRIFT_PPM).div_ceil(1_000)
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
    // Rounded up: a bound errs on the safe side.
    let half_ns = u64::try_from((away - there + 1) / 2).ok()?;
    let drift_ns = drift_ns(exchange.answer_received.since(exchange.query_sent));
    let (at, bound_ns) = (exchange.answer_received, half_ns.saturating_add(drift_ns));
    Some(Sample { at, offset_ns, bound_ns, round_trip: Duration::from_nanos(half_ns.saturating_mul(2)) })
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const SECOND: i64 = 1_000_000_000;

    /// An exchange at `at` with a peer whose clock is `offset` ahead.
    fn exchange(at: u64, offset: i64, [there, thinking, back]: [u64; 3]) -> Exchange {
        let theirs = |nanos: u64| Time::from_nanos(nanos).shifted(offset);
        Exchange {
            query_sent: Time::from_nanos(at),
            query_received: theirs(at + there),
            answer_sent: theirs(at + there + thinking),
            answer_received: Time::from_nanos(at + there + thinking + back),
        }
    }

    proptest! {
        #[test]
        fn the_true_offset_is_within_the_bound(
            offset in -1_000_000 * SECOND..1_000_000 * SECOND,
            legs in proptest::collection::vec(any::<[u32; 3]>(), 1..20),
        ) {
            let (mut clock, mut now) = (PeerClock::default(), 2_000_000 * SECOND as u64);
            for legs in legs {
                let exchange = exchange(now, offset, legs.map(u64::from));
                now = exchange.answer_received.as_nanos();
                prop_assert!(clock.measure(exchange));
                let said = clock.offset(exchange.answer_received, Duration::ZERO).unwrap();
                let error = u128::from(said.theirs_minus_ours_ns.abs_diff(offset));
                prop_assert!(error <= said.bound.as_nanos() + 1, "{said:?}");
            }
        }

        #[test]
        fn any_times_are_a_sample_or_refused(times: [u64; 4]) {
            let [a, b, c, d] = times.map(Time::from_nanos);
            let exchange = Exchange { query_sent: a, query_received: b, answer_sent: c, answer_received: d };
            PeerClock::default().measure(exchange);
        }
    }

    #[test]
    fn a_quick_exchange_counts_more_than_a_later_slow_one() {
        let mut clock = PeerClock::default();
        clock.measure(exchange(0, 500, [10_000, 0, 10_000]));
        clock.measure(exchange(SECOND as u64, 500, [9_000_000, 0, 1_000]));
        let offset = clock.offset(Time::from_nanos(SECOND as u64), Duration::ZERO).unwrap();
        assert_eq!(offset.theirs_minus_ours_ns, 500);
        assert!(offset.bound < Duration::from_millis(1), "{offset:?}");
    }

    #[test]
    fn an_answer_that_left_before_its_query_came_is_refused() {
        let mut contradictory = exchange(0, 0, [10, 10, 10]);
        contradictory.answer_sent = Time::ZERO;
        assert!(!PeerClock::default().measure(contradictory));
    }
}
