//! The search for planted faults.

use std::fmt::Debug;

use crate::{History, Seeds};

/// A search for planted faults: each must be found within some seeds, and the same seed without it must pass.
#[derive(Clone, Copy, Debug)]
pub struct Hunt<'a, F> {
    /// The seeds of the simulation, for the command that replays one. Its variable with `_FAULT` behind it
    /// names the only fault to search.
    pub seeds: &'a Seeds,
    /// The faults.
    pub faults: &'a [F],
    /// Number of seeds, from 0, within which each fault must be found.
    pub within: u64,
    /// Seeds that are tried first: a rare fault is found there at once.
    pub found_last: &'a [(F, u64)],
}

/// A planted fault that was found.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Found<F> {
    /// The fault.
    pub fault: F,
    /// The first seed that found it.
    pub seed: u64,
    /// The words of the judge.
    pub words: String,
}

impl<F: Copy + Debug + PartialEq> Hunt<'_, F> {
    /// Searches each fault, and prints the seed that finds it and the judge's words. A panic of a run with a
    /// fault counts as found.
    ///
    /// # Panics
    /// If a fault is not found, or if a seed that finds one fails without it, too.
    pub fn run(&self, mut play: impl FnMut(u64, Option<F>, &History) -> Result<(), String>) -> Vec<Found<F>> {
        let only = self.seeds.fault();
        let is_wanted = |fault: &F| only.as_ref().is_none_or(|only| *only == format!("{fault:?}"));
        let (mut found, mut missing) = (Vec::new(), Vec::new());
        for fault in self.faults.iter().copied().filter(is_wanted) {
            let Some(this) = self.search(fault, &mut play) else {
                missing.push(fault);
                continue;
            };
            let Found { seed, words, .. } = &this;
            println!("{fault:?}: seed {seed}: {}", words.lines().next().unwrap_or_default());
            if let Err(words) = self.seeds.seed(*seed).judge(|| play(*seed, None, &History::off())) {
                panic!("without {fault:?}: {words}\n{}", self.seeds.seed(*seed));
            }
            found.push(this);
        }
        assert!(missing.is_empty(), "not found in {} seeds: {missing:?}", self.within);
        found
    }

    fn search(
        &self,
        fault: F,
        play: &mut impl FnMut(u64, Option<F>, &History) -> Result<(), String>,
    ) -> Option<Found<F>> {
        let last = self.found_last.iter().filter(|(of, _)| *of == fault).map(|(_, seed)| *seed);
        last.chain(0..self.within).find_map(|seed| {
            let words = self.seeds.seed(seed).judge(|| play(seed, Some(fault), &History::off())).err()?;
            Some(Found { fault, seed, words })
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SEEDS: Seeds = Seeds {
        variable: "SINEW_SIM_TEST_SEED",
        package: "any",
        target: "--lib",
        test: "it_is_replayed",
        count: 5,
    };

    #[derive(Clone, Copy, Debug, PartialEq, Eq)]
    enum Fault {
        Shown,
        Panics,
        Hidden,
    }

    fn hunt(faults: &[Fault]) -> Vec<Found<Fault>> {
        let hunt = Hunt { seeds: &SEEDS, faults, within: 9, found_last: &[(Fault::Shown, 8)] };
        hunt.run(|seed, fault, _| match fault {
            Some(Fault::Shown) if seed > 5 => Err("one too many".to_owned()),
            Some(Fault::Panics) => panic!("the core asserts"),
            _ => Ok(()),
        })
    }

    #[test]
    fn seed_that_found_a_fault_last_is_tried_first() {
        let found = hunt(&[Fault::Shown, Fault::Panics]);
        let of = |fault, seed, words: &str| Found { fault, seed, words: words.to_owned() };
        assert_eq!(found, [of(Fault::Shown, 8, "one too many"), of(Fault::Panics, 0, "the core asserts")]);
    }

    #[test]
    #[should_panic(expected = "not found in 9 seeds: [Hidden]")]
    fn fault_that_is_not_found_is_reported() {
        hunt(&[Fault::Hidden, Fault::Shown]);
    }

    #[test]
    #[should_panic(expected = "without Shown: also without\nseed 0; replay it: ")]
    fn seed_that_fails_without_the_fault_is_reported() {
        let hunt = Hunt { seeds: &SEEDS, faults: &[Fault::Shown], within: 9, found_last: &[] };
        hunt.run(|_, _, _| Err("also without".to_owned()));
    }
}
