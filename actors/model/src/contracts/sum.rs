//! The worst time of a contract, as the sum of its parts.

use std::{fmt, time::Duration};

/// A part of a worst time.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Part {
    /// Its name: a setting, and the type or the application that has it.
    pub(super) name: String,
    pub(super) time: Duration,
    /// How it gets shorter.
    pub(super) remedy: String,
}

/// The worst time from the begin of a condition until the application is in its state.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Sum {
    pub(super) parts: Vec<Part>,
    /// The time that has passed when the condition begins: a command is late only then. At most the parts beside the
    /// slack.
    pub(super) passed: Duration,
}

impl Sum {
    pub(super) fn total(&self) -> Duration {
        let sum = self.parts.iter().fold(Duration::ZERO, |sum, part| sum.saturating_add(part.time));
        sum.saturating_sub(self.passed)
    }

    /// Adds the parts of a sum that begins when this one ends.
    pub(super) fn and_then(mut self, mut next: Self) -> Self {
        self.parts.append(&mut next.parts);
        self.passed = self.passed.saturating_add(next.passed);
        self
    }

    /// Returns why this is more than `within`, with the settings to change.
    pub(super) fn excess(&self, within: Duration) -> String {
        let longest = self.parts.iter().max_by_key(|part| part.time);
        let remedy = longest.map_or_else(String::new, |part| format!(", or {} ({})", part.remedy, part.name));
        format!("{self}, more than {}: allow {}{remedy}", millis(within), millis(self.total()))
    }
}

impl fmt::Display for Sum {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (at, part) in self.parts.iter().enumerate() {
            let sign = if at == 0 { "" } else { " + " };
            write!(f, "{sign}{} {}", millis(part.time), part.name)?;
        }
        if !self.passed.is_zero() {
            write!(f, " - {} until it is late", millis(self.passed))?;
        }
        write!(f, " = {}", millis(self.total()))
    }
}

/// Returns a time in milliseconds, rounded up to a tenth.
pub(super) fn millis(time: Duration) -> String {
    let tenths = time.as_micros().div_ceil(100);
    format!("{}.{} ms", tenths / 10, tenths % 10)
}
