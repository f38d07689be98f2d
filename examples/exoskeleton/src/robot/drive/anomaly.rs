//! Detects manipulation of central's commands, from the counts of their guard.

use sinew::protection::Tally;

/// Good commands after which a wrong one is forgotten: the length of the guard's own memory.
const GOOD_STRETCH: u64 = 64;

/// Commands that were damaged, not from central, repeated or out of order since the last good stretch,
/// regardless of the reason of a shut guard. No network does that to messages that Sinew carries; lateness
/// and loss do not count here. They are forgotten through an open guard only: silence while it is shut does
/// not restore trust.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Anomaly {
    /// Number of wrong commands that are known.
    wrong: u64,
    /// Good commands counted when the last of them arrived; `None` when they are forgotten.
    good: Option<u64>,
}

impl Anomaly {
    /// Updates from the guard's counts.
    pub(super) fn note(&mut self, tally: &Tally, is_open: bool) {
        let wrong = tally.corrupt + tally.repeated + tally.backwards;
        if wrong > self.wrong {
            (self.wrong, self.good) = (wrong, Some(tally.good));
        } else if is_open && self.good.is_some_and(|good| tally.good - good >= GOOD_STRETCH) {
            self.good = None;
        }
    }

    /// Forgets them: a process that knew of them has opened the guard again.
    pub(super) const fn forget(&mut self) {
        self.good = None;
    }

    /// Whether there are any.
    pub(super) const fn is_there(&self) -> bool {
        self.good.is_some()
    }
}

#[cfg(test)]
#[path = "../../../tests/unit/anomaly.rs"]
mod tests;
