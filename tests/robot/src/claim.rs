//! The claims of a step: the expectation on each class of machine, and the observation.
//!
//! Class A: real-time kernel, isolated core. Class B: plain Linux, idle. Class C: any machine, also a shared
//! one.

use std::fmt::{self, Write};

use serde::Serialize;

use crate::step::Step;

/// Relative tolerance of a limit: for differences of floating-point numbers only.
const ROUNDING: f64 = 1e-9;
/// No limit: the value is only reported.
pub(crate) const REPORTED: f64 = f64::INFINITY;

/// One claim, and whether it held.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct Claim {
    /// The step; `null`: the contrast between a device with and one without a watchdog.
    pub(crate) step: Option<Step>,
    /// One of several injections of the step, for example `phase 0.62`; empty if there is one.
    pub(crate) at: String,
    /// The text of the claim, with its unit.
    pub(crate) name: String,
    /// The expectation.
    pub(crate) expected: Expected,
    /// The observation; `null` if it never happened.
    pub(crate) seen: Option<f64>,
    /// Whether it held; for a time: in class C.
    pub(crate) held: bool,
}

/// The expectation for a figure.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Expected {
    /// A time or a distance: at most this much, by class of machine.
    Timing {
        /// Real-time kernel, isolated core.
        a: f64,
        /// Plain Linux, idle.
        b: f64,
        /// Any machine; infinite (`null` in JSON) if the value is only reported there.
        c: f64,
    },
    /// On every machine: at most this much.
    AtMost(f64),
    /// On every machine: at least this much.
    AtLeast(f64),
    /// On every machine: exactly this.
    Exactly(f64),
    /// Only reported, without an expectation.
    Told,
}

impl Expected {
    /// Whether it has to hold on every machine.
    #[must_use]
    pub(crate) const fn is_functional(self) -> bool {
        match self {
            Self::Timing { .. } | Self::Told => false,
            Self::AtMost(_) | Self::AtLeast(_) | Self::Exactly(_) => true,
        }
    }

    fn holds(self, seen: Option<f64>) -> bool {
        match (self, seen) {
            (Self::Told, _) => true,
            (Self::Timing { c: limit, .. } | Self::AtMost(limit), Some(seen)) => within(seen, limit),
            (Self::AtLeast(limit), Some(seen)) => seen >= limit,
            (Self::Exactly(value), Some(seen)) => seen == value,
            (Self::Timing { .. } | Self::AtMost(_) | Self::AtLeast(_) | Self::Exactly(_), None) => false,
        }
    }

    /// The classes of machine for which the observation is good enough.
    fn classes(self, seen: Option<f64>) -> &'static str {
        let Some(seen) = seen else { return if self == Self::Told { "" } else { "NO" } };
        match self {
            Self::Told => "",
            Self::Timing { a, .. } if within(seen, a) => "A B C",
            Self::Timing { b, .. } if within(seen, b) => "- B C",
            Self::Timing { c, .. } if within(seen, c) => "- - C",
            Self::AtMost(_) | Self::AtLeast(_) | Self::Exactly(_) if self.holds(Some(seen)) => "yes",
            Self::Timing { .. } | Self::AtMost(_) | Self::AtLeast(_) | Self::Exactly(_) => "NO",
        }
    }

    fn words(self) -> String {
        match self {
            Self::Timing { a, b, c: REPORTED } => format!("{a} / {b} / report"),
            Self::Timing { a, b, c } => format!("{a} / {b} / {c}"),
            Self::AtMost(limit) => format!("<= {limit}"),
            Self::AtLeast(limit) => format!(">= {limit}"),
            Self::Exactly(value) => format!("{value}"),
            Self::Told => String::new(),
        }
    }
}

fn within(seen: f64, limit: f64) -> bool {
    seen <= limit * (1.0 + ROUNDING)
}

/// Collects the claims of one injection.
#[derive(Debug)]
pub(crate) struct Claims<'a> {
    step: Option<Step>,
    at: &'a str,
    out: &'a mut Vec<Claim>,
}

impl<'a> Claims<'a> {
    pub(crate) const fn new(step: Step, at: &'a str, out: &'a mut Vec<Claim>) -> Self {
        Self { step: Some(step), at, out }
    }

    /// Creates the claims of the contrast.
    pub(crate) const fn contrast(out: &'a mut Vec<Claim>) -> Self {
        Self { step: None, at: "", out }
    }

    /// Adds a deviation of the contrast: in virtual time it is the same on every machine, in real time it is
    /// not.
    pub(crate) fn add_deviation(&mut self, name: &str, expected: Expected, is_real_time: bool, seen: f64) {
        let expected = match expected {
            Expected::AtMost(limit) if is_real_time => Expected::Timing { a: limit, b: limit, c: limit },
            Expected::AtMost(_)
            | Expected::AtLeast(_)
            | Expected::Exactly(_)
            | Expected::Timing { .. }
            | Expected::Told => expected,
        };
        self.add(name, expected, Some(seen));
    }

    /// Adds a time or a distance that depends on the machine.
    pub(crate) fn timing(&mut self, name: &str, [a, b, c]: [f64; 3], seen: Option<f64>) {
        self.add(name, Expected::Timing { a, b, c }, seen);
    }

    pub(crate) fn at_most(&mut self, name: &str, limit: f64, seen: impl Into<Option<f64>>) {
        self.add(name, Expected::AtMost(limit), seen.into());
    }

    pub(crate) fn at_least(&mut self, name: &str, limit: f64, seen: impl Into<Option<f64>>) {
        self.add(name, Expected::AtLeast(limit), seen.into());
    }

    /// Adds a count with this required value.
    pub(crate) fn exactly(&mut self, name: &str, value: usize, seen: usize) {
        self.add(name, Expected::Exactly(value as f64), Some(seen as f64));
    }

    /// Adds a condition that has to be true: 1.
    pub(crate) fn is_so(&mut self, name: &str, seen: bool) {
        self.exactly(name, 1, usize::from(seen));
    }

    pub(crate) fn info(&mut self, name: &str, seen: Option<f64>) {
        self.add(name, Expected::Told, seen);
    }

    fn add(&mut self, name: &str, expected: Expected, seen: Option<f64>) {
        // NaN or infinity is no evidence, and JSON cannot express it.
        let seen = seen.filter(|seen| seen.is_finite());
        let held = expected.holds(seen);
        let (step, at, name) = (self.step, self.at.to_owned(), name.to_owned());
        self.out.push(Claim { step, at, name, expected, seen, held });
    }
}

/// One line for readers of the end of a report.
impl fmt::Display for Claim {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.step {
            Some(step) => write!(f, "step {step}")?,
            None => write!(f, "contrast")?,
        }
        let comma = if self.at.is_empty() { "" } else { ", " };
        let kind = if self.expected.is_functional() { "function" } else { "time" };
        let seen = self.seen.map_or_else(|| "never".to_owned(), number);
        let expected = self.expected.words();
        write!(f, "{comma}{}: {}: expected {expected}, seen {seen} ({kind})", self.at, self.name)
    }
}

/// The claims as a table, with lines of at most 100 characters.
#[must_use]
pub(crate) fn table(claims: &[Claim]) -> String {
    let mut text = String::new();
    // Writing to a String cannot fail.
    let _ = write_table(&mut text, claims);
    text
}

fn write_table(out: &mut String, claims: &[Claim]) -> fmt::Result {
    writeln!(out, "{:-<100}", "")?;
    writeln!(out, "{:60} {:>17} {:>10}  holds", "step and claim", "expected A/B/C", "seen")?;
    let mut written = None;
    for claim in claims {
        let heading = (claim.step, claim.at.as_str());
        if written != Some(heading) {
            written = Some(heading);
            let at = if claim.at.is_empty() { String::new() } else { format!(", {}", claim.at) };
            match claim.step {
                Some(step) => writeln!(out, "{step:>2}  {}{at}", step.words())?,
                None => writeln!(out, " -  contrast: the ankle's drive falls silent at push-off for 400 ms")?,
            }
        }
        let seen = claim.seen.map_or_else(|| "never".to_owned(), number);
        let (expected, classes) = (claim.expected.words(), claim.expected.classes(claim.seen));
        writeln!(out, "    {:56} {expected:>17} {seen:>10}  {classes}", claim.name)?;
    }
    writeln!(out, "{:-<100}", "")
}

fn number(seen: f64) -> String {
    if seen.fract() == 0.0 { format!("{seen:.0}") } else { format!("{seen:.2}") }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LIMITS: Expected = Expected::Timing { a: 10.0, b: 20.0, c: 100.0 };

    #[test]
    fn time_lists_the_classes_it_satisfies() {
        let classes = [9.0, 20.0, 99.0, 101.0].map(|seen| LIMITS.classes(Some(seen)));
        assert_eq!(classes, ["A B C", "- B C", "- - C", "NO"]);
        assert!(LIMITS.holds(Some(100.0)) && !LIMITS.holds(Some(100.1)));
    }

    #[test]
    fn missing_observation_satisfies_no_class() {
        for expected in [LIMITS, Expected::AtMost(1.0), Expected::AtLeast(0.0), Expected::Exactly(0.0)] {
            assert!(!expected.holds(None));
            assert_eq!(expected.classes(None), "NO");
        }
    }

    #[test]
    fn one_line_claim_has_its_place_and_kind() {
        let mut out = Vec::new();
        let mut claims = Claims::new(Step::KillDrive, "phase 0.62", &mut out);
        claims.exactly("drives started anew", 1, 2);
        claims.timing("output after, ms", [1.0, 2.0, 3.0], None);
        let lines = out.iter().map(ToString::to_string).collect::<Vec<_>>();
        assert_eq!(lines[0], "step 4, phase 0.62: drives started anew: expected 1, seen 2 (function)");
        assert_eq!(lines[1], "step 4, phase 0.62: output after, ms: expected 1 / 2 / 3, seen never (time)");
    }

    #[test]
    fn non_finite_number_is_no_evidence() {
        let mut out = Vec::new();
        Claims::new(Step::KillDrive, "", &mut out).at_most("torque, Nm", 45.0, f64::NAN);
        assert!(!out[0].held && out[0].seen.is_none());
        assert!(table(&out).contains("never"));
    }
}
