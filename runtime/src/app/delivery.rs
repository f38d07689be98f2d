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
    /// When it was sent, in this host's clock.
    pub sent: Time,
    /// Time from sending to handling.
    pub age: Duration,
    /// Type of the payload.
    pub kind: Kind,
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
            sent: header.sent,
            age: now.since(header.sent),
            kind: header.kind,
            reply_to: header.flags.has(Flags::ASK).then_some(reply_to),
        }
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
