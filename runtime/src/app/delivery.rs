//! A message as its handler sees it.

use std::{ops::Deref, time::Duration};

use bytes::Bytes;

use crate::{
    sender::ReplyTo,
    tid::Tid,
    time::Time,
    wire::{Flags, Header, Kind},
};

/// A payload with where it came from and how old it is.
#[derive(Clone, Debug)]
pub struct Delivery<P> {
    /// What was sent.
    pub payload: P,
    /// Who sent it; the sender's node answers for it.
    pub source: Tid,
    /// Whom it was sent to: this application, a group, or everybody.
    pub destination: Tid,
    /// The source's n-th message.
    pub sequence: u64,
    /// When it was sent, in this host's clock; [`Time::ZERO`] where that is not known ([`age_error`](Self::age_error)).
    pub sent: Time,
    /// Time from sending to handling, as wrong as [`age_error`](Self::age_error) says. Where it is not known it is 584 years, so that no limit
    /// takes what may be old for fresh.
    pub age: Duration,
    /// Type of the payload.
    pub kind: Kind,
    age_error: Option<Duration>,
    reply_to: Option<ReplyTo>,
}

impl<P> Delivery<P> {
    pub(crate) fn new(payload: P, header: &Header, now: Time) -> Self {
        let Header { source, correlation, sent, .. } = *header;
        let reply_to = ReplyTo { source, correlation, sent, until: header.expiry() };
        Self {
            payload,
            source: header.source,
            destination: header.destination,
            sequence: header.sequence,
            sent: header.known_sent(),
            age: header.known_age(now),
            kind: header.kind,
            age_error: header.sent_error(),
            reply_to: header.flags.has(Flags::ASK).then_some(reply_to),
        }
    }

    /// The error of `age`, and of `sent`, at most: zero for what was sent on this host; `None` where the age is not known, because the clock
    /// of the sender's host was not measured yet, or not for so long that it may be wrong by more than 32 s.
    ///
    /// It holds as long as the hosts' clocks drift apart as clocks do (`docs/protocol/ndl.md`, NDL-6.1).
    #[must_use]
    pub const fn age_error(&self) -> Option<Duration> {
        self.age_error
    }

    /// The greatest age that it can have had: `age` and its error; [`Duration::MAX`] where it is not known. For whoever uses only what is young.
    #[must_use]
    pub fn age_at_most(&self) -> Duration {
        self.age_error.map_or(Duration::MAX, |error| self.age.saturating_add(error))
    }

    /// Where the sender waits for a reply; `None` if it does not.
    #[must_use]
    pub const fn reply_to(&self) -> Option<ReplyTo> {
        self.reply_to
    }
}

impl<P> Deref for Delivery<P> {
    type Target = P;

    fn deref(&self) -> &P {
        &self.payload
    }
}

impl<P: 'static> actix::Message for Delivery<P> {
    type Result = ();
}

/// The bytes of a payload as they came, without a copy.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Raw(pub Bytes);

impl Deref for Raw {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        &self.0
    }
}
