//! The counters of every message that an outlet has accepted, and the audit's account of them.

use super::OutletCounts;

/// The counters of an outlet.
#[derive(Default)]
pub(super) struct Counters {
    pub(super) counts: OutletCounts,
    /// Messages that were not returned to the sender.
    taken: u64,
    /// Frames of the layers, and outcomes, among `taken`.
    own: u64,
    /// Messages that have a number of the session.
    pub(super) numbered: u64,
    /// Numbered messages that expired and were replaced by a void.
    void_expired: u64,
    /// Numbered messages that a newer value superseded; a void replaces them.
    void_superseded: u64,
    /// Numbered messages of unknown arrival.
    unknown: u64,
}

/// Where all messages are that an outlet has accepted, at one moment.
///
/// `taken = arrived + superseded + expired + lost + unknown + waiting + unacknowledged`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct OutletAccount {
    /// Accepted messages.
    pub taken: u64,
    /// Frames of the layers, and outcomes, among `taken`.
    pub own: u64,
    /// Messages returned to their senders. Not part of `taken`.
    pub refused: u64,
    /// Messages acknowledged by the peer; without a session, messages written up to their last byte.
    pub arrived: u64,
    /// Messages for which a newer value was submitted.
    pub superseded: u64,
    /// Messages older than their time to live.
    pub expired: u64,
    /// Messages that were not started when the outlet was closed.
    pub lost: u64,
    /// Messages that were started but not acknowledged when the session ended.
    pub unknown: u64,
    /// Messages not started yet; without a session, messages not written up to their last byte.
    pub waiting: u64,
    /// Messages started and not acknowledged. 0 without a session.
    pub unacknowledged: u64,
}

impl Counters {
    /// Counts an accepted message. `is_own`: it is a frame of the layers or an outcome.
    #[inline]
    pub(super) fn accept(&mut self, is_own: bool) {
        self.taken += 1;
        self.own += u64::from(is_own);
    }

    /// Counts `count` and one frames of the layers as one from now on.
    pub(super) const fn combine(&mut self, count: u64) {
        self.taken -= count;
        self.own -= count;
    }

    /// Counts a frame of the layers as two from now on.
    pub(super) const fn split(&mut self) {
        self.taken += 1;
        self.own += 1;
    }

    /// Counts numbered messages that are lost, and that may have arrived.
    pub(super) const fn lose_numbered(&mut self, count: u64) {
        self.counts.lost += count;
        self.unknown += count;
    }

    /// Counts a numbered message that a void replaces.
    pub(super) fn void(&mut self, has_expired: bool) {
        let count = if has_expired { &mut self.void_expired } else { &mut self.void_superseded };
        *count += 1;
    }

    /// Returns where all messages are. `unacknowledged` is `None` without a session.
    pub(super) const fn account(&self, waiting: u64, unacknowledged: Option<u64>) -> OutletAccount {
        let Self { counts, void_expired, void_superseded, unknown, .. } = *self;
        let arrived = match unacknowledged {
            Some(unacknowledged) => {
                self.numbered.saturating_sub(void_expired + void_superseded + unknown + unacknowledged)
            }
            None => counts.sent,
        };
        OutletAccount {
            taken: self.taken,
            own: self.own,
            refused: counts.refused,
            arrived,
            superseded: counts.superseded + void_superseded,
            expired: counts.expired + void_expired,
            lost: counts.lost - unknown,
            unknown,
            waiting,
            unacknowledged: match unacknowledged {
                Some(unacknowledged) => unacknowledged,
                None => 0,
            },
        }
    }
}
