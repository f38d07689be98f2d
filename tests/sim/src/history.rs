//! The events of a run.

use std::{cell::RefCell, collections::VecDeque, fmt, rc::Rc};

use sinew_runtime::time::Time;

/// Lines kept for a failure. The last ones explain it best.
const LINES_MAX: usize = 400;

/// The events of a run, in words. Copies share their lines.
///
/// It is off in ordinary runs: then no words are made. [`Seeds::run`](crate::Seeds::run) repeats a failed
/// seed with the history on. A replayed seed prints each line at once.
#[derive(Clone, Debug, Default)]
pub struct History {
    lines: Option<Rc<RefCell<VecDeque<String>>>>,
    is_printed: bool,
}

impl History {
    /// Creates a history that ignores all notes.
    #[must_use]
    pub fn off() -> Self {
        Self::default()
    }

    /// Creates a history that keeps the last 400 notes.
    #[must_use]
    pub fn kept() -> Self {
        Self { lines: Some(Rc::default()), is_printed: false }
    }

    /// Creates a history that prints each note on standard output, too.
    #[must_use]
    pub fn printed() -> Self {
        Self { is_printed: true, ..Self::kept() }
    }

    /// Adds a note, if the history is on.
    pub fn note(&self, at: Time, words: impl FnOnce() -> String) {
        let Some(lines) = &self.lines else { return };
        let line = format!("{:>12.3} ms  {}", at.as_nanos() as f64 / 1e6, words());
        if self.is_printed {
            println!("{line}");
        }
        let mut lines = lines.borrow_mut();
        if lines.len() == LINES_MAX {
            lines.pop_front();
        }
        lines.push_back(line);
    }
}

/// Writes the kept notes, one a line. Printed notes are not repeated.
impl fmt::Display for History {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Some(lines) = self.lines.as_ref().filter(|_| !self.is_printed) else { return Ok(()) };
        lines.borrow().iter().try_for_each(|line| writeln!(formatter, "{line}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn history_keeps_the_last_notes_only() {
        let history = History::kept();
        let copy = history.clone();
        (0..LINES_MAX + 5)
            .for_each(|number| copy.note(Time::from_nanos(1_500_000), || format!("note {number}.")));
        let words = history.to_string();
        assert!(words.starts_with("       1.500 ms  note 5.\n"), "{words}");
        assert_eq!(words.lines().count(), LINES_MAX);
        History::off().note(Time::ZERO, || unreachable!("no words are made"));
    }
}
