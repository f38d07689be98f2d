//! Runs what a seed decides, and says how it is replayed if that panics.

use std::{
    fmt,
    panic::{AssertUnwindSafe, catch_unwind},
};

/// The number in a variable of the environment.
///
/// # Panics
/// If what is there is none.
pub(crate) fn number(variable: &str) -> Option<u64> {
    std::env::var(variable).ok().map(|text| text.parse().expect("a number"))
}

/// A seed, and which test plays that one alone.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Seed {
    pub(crate) number: u64,
    /// The variable of the environment that names it.
    pub(crate) variable: &'static str,
    pub(crate) package: &'static str,
    pub(crate) test: &'static str,
}

impl Seed {
    /// Runs what this seed decides. A panic, be it of the world or of the core that is tried in it, goes on with how to replay it.
    pub(crate) fn run<T>(&self, run: impl FnOnce() -> T) -> T {
        catch_unwind(AssertUnwindSafe(run)).unwrap_or_else(|cause| {
            let text = cause.downcast_ref::<String>().map(String::as_str);
            let words = text.or_else(|| cause.downcast_ref::<&str>().copied()).unwrap_or("it panicked");
            panic!("{words}\n{self}")
        })
    }
}

/// The command that replays it.
impl fmt::Display for Seed {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { number, variable, package, test } = self;
        // Arithmetic that overflows panics in the one profile only.
        let profile = if cfg!(debug_assertions) { "" } else { "--release " };
        write!(
            formatter,
            "seed {number}; replay it: {variable}={number} cargo test {profile}-p {package} --lib {test} -- --nocapture"
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SEED: Seed = Seed { number: 7, variable: "ANY_SEED", package: "any", test: "it_is_replayed" };

    #[test]
    #[should_panic(expected = "nobody is there\nseed 7; replay it: ANY_SEED=7 cargo test ")]
    fn a_panic_says_how_its_seed_is_replayed() {
        SEED.run(|| panic!("nobody is there"));
    }

    #[test]
    #[should_panic(expected = "replay it: ANY_SEED=7 cargo test ")]
    fn so_does_a_number_that_is_too_large() {
        SEED.run(|| std::hint::black_box(&[0u8; 2])[std::hint::black_box(2)]);
    }

    #[test]
    fn what_does_not_panic_is_returned() {
        assert_eq!(SEED.run(|| 5), 5);
    }
}
