//! The round-trip time, and the time after which a value counts as lost.

use std::time::Duration;

/// Shortest time-out: twice the wait of an acknowledgement for a value that carries it, and a timer's
/// millisecond. TCP's minimum is 200 ms.
pub(super) const TIME_OUT_MIN: Duration = Duration::from_millis(4);
/// Longest time-out, also of a value that was repeated often: a recovered network gets the value within this time.
pub(super) const TIME_OUT_MAX: Duration = Duration::from_millis(250);
/// Longest wait of an acknowledgement at the receiver, and its timer's millisecond. It is not part of the measured
/// round trip. RFC 9002, section 6.2.1.
const ACK_WAIT_MAX: Duration = Duration::from_micros(2_500);
/// Time-out before the first round trip is known.
const TIME_OUT_FIRST: Duration = Duration::from_millis(20);

/// The smoothed round trip and its variation. RFC 6298, section 2.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct RoundTrip {
    smoothed: Duration,
    variation: Duration,
    is_known: bool,
}

impl RoundTrip {
    /// Records the duration of a round trip.
    pub(super) fn measured(&mut self, took: Duration) {
        let took = took.min(Duration::from_secs(10));
        if self.is_known {
            self.variation = (self.variation * 3 + self.smoothed.abs_diff(took)) / 4;
            self.smoothed = (self.smoothed * 7 + took) / 8;
        } else {
            *self = Self { smoothed: took, variation: took / 2, is_known: true };
        }
    }

    /// Returns how long to wait for the acknowledgement of a value that was repeated this often; it doubles
    /// each time. RFC 6298, section 5.
    pub(super) fn time_out(&self, repeats: u32) -> Duration {
        let once = if self.is_known {
            (self.smoothed + self.variation * 4 + ACK_WAIT_MAX).clamp(TIME_OUT_MIN, TIME_OUT_MAX)
        } else {
            TIME_OUT_FIRST
        };
        (once * (1 << repeats.min(6))).min(TIME_OUT_MAX)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const fn ms(millis: u64) -> Duration {
        Duration::from_millis(millis)
    }

    #[test]
    fn timeout_follows_the_round_trip_within_bounds_and_doubles() {
        let mut trip = RoundTrip::default();
        assert_eq!(trip.time_out(0), TIME_OUT_FIRST);
        trip.measured(ms(20));
        assert_eq!(trip.time_out(0), ms(60) + ACK_WAIT_MAX);
        for _ in 0..100 {
            trip.measured(ms(20));
        }
        assert!(trip.time_out(0) < ms(21) + ACK_WAIT_MAX, "{trip:?}");
        for _ in 0..100 {
            trip.measured(Duration::from_micros(100));
        }
        assert_eq!(
            [0, 1, 2, 9].map(|repeats| trip.time_out(repeats)),
            [TIME_OUT_MIN, ms(8), ms(16), TIME_OUT_MAX]
        );
        trip.measured(Duration::MAX);
        assert_eq!(trip.time_out(0), TIME_OUT_MAX);
    }
}
