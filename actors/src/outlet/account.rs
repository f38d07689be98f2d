//! Where every message is that an outlet has taken: for an audit.

use super::{
    Socket,
    half::Half,
    partial::{Partial, Sort},
};
use crate::session::Sent;

/// What an audit needs and [`OutletCounts`](super::OutletCounts) does not say.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Tally {
    /// Messages that were not handed back.
    pub(super) taken: u64,
    /// Of these, frames of the layers and outcomes.
    pub(super) own: u64,
    /// Messages that have a number of the session.
    pub(super) numbered: u64,
    /// Of these, those that a void stands for: they had expired.
    pub(super) void_expired: u64,
    /// A newer value was behind them.
    pub(super) void_superseded: u64,
    /// Nobody can say whether they arrived.
    pub(super) unknown: u64,
}

/// What became of all that an outlet has taken, at one moment.
///
/// `taken = arrived + superseded + expired + lost + unknown + waiting + unacknowledged`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct OutletAccount {
    pub(crate) taken: u64,
    /// Of these, frames of the layers and outcomes.
    pub(crate) own: u64,
    /// Handed back to their senders. Not in `taken`.
    pub(crate) refused: u64,
    /// Acknowledged by the peer; without a session, written to their last byte.
    pub(crate) arrived: u64,
    pub(crate) superseded: u64,
    pub(crate) expired: u64,
    /// Not begun when the outlet was closed.
    pub(crate) lost: u64,
    /// Begun, and the session was over before the peer acknowledged them.
    pub(crate) unknown: u64,
    /// Not begun yet; without a session, not written to their last byte.
    pub(crate) waiting: u64,
    /// Begun, and not acknowledged. 0 without a session.
    pub(crate) unacknowledged: u64,
}

impl<S: Socket> Half<S> {
    pub(super) fn account(&self) -> (OutletAccount, Option<Sent>) {
        let (counts, tally) = (self.counts, self.tally);
        let begun = self.partial.as_ref().is_some_and(is_a_message) && self.session.is_none();
        let waiting = self.waits_for_its_number() + usize::from(begun);
        let (unacknowledged, sent) = self.kept();
        let ended = tally.void_expired + tally.void_superseded + tally.unknown + unacknowledged;
        let arrived = if self.session.is_some() { tally.numbered.saturating_sub(ended) } else { counts.sent };
        let account = OutletAccount {
            taken: tally.taken,
            own: tally.own,
            refused: counts.refused,
            arrived,
            superseded: counts.superseded + tally.void_superseded,
            expired: counts.expired + tally.void_expired,
            lost: counts.lost - tally.unknown,
            unknown: tally.unknown,
            waiting: waiting as u64,
            unacknowledged,
        };
        (account, sent)
    }
}

fn is_a_message(partial: &Partial) -> bool {
    partial.sort == Sort::Message
}
