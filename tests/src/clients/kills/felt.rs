//! Whether the others were slowed down by the kills: their p99 compared with segments without ends, and with
//! as many orderly ends.

use std::{fmt, time::Duration};

use crate::clients::steady::Window;

/// Maximum ratio of the p99 with kills to either other p99. A higher ratio counts as a slowdown.
const RATIO_MAX: f64 = 1.1;
/// Minimum number of round trips for a p99: a hundred of them are above it.
const COUNT_MIN: u64 = 10_000;
/// Minimum noise to assume: two halves that happen to be equal do not prove that there is none.
const NOISE_MIN: f64 = 1.05;
/// The limit applies only to ends at least this far apart.
const SPACING_MIN: Duration = Duration::from_secs(1);

/// The evaluation of the p99 of the others.
#[derive(Clone, Copy, Debug)]
pub struct Felt {
    /// Ratio of the p99 with kills to that without ends, and to that with orderly ends.
    ratios: [f64; 2],
    /// p99 without ends, in every other segment and in those between, in microseconds.
    halves: [u64; 2],
    is_enough: bool,
    /// One process ended in each such interval.
    spacing: Duration,
}

/// The verdict on the limit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// The limit is kept.
    Kept,
    /// The limit is exceeded, but by no more than two halves of one kind of segments differ.
    Noise,
    /// The limit is exceeded by more than that.
    Broken,
    /// The same, but processes ended faster than the limit allows for.
    Crowded,
    /// Unknown: there were too few round trips.
    TooFew,
}

impl Felt {
    /// From the round trips without ends, with orderly ends, and with kills, one in each `spacing`, and from
    /// two halves of the first.
    pub(super) fn new(windows: &[Window; 3], halves: &[Window; 2], spacing: Duration) -> Self {
        let [quiet, in_order, killed] = windows;
        let ratio = |reference: &Window| killed.p99_us as f64 / reference.p99_us.max(1) as f64;
        Self {
            ratios: [ratio(quiet), ratio(in_order)],
            halves: halves.map(|half| half.p99_us),
            is_enough: windows.iter().chain(halves).all(|window| window.count >= COUNT_MIN),
            spacing,
        }
    }

    /// Ratio of the higher to the lower p99 of the halves, at least [`NOISE_MIN`]. Without noise both would
    /// be equal; this is one sample of it.
    fn noise(&self) -> f64 {
        let [one, other] = self.halves;
        (one.max(other) as f64 / one.min(other).max(1) as f64).max(NOISE_MIN)
    }

    /// Returns whether the p99 with kills is within 10 % of both others, as far as can be known.
    #[must_use]
    pub fn verdict(&self) -> Verdict {
        let worst = self.ratios[0].max(self.ratios[1]);
        if !self.is_enough {
            Verdict::TooFew
        } else if worst <= RATIO_MAX {
            Verdict::Kept
        } else if worst <= RATIO_MAX * self.noise() {
            Verdict::Noise
        } else if self.spacing < SPACING_MIN {
            Verdict::Crowded
        } else {
            Verdict::Broken
        }
    }
}

impl fmt::Display for Felt {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (Self { ratios, halves, .. }, noise) = (self, self.noise());
        writeln!(
            f,
            "p99 with kills: {:.2} of that while nobody ends, {:.2} of that with orderly ends; while nobody ends, in every \
             other segment: {} and {} us, so {noise:.2} is noise (at least {NOISE_MIN:.2})",
            ratios[0], ratios[1], halves[0], halves[1]
        )?;
        let limit = RATIO_MAX * noise;
        write!(f, "expected of both: {RATIO_MAX:.2} at most; seen: ")?;
        match self.verdict() {
            Verdict::Kept => write!(f, "so"),
            Verdict::Noise => {
                write!(f, "more, but not beyond {limit:.2}, which is that with noise: nobody knows")
            }
            Verdict::Broken => write!(f, "NOT SO, beyond {limit:.2}, which is that with noise"),
            Verdict::Crowded => write!(
                f,
                "more, beyond {limit:.2}, which is that with noise; but the limit is for one end a second, and here one came in {:?}",
                self.spacing
            ),
            Verdict::TooFew => write!(f, "nobody knows: it takes {COUNT_MIN} round trips of each sort"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn window(p99_us: u64) -> Window {
        Window { count: 100_000, p99_us, ..Window::default() }
    }

    fn felt(windows: [u64; 3], halves: [u64; 2]) -> Felt {
        Felt::new(&windows.map(window), &halves.map(window), SPACING_MIN)
    }

    #[test]
    fn ten_percent_above_both_references_is_within_limit() {
        // A thousand kills on an idle machine, from `docs/performance/log/shared-memory.md`.
        assert_eq!(felt([200, 215, 218], [201, 199]).verdict(), Verdict::Kept);
        assert_eq!(felt([200, 200, 220], [200, 200]).verdict(), Verdict::Kept);
    }

    #[test]
    fn more_than_ten_percent_above_a_reference_breaks_limit() {
        for windows in [[200, 240, 240], [240, 200, 240], [163, 1_605, 1_858]] {
            let felt = felt(windows, [201, 199]);
            assert_eq!(felt.verdict(), Verdict::Broken, "{felt}");
            assert!(felt.to_string().contains("NOT SO"), "{felt}");
        }
    }

    #[test]
    fn excess_beyond_difference_of_halves_breaks_limit() {
        assert_eq!(felt([200, 200, 240], [180, 200]).verdict(), Verdict::Noise);
        assert_eq!(felt([200, 200, 240], [200, 180]).verdict(), Verdict::Noise);
        assert_eq!(felt([200, 200, 250], [200, 180]).verdict(), Verdict::Broken);
    }

    #[test]
    fn too_few_round_trips_give_no_verdict() {
        let few = |p99_us| Window { count: COUNT_MIN - 1, ..window(p99_us) };
        for index in 0..3 {
            let mut windows = [200, 200, 900].map(window);
            windows[index] = few(windows[index].p99_us);
            assert_eq!(Felt::new(&windows, &[200, 200].map(window), SPACING_MIN).verdict(), Verdict::TooFew);
        }
        // In the suite's short form the other half has no segment.
        let halves = [window(200), Window::default()];
        assert_eq!(Felt::new(&[200, 200, 900].map(window), &halves, SPACING_MIN).verdict(), Verdict::TooFew);
    }

    #[test]
    fn equal_halves_still_allow_minimum_noise() {
        assert_eq!(felt([200, 200, 230], [200, 200]).verdict(), Verdict::Noise);
        assert_eq!(felt([200, 200, 232], [200, 200]).verdict(), Verdict::Broken);
    }

    #[test]
    fn limit_does_not_apply_to_faster_ends() {
        let felt =
            |p99_us, spacing| Felt::new(&[200, 200, p99_us].map(window), &[200, 200].map(window), spacing);
        let fast = SPACING_MIN - Duration::from_millis(1);
        assert_eq!(felt(900, fast).verdict(), Verdict::Crowded);
        assert!(felt(900, fast).to_string().contains("the limit is for one end a second"));
        assert_eq!(felt(900, SPACING_MIN).verdict(), Verdict::Broken);
        assert_eq!(felt(200, fast).verdict(), Verdict::Kept);
    }
}
