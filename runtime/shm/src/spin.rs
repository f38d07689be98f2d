//! Spinning before a sleep: whether, how long, and its adaptation.

use std::time::Duration;

/// How a thread spins before it sleeps. Spinning keeps a CPU busy and saves the wake, which is most of the
/// latency of a short message.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Spin {
    /// Sleeps at once. For shared CPUs, or to save power.
    #[default]
    Off,
    /// Spins for this long, and never beyond the deadline of the wait. For a thread with a CPU of its own.
    /// The end of the peer is noticed after the spin.
    For(Duration),
    /// Spins about twice as long as messages lately took to arrive, and not at all when they take longer than
    /// `max`.
    Adaptive {
        /// The longest spin.
        max: Duration,
    },
}

/// One of this many waits without a spin does spin: the peer may have become faster.
const PROBE_EVERY: u32 = 64;

/// The length of the next spin. Pure: times are arguments.
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

    /// Returns how long to spin before the next sleep.
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

    /// Records the length of the wait, asleep or not.
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

    /// Whether `learn` uses its argument: reading the clock has a cost.
    pub(crate) const fn learns(&self) -> bool {
        matches!(self.spin, Spin::Adaptive { .. })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MAX: Duration = Duration::from_micros(50);

    #[test]
    fn off_never_spins_and_fixed_always_does() {
        let (mut off, mut fixed) = (Spinner::new(Spin::Off), Spinner::new(Spin::For(MAX)));
        for _ in 0..1_000 {
            assert_eq!((off.begin(), fixed.begin()), (Duration::ZERO, MAX));
            off.learn(Duration::from_nanos(1));
            fixed.learn(Duration::from_secs(1));
        }
    }

    #[test]
    fn adaptive_stops_for_a_slow_peer_and_probes() {
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
    fn adaptive_finds_a_faster_peer_within_one_probe() {
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
