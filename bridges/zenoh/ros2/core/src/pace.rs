//! The limit of a rate.

use std::time::Duration;

/// A limit on messages per second: one more may come one period early, so that a periodic sender with a varying latency
/// loses none.
#[derive(Clone, Debug)]
pub(crate) struct Pace {
    period: Duration,
    /// When the next one is due at a steady rate.
    due: Option<Duration>,
}

impl Pace {
    pub(crate) const fn new(period: Duration) -> Self {
        Self { period, due: None }
    }

    /// Returns whether one may pass now. It is counted then.
    pub(crate) fn take(&mut self, now: Duration) -> bool {
        let due = self.due.unwrap_or(now).max(now);
        if due.saturating_sub(now) > self.period {
            return false;
        }
        self.due = Some(due + self.period);
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rate_is_limited_and_late_messages_are_made_up() {
        let ms = Duration::from_millis;
        let mut pace = Pace::new(ms(10));
        let passed =
            |pace: &mut Pace, step: u64| (0..1_000_u64).filter(|at| pace.take(ms(at * step))).count();
        // 1,000 a second for a second.
        assert_eq!(passed(&mut pace, 1), 101);
        let mut pace = Pace::new(ms(10));
        assert_eq!(passed(&mut pace, 10), 1_000);
        let mut pace = Pace::new(ms(10));
        let late = [0, 10, 27, 31, 40].map(|at| pace.take(ms(at)));
        assert_eq!(late, [true; 5]);
    }
}
