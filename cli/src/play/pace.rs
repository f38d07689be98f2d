//! When each message is due.

use std::time::Duration;

use sinew::Time;

/// The slowest and the fastest rate.
const LIMITS: (f64, f64) = (0.001, 1_000.0);
/// A message that is sent so much later than it was due counts as late.
const LATE: Duration = Duration::from_millis(5);

/// How fast a recording is played.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Rate {
    /// So many times as fast as it was recorded.
    Factor(f64),
    /// Without waits.
    Max,
}

impl Rate {
    /// Reads it from the command line.
    pub(crate) fn read(text: &str) -> Result<Self, String> {
        if text == "max" {
            return Ok(Self::Max);
        }
        let factor = text.parse::<f64>().ok().filter(|factor| (LIMITS.0..=LIMITS.1).contains(factor));
        let (slowest, fastest) = LIMITS;
        factor
            .map(Self::Factor)
            .ok_or_else(|| format!("write a number from {slowest} to {fastest}, or `max`"))
    }
}

/// The times of one pass through a recording. Each is computed from the begin of the pass, so that no delay adds up.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Pace {
    began: Time,
    from: Duration,
    rate: Rate,
}

impl Pace {
    /// Begins the pass now. The part of the recording before `from` takes no time.
    pub(crate) const fn new(began: Time, from: Duration, rate: Rate) -> Self {
        Self { began, from, rate }
    }

    /// Returns when the message is due that was sent at this time after the first one; `None`: at once.
    pub(crate) fn due(&self, offset: Duration) -> Option<Time> {
        match self.rate {
            Rate::Max => None,
            Rate::Factor(factor) => {
                let seconds = offset.saturating_sub(self.from).as_secs_f64() / factor;
                Some(self.began + Duration::try_from_secs_f64(seconds).unwrap_or(Duration::MAX))
            }
        }
    }

    /// Returns whether a message that is sent now is late.
    pub(crate) fn is_late(due: Option<Time>, now: Time) -> bool {
        due.is_some_and(|due| now.since(due) > LATE)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn seconds(seconds: u64) -> Duration {
        Duration::from_secs(seconds)
    }

    #[test]
    fn rates_outside_of_the_limits_are_refused() {
        assert_eq!((Rate::read("0.5"), Rate::read("max")), (Ok(Rate::Factor(0.5)), Ok(Rate::Max)));
        for text in ["0", "-1", "NaN", "inf", "1e9", "fast"] {
            assert!(Rate::read(text).unwrap_err().contains("`max`"), "{text}");
        }
    }

    #[test]
    fn due_times_follow_the_rate_and_the_begin() {
        let began = Time::from_nanos(7_000_000_000);
        let half = Pace::new(began, seconds(10), Rate::Factor(0.5));
        assert_eq!(half.due(seconds(10)), Some(began));
        assert_eq!(half.due(seconds(12)), Some(began + seconds(4)));
        assert_eq!(half.due(seconds(1)), Some(began), "it was sent before the part that is played");
        assert_eq!(Pace::new(began, seconds(0), Rate::Max).due(seconds(5)), None);
    }

    #[test]
    fn late_message_is_more_than_5_ms_behind() {
        let due = Time::from_nanos(1_000_000_000);
        assert!(!Pace::is_late(Some(due), due + LATE));
        assert!(Pace::is_late(Some(due), due + LATE + Duration::from_nanos(1)));
        assert!(!Pace::is_late(None, due + seconds(9)));
    }
}
