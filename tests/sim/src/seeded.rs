//! Runs a test from a seed, and prints how to replay it after a panic.

use std::{
    fmt,
    panic::{AssertUnwindSafe, catch_unwind},
};

/// Returns the number in an environment variable.
///
/// # Panics
/// If the value is not a number.
#[must_use]
pub fn number(variable: &str) -> Option<u64> {
    std::env::var(variable).ok().map(|text| text.parse().expect("a number"))
}

/// A seed, and which test plays that one alone.
#[derive(Clone, Copy, Debug)]
pub struct Seed {
    /// The number.
    pub number: u64,
    /// The variable of the environment that names it.
    pub variable: &'static str,
    /// The package of the test.
    pub package: &'static str,
    /// The option of cargo that selects the tests: `--lib`, or `--test NAME`.
    pub target: &'static str,
    /// The name of the test.
    pub test: &'static str,
}

impl Seed {
    /// Runs the test with this seed. A panic, in the test or in the tested core, is extended by the command
    /// for a replay.
    ///
    /// # Panics
    /// If the test does.
    pub fn run<T>(&self, run: impl FnOnce() -> T) -> T {
        self.judge(|| Ok(run())).unwrap_or_else(|words| panic!("{words}\n{self}"))
    }

    /// Runs the test with this seed. A panic is an error, too.
    ///
    /// # Errors
    /// Returns the words of the judge, or of the panic.
    pub fn judge<T>(&self, run: impl FnOnce() -> Result<T, String>) -> Result<T, String> {
        catch_unwind(AssertUnwindSafe(run)).unwrap_or_else(|cause| {
            let text = cause.downcast_ref::<String>().map(String::as_str);
            let words = text.or_else(|| cause.downcast_ref::<&str>().copied()).unwrap_or("it panicked");
            Err(words.to_owned())
        })
    }
}

/// The command that replays it.
impl fmt::Display for Seed {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { number, variable, package, target, test } = self;
        // Arithmetic that overflows panics in the one profile only.
        let profile = if cfg!(debug_assertions) { "" } else { "--release " };
        write!(
            formatter,
            "seed {number}; replay it: {variable}={number} cargo test {profile}-p {package} {target} {test} -- --nocapture"
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SEED: Seed =
        Seed { number: 7, variable: "ANY_SEED", package: "any", target: "--lib", test: "it_is_replayed" };

    #[test]
    #[should_panic(expected = "nobody is there\nseed 7; replay it: ANY_SEED=7 cargo test ")]
    fn panic_names_the_replay_of_its_seed() {
        SEED.run(|| panic!("nobody is there"));
    }

    #[test]
    #[should_panic(expected = "replay it: ANY_SEED=7 cargo test ")]
    fn index_panic_names_the_replay_of_its_seed() {
        SEED.run(|| std::hint::black_box(&[0u8; 2])[std::hint::black_box(2)]);
    }

    #[test]
    fn result_without_a_panic_is_returned() {
        assert_eq!(SEED.run(|| 5), 5);
    }
}
