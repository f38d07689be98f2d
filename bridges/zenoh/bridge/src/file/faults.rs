//! The faults of a file, which are reported together.

use std::fmt;

/// Maximum number of reported faults.
const FAULTS_MAX: usize = 64;

/// The faults found so far.
#[derive(Debug, Default)]
pub(super) struct Faults(Vec<String>);

impl Faults {
    /// Adds a fault at this key.
    pub(super) fn add(&mut self, place: &str, why: fmt::Arguments<'_>) {
        if self.0.len() < FAULTS_MAX {
            self.0.push(format!("{place}: {why}"));
        }
    }

    /// Adds a fault at this key, unless it is good.
    pub(super) fn check(&mut self, is_good: bool, place: &str, why: &str) {
        if !is_good {
            self.add(place, format_args!("{why}"));
        }
    }

    /// Returns all faults, if there are any.
    pub(super) fn end(self) -> Result<(), Vec<String>> {
        if self.0.is_empty() { Ok(()) } else { Err(self.0) }
    }
}
