//! Replies to requests, and whether their senders still wait for them.

use super::{SendError, Sender};
use crate::{
    tid::Tid,
    time::Time,
    wire::{Class, Flags, Header, Message, Payload},
};

/// The destination of a reply, made from the request that it answers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ReplyTo {
    pub(crate) source: Tid,
    pub(crate) correlation: u64,
    pub(crate) sent: Time,
    pub(crate) until: Time,
}

impl ReplyTo {
    /// Returns the destination of the reply to the request of this header.
    pub(crate) fn of(header: &Header) -> Self {
        let Header { source, correlation, sent, .. } = *header;
        Self { source, correlation, sent, until: header.expiry() }
    }

    /// Returns when the sender of the request stops waiting, in this host's clock; [`Time::MAX`] if it never stops.
    #[must_use]
    pub const fn deadline(&self) -> Time {
        self.until
    }
}

impl Sender {
    /// Returns whether the sender of the request still waits for the reply, as far as this node knows: the
    /// deadline is in the future, and the request was not cancelled. A handler that works for long or replies
    /// later can stop unneeded work.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{app::Delivery, message::Sender};
    ///
    /// # struct Plan;
    /// fn is_to_go_on(sender: &Sender, request: &Delivery<Plan>) -> bool {
    ///     request.reply_to().is_some_and(|reply_to| sender.is_wanted(&reply_to))
    /// }
    /// ```
    #[must_use]
    pub fn is_wanted(&self, request: &ReplyTo) -> bool {
        let ReplyTo { source, correlation, sent, until } = *request;
        self.now() <= until && !self.shared.pending.is_cancelled(source, correlation, sent)
    }

    /// Number of replies to requests of this application that arrived too late and were dropped.
    #[must_use]
    pub fn late_replies(&self) -> u64 {
        self.shared.pending.late_replies()
    }

    /// Replies to a request.
    ///
    /// # Errors
    /// The reply was not accepted, or the message did not request one.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{app::Delivery, message::Sender, payload};
    ///
    /// payload!("demo.plan" => struct Plan;);
    /// payload!("demo.planned" => struct Planned { steps: u32 });
    ///
    /// /// Replies from a thread that has the time to plan.
    /// fn plan(sender: Sender, request: Delivery<Plan>) {
    ///     let Some(reply_to) = request.reply_to() else { return };
    ///     std::thread::spawn(move || sender.reply(reply_to, &Planned { steps: 12 }));
    /// }
    /// ```
    pub fn reply<R: Payload>(&self, to: ReplyTo, value: &R) -> Result<(), SendError> {
        let mut message = Message::typed(self.shared.tid, to.source, value);
        message.header.class = Class::Control;
        message.header.flags = Flags::REPLY;
        message.header.correlation = to.correlation;
        self.dispatch(message).map(drop)
    }
}
