//! The results of the messages of one class: counters that obey a conservation law.

use crate::outcome::Outcome;

/// The results of the messages of one class:
/// `taken = delivered + superseded + rejected + expired + failed + waiting`.
/// `waiting` includes the queued messages and the one that is being handled.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Tally {
    /// Accepted by the mailbox.
    pub taken: u64,
    /// Not accepted: the queue was full, the application had ended, or it was down and its policy keeps nothing.
    pub refused: u64,
    /// Handled.
    pub delivered: u64,
    /// Replaced by a newer value.
    pub superseded: u64,
    /// Accepted, then rejected by the application.
    pub rejected: u64,
    /// Too old at their turn, or requests that were cancelled.
    pub expired: u64,
    /// In handling by an actor that panicked or ended.
    pub failed: u64,
}

impl Tally {
    pub(super) fn count(&mut self, outcome: Outcome) {
        match outcome {
            Outcome::Delivered => self.delivered += 1,
            Outcome::Rejected(_) => self.rejected += 1,
            Outcome::Expired => self.expired += 1,
            Outcome::Failed | Outcome::PeerLost | Outcome::Unknown => self.failed += 1,
        }
    }

    /// Returns the number of messages without a result, by the conservation law.
    #[must_use]
    pub const fn open(&self) -> u64 {
        self.taken - self.delivered - self.superseded - self.rejected - self.expired - self.failed
    }
}
