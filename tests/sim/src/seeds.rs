//! The seeds of a simulation, chosen by environment variables.

use std::{env, ops::Range};

use crate::{History, Seed, number};

/// The seeds of a simulation. Environment variables change them.
///
/// For the variable `SINEW_NDL_SEED`:
///
/// - `SINEW_NDL_SEED=7` runs the seed 7 alone, and prints its history.
/// - `SINEW_NDL_SEEDS=10000` sets the number of seeds.
/// - `SINEW_NDL_SEED_FROM=500` sets the first one.
#[derive(Clone, Copy, Debug)]
pub struct Seeds {
    /// The variable that names one seed.
    pub variable: &'static str,
    /// The package of the test.
    pub package: &'static str,
    /// The option of cargo that selects the tests: `--lib`, or `--test NAME`.
    pub target: &'static str,
    /// The name of the test that replays a seed.
    pub test: &'static str,
    /// Number of seeds in an ordinary run.
    pub count: u64,
}

impl Seeds {
    /// Returns the one seed to replay, if it is set.
    ///
    /// # Panics
    /// If the variable is not a number.
    #[must_use]
    pub fn only(&self) -> Option<u64> {
        number(self.variable)
    }

    /// Returns the seeds to run.
    ///
    /// # Panics
    /// If a variable is not a number.
    #[must_use]
    pub fn numbers(&self) -> Range<u64> {
        if let Some(only) = self.only() {
            return only..only + 1;
        }
        let first = number(&format!("{}_FROM", self.variable)).unwrap_or_default();
        first..first + number(&format!("{}S", self.variable)).unwrap_or(self.count)
    }

    /// Returns a seed, which knows how it is replayed.
    #[must_use]
    pub const fn seed(&self, number: u64) -> Seed {
        Seed { number, variable: self.variable, package: self.package, target: self.target, test: self.test }
    }

    /// Runs all seeds. A failed one is repeated with its history.
    ///
    /// # Panics
    /// If a seed fails: with the words of its judge or its panic, its history, and the command that replays
    /// it.
    pub fn run(&self, mut play: impl FnMut(u64, &History) -> Result<(), String>) {
        let is_replayed = self.only().is_some();
        for number in self.numbers() {
            let seed = self.seed(number);
            let history = if is_replayed { History::printed() } else { History::off() };
            let Err(words) = seed.judge(|| play(number, &history)) else { continue };
            if is_replayed {
                panic!("{words}\n{seed}");
            }
            let history = History::kept();
            let again = seed.judge(|| play(number, &history)).err();
            let differs = if again.as_ref() == Some(&words) { "" } else { "\nthe repetition differs" };
            panic!("{words}{differs}\n{history}{seed}");
        }
    }

    /// Returns the one planted fault to search, if it is set by the variable with `_FAULT` behind it.
    pub(crate) fn fault(&self) -> Option<String> {
        env::var(format!("{}_FAULT", self.variable)).ok()
    }
}

#[cfg(test)]
mod tests {
    use sinew_runtime::time::Time;

    use super::*;

    const SEEDS: Seeds = Seeds {
        variable: "SINEW_SIM_TEST_SEED",
        package: "any",
        target: "--test all",
        test: "it_is_replayed",
        count: 5,
    };

    #[test]
    #[should_panic(
        expected = "three\n       0.000 ms  drawn\nseed 3; replay it: SINEW_SIM_TEST_SEED=3 cargo test "
    )]
    fn failed_seed_is_repeated_with_its_history() {
        SEEDS.run(|seed, history| {
            history.note(Time::ZERO, || "drawn".to_owned());
            if seed == 3 { Err("three".to_owned()) } else { Ok(()) }
        });
    }

    #[test]
    #[should_panic(expected = "-p any --test all it_is_replayed -- --nocapture")]
    fn panic_names_the_target_of_its_replay() {
        SEEDS.run(|_, _| panic!("nobody is there"));
    }

    #[test]
    fn every_seed_of_a_passing_run_is_played() {
        let mut played = Vec::new();
        SEEDS.run(|seed, _| {
            played.push(seed);
            Ok(())
        });
        assert_eq!(played, [0, 1, 2, 3, 4]);
    }
}
