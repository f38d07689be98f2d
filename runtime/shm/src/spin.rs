//! Looking for a while before sleeping: whether, how long, and what is learned from it.

use std::time::Duration;

/// What a thread does before it sleeps. Spinning keeps a CPU busy and saves the wake, which is most of a short message's way.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Spin {
    /// Sleeps at once. Right when CPUs are shared or power counts.
    #[default]
    Off,
    /// Looks for this long, and never beyond the deadline of the wait. Right when the thread has a CPU of its own. That the peer has ended
    /// is seen after the look.
    For(Duration),
    /// Looks about twice as long as messages lately took to come, and not at all when they take longer than `max`.
    Adaptive {
        /// The longest to look.
        max: Duration,
    },
}

/// Of so many waits that did not spin, one does: the peer may have become quicker.
const PROBE_EVERY: u32 = 64;

/// How long to spin now. Pure: times come in as arguments.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Spinner {
    spin: Spin,
    budget: Duration,
    without: u32,
}

impl Spinner {
    pub(crate) const fn new(spin: Spin) -> Self {
        let budget = match spin {
            Spin::Off => Duration::ZERO,
            Spin::For(time) => time,
            Spin::Adaptive { max } => max,
        };
        Self { spin, budget, without: 0 }
    }

    /// How long to look before the sleep that comes now.
    pub(crate) fn begin(&mut self) -> Duration {
        let Spin::Adaptive { max } = self.spin else {
            return self.budget;
        };
        if self.budget > Duration::ZERO {
            return self.budget;
        }
        self.without += 1;
        if self.without < PROBE_EVERY {
            return Duration::ZERO;
        }
        self.without = 0;
        max
    }

    /// Takes into account how long the wait was, asleep or not.
    pub(crate) fn learn(&mut self, waited: Duration) {
        if let Spin::Adaptive { max } = self.spin {
            self.budget = if waited < max {
                (waited * 2).clamp(max / 16, max)
            } else if self.budget > max / 16 {
                self.budget / 2
            } else {
                Duration::ZERO
            };
        }
    }

    /// Whether `learn` has any use for a time: reading the clock costs.
    pub(crate) const fn learns(&self) -> bool {
        matches!(self.spin, Spin::Adaptive { .. })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MAX: Duration = Duration::from_micros(50);

    #[test]
    fn off_never_spins_and_a_fixed_time_always_does() {
        let (mut off, mut fixed) = (Spinner::new(Spin::Off), Spinner::new(Spin::For(MAX)));
        for _ in 0..1_000 {
            assert_eq!((off.begin(), fixed.begin()), (Duration::ZERO, MAX));
            off.learn(Duration::from_nanos(1));
            fixed.learn(Duration::from_secs(1));
        }
    }

    #[test]
    fn adaptive_gives_up_on_a_slow_peer_and_then_only_probes() {
        let mut spinner = Spinner::new(Spin::Adaptive { max: MAX });
        for _ in 0..8 {
            spinner.begin();
            spinner.learn(Duration::from_millis(1));
        }
        let mut spun = 0;
        for _ in 0..PROBE_EVERY * 10 {
            spun += u32::from(spinner.begin() > Duration::ZERO);
            spinner.learn(Duration::from_millis(1));
        }
        assert_eq!(spun, 10);
    }

    #[test]
    fn adaptive_finds_a_peer_that_became_quick_within_one_probe() {
        let mut spinner = Spinner::new(Spin::Adaptive { max: MAX });
        for _ in 0..8 {
            spinner.begin();
            spinner.learn(Duration::from_millis(1));
        }
        let mut waits = 0;
        while spinner.begin() == Duration::ZERO {
            waits += 1;
            spinner.learn(Duration::from_millis(1));
            assert!(waits <= PROBE_EVERY, "it probes");
        }
        spinner.learn(Duration::from_micros(4));
        assert_eq!(spinner.begin(), Duration::from_micros(8));
    }
}
