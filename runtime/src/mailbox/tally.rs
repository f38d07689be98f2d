//! What became of the messages of one class: counters that obey a conservation law.

use crate::outcome::Outcome;

/// What became of the messages of one class: `taken = delivered + superseded + rejected + expired + failed + waiting`,
/// `waiting` being those in the queue and the one in hand.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Tally {
    /// Accepted by the mailbox.
    pub taken: u64,
    /// Not accepted: the queue was full, the application had ended, or it was away and keeps nothing.
    pub refused: u64,
    /// Handled.
    pub delivered: u64,
    /// Replaced by a newer value.
    pub superseded: u64,
    /// Taken, then refused by the application.
    pub rejected: u64,
    /// Too old when their turn came, or requests whose asker waited no more.
    pub expired: u64,
    /// In the hand of an actor that panicked or ended.
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

    /// Messages whose fate is still open, by the conservation law.
    #[must_use]
    pub const fn open(&self) -> u64 {
        self.taken - self.delivered - self.superseded - self.rejected - self.expired - self.failed
    }
}
