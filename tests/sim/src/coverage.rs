//! Counts of situations.

use std::collections::BTreeMap;

/// Counts of situations, so that a simulation in which little happens is noticed.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Coverage(BTreeMap<&'static str, u64>);

impl Coverage {
    /// Counts a situation.
    pub fn count(&mut self, situation: &'static str) {
        self.add(situation, 1);
    }

    /// Counts a situation several times.
    pub fn add(&mut self, situation: &'static str, times: u64) {
        *self.0.entry(situation).or_default() += times;
    }

    /// Adds all counts of another run.
    pub fn merge(&mut self, other: &Self) {
        other.0.iter().for_each(|(situation, times)| self.add(situation, *times));
    }

    /// Returns the count of a situation.
    #[must_use]
    pub fn of(&self, situation: &str) -> u64 {
        self.0.get(situation).copied().unwrap_or_default()
    }

    /// Requires that each of these situations was counted at least `times` times.
    ///
    /// # Panics
    /// If one was not.
    pub fn require(&self, situations: &[&str], times: u64) {
        let rare: Vec<_> = situations.iter().filter(|situation| self.of(situation) < times).collect();
        assert!(rare.is_empty(), "hardly tried: {rare:?} of {:?}", self.0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    #[should_panic(expected = "hardly tried: [\"cuts\"] of {\"cuts\": 1, \"starts\": 2}")]
    fn rare_situation_is_noticed() {
        let (mut coverage, mut other) = (Coverage::default(), Coverage::default());
        coverage.count("starts");
        other.count("cuts");
        other.count("starts");
        coverage.merge(&other);
        coverage.require(&["starts", "cuts"], 2);
    }
}
