//! Whether others felt the kills: their p99 beside that of segments in which nobody ends, and in which as many end in order.

use std::{fmt, time::Duration};

use crate::clients::steady::Window;

/// The p99 with kills is so many times as long as either other one at most: more than this is felt.
const RATIO_MAX: f64 = 1.1;
/// Round trips below which a p99 is not believed: a hundred are above it.
const COUNT_MIN: u64 = 10_000;
/// What is noise in any case: two halves that happen to be alike do not say that there is none.
const NOISE_MIN: f64 = 1.05;
/// The limit is for ends that follow each other no sooner.
const SPACING_MIN: Duration = Duration::from_secs(1);

/// What the p99 of others says.
#[derive(Clone, Copy, Debug)]
pub struct Felt {
    /// With kills, of that while nobody ends, and of that with orderly ends.
    ratios: [f64; 2],
    /// While nobody ends, in every other segment, and in those between, in microseconds.
    halves: [u64; 2],
    is_enough: bool,
    /// One process ended in each such time.
    spacing: Duration,
}

/// Whether the limit is kept.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// It is.
    Kept,
    /// It is broken, by no more than two halves of one sort of segments differ.
    Noise,
    /// It is broken by more than that.
    Broken,
    /// The same, where processes ended faster than the limit is for.
    Crowded,
    /// Nobody knows: there were too few round trips.
    TooFew,
}

impl Felt {
    /// Of the round trips while nobody ends, with orderly ends, and with kills, one in each `spacing`; and of two halves of the first.
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

    /// How much longer one half's p99 is than the other's: they would be one, were there no chance. One draw of it: at least [`NOISE_MIN`].
    fn noise(&self) -> f64 {
        let [one, other] = self.halves;
        (one.max(other) as f64 / one.min(other).max(1) as f64).max(NOISE_MIN)
    }

    /// Whether the p99 with kills is within 10 % of both others, as far as can be said.
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
    fn a_tenth_longer_than_both_references_is_within_the_limit() {
        // A thousand kills at rest, as `docs/performance/shared-memory.md` has them.
        assert_eq!(felt([200, 215, 218], [201, 199]).verdict(), Verdict::Kept);
        assert_eq!(felt([200, 200, 220], [200, 200]).verdict(), Verdict::Kept);
    }

    #[test]
    fn more_than_a_tenth_longer_than_either_reference_is_felt() {
        for windows in [[200, 240, 240], [240, 200, 240], [163, 1_605, 1_858]] {
            let felt = felt(windows, [201, 199]);
            assert_eq!(felt.verdict(), Verdict::Broken, "{felt}");
            assert!(felt.to_string().contains("NOT SO"), "{felt}");
        }
    }

    #[test]
    fn what_two_halves_of_one_sort_differ_by_is_noise_and_more_than_that_is_felt() {
        assert_eq!(felt([200, 200, 240], [180, 200]).verdict(), Verdict::Noise);
        assert_eq!(felt([200, 200, 240], [200, 180]).verdict(), Verdict::Noise);
        assert_eq!(felt([200, 200, 250], [200, 180]).verdict(), Verdict::Broken);
    }

    #[test]
    fn of_too_few_round_trips_nothing_is_said() {
        let few = |p99_us| Window { count: COUNT_MIN - 1, ..window(p99_us) };
        for index in 0..3 {
            let mut windows = [200, 200, 900].map(window);
            windows[index] = few(windows[index].p99_us);
            assert_eq!(Felt::new(&windows, &[200, 200].map(window), SPACING_MIN).verdict(), Verdict::TooFew);
        }
        // The other half has no segment in the suite's short form.
        let halves = [window(200), Window::default()];
        assert_eq!(Felt::new(&[200, 200, 900].map(window), &halves, SPACING_MIN).verdict(), Verdict::TooFew);
    }

    #[test]
    fn halves_that_happen_to_be_alike_do_not_say_that_there_is_no_noise() {
        assert_eq!(felt([200, 200, 230], [200, 200]).verdict(), Verdict::Noise);
        assert_eq!(felt([200, 200, 232], [200, 200]).verdict(), Verdict::Broken);
    }

    #[test]
    fn ends_that_come_faster_than_the_limit_is_for_are_not_judged_by_it() {
        let felt =
            |p99_us, spacing| Felt::new(&[200, 200, p99_us].map(window), &[200, 200].map(window), spacing);
        let fast = SPACING_MIN - Duration::from_millis(1);
        assert_eq!(felt(900, fast).verdict(), Verdict::Crowded);
        assert!(felt(900, fast).to_string().contains("the limit is for one end a second"));
        assert_eq!(felt(900, SPACING_MIN).verdict(), Verdict::Broken);
        assert_eq!(felt(200, fast).verdict(), Verdict::Kept);
    }
}
