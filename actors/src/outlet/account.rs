//! Where every message is that an outlet has taken: for an audit. And whether the peer takes what is for it.

use sinew_runtime::wire::{Flags, Header, Kind};

use super::{
    Account, Socket,
    half::{Half, Link},
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

/// How far the peer has come with what it was sent, at one moment. A part of this the peer writes itself, and may write what it likes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Taking {
    /// Another one whenever the peer has taken something; nothing else is to be read from it.
    pub(crate) mark: (u64, u64),
    /// Whether a message of an application waits that the peer only has to take; where nobody can say what it has taken, one for which its
    /// socket has no room.
    pub(crate) leaves_some: bool,
}

/// What a receiver of protected messages says to their sender (`sinew_runtime::protection`).
const ECHO: Kind = Kind::named("sinew.echo");

/// Whether this is an application's message for the program at the other end. Who only sends need not read what is not: frames and events of
/// the layers, outcomes, what a `NodeApi` answers or keeps by itself, and replies, which may come when nobody waits for them any more.
pub(super) fn is_for_the_program(header: &Header) -> bool {
    let is_kept = [Kind::PING, ECHO].contains(&header.kind) || header.flags.has(Flags::REPLY);
    header.kind.is_user() && !is_kept && !header.source.app.is_layer()
}

impl<S: Socket> Half<S> {
    /// `None` without a connection. Reads only what is counted anyway.
    pub(super) fn taking(&mut self) -> Option<Taking> {
        let Link::Up(socket) = &mut self.link else { return None };
        let Account { written, taken } = socket.account();
        let is_known = taken <= written;
        // While it has taken all that it was given, what waits here is not its fault.
        let leaves_some =
            is_known && taken < self.due || taken != written && self.holds_any_for_the_program();
        let begun = self.partial.as_ref().map_or(0, |partial| partial.written as u64);
        let mark = if is_known { (taken, 0) } else { (self.counts.sent, begun) };
        Some(Taking { mark, leaves_some })
    }

    /// Whether an application's message waits here, or has been begun.
    fn holds_any_for_the_program(&self) -> bool {
        let begun = self.partial.as_ref().filter(|partial| partial.sort != Sort::Frill);
        let first = begun.map(|partial| &partial.message).into_iter().chain(&self.interrupted);
        first.chain(self.queue.iter()).any(|message| is_for_the_program(&message.header))
    }

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
