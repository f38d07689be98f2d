//! Rejected unconfirmed messages: the report to their sender, and the trait that notifies a node of each rejection.
//!
//! A confirmed message has its [`Outcome`](crate::outcome::Outcome). An unconfirmed one has none. A node
//! counts its rejections, combines them, and reports them to the sender as [`Undelivered`]. This code runs
//! only when a message is rejected.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::{
    outcome::Rejection,
    tid::{AppAddress, Tid},
    time::Time,
    wire::{Class, Flags, Header, Kind, Payload},
};

/// Unconfirmed messages of one sender to one destination that were rejected for one reason, since the last report.
///
/// An application receives it as an event: `AppSpec::handles::<Undelivered>()` and
/// `Handler<Delivery<Undelivered>>`, in the node's process and in a process of its own. An endpoint takes it
/// with `take_undelivered`. The first rejection is reported at once, later ones together every 100 ms. If an
/// application does not handle it, its node logs a warning.
///
/// # Examples
///
/// ```
/// use sinew::prelude::*;
///
/// struct Hip { lost: u64 }
/// # impl Actor for Hip { type Context = AppContext<Self>; }
///
/// impl Handler<Delivery<Undelivered>> for Hip {
///     type Result = ();
///     fn handle(&mut self, report: Delivery<Undelivered>, _: &mut Self::Context) {
///         self.lost += report.count;
///         eprintln!("{}", *report);
///     }
/// }
///
/// let hip = AppSpec::new("hip", || Hip { lost: 0 }).handles::<Undelivered>();
/// ```
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Undelivered {
    /// The destination of the messages; [`Tid::NONE`]: several that are no longer distinguished. For an
    /// endpoint also its own TID: messages to it or to one of its groups, for which it had no room while it
    /// waited for a reply.
    pub destination: Tid,
    /// The name of the destination, if the node knows one.
    #[serde(default)]
    pub name: Option<String>,
    /// The type of the payload; `None`: several, or unknown.
    #[serde(default)]
    pub kind: Option<Kind>,
    /// The class of the first message; `None` if it is unknown.
    #[serde(default)]
    pub class: Option<Class>,
    /// The reason.
    pub why: Rejection,
    /// The number of messages since the last report. Never 0.
    pub count: u64,
    /// When the first of these was rejected, on this host's monotonic clock. For a rejection by another node:
    /// when its report arrived.
    pub since: Time,
    /// The lowest sequence number of these messages; `None` if it is unknown.
    #[serde(default)]
    pub first_sequence: Option<u64>,
    /// The highest sequence number of these messages; `None` if it is unknown.
    #[serde(default)]
    pub last_sequence: Option<u64>,
}

impl Payload for Undelivered {
    const NAME: &'static str = "sinew.undelivered";
    const CLASS: Class = Class::Control;
}

impl fmt::Display for Undelivered {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (messages, were) = if self.count == 1 { ("message", "was") } else { ("messages", "were") };
        write!(f, "{} {messages}", self.count)?;
        if let Some(kind) = self.kind {
            match kind.type_name() {
                Some(name) => write!(f, " of type {name}")?,
                None => write!(f, " of kind {kind}")?,
            }
        }
        match &self.name {
            Some(name) => write!(f, " to {name} ({})", self.destination)?,
            None if self.destination == Tid::NONE => write!(f, " to several destinations")?,
            None => write!(f, " to {}", self.destination)?,
        }
        write!(f, " {were} not delivered: {}", self.why)
    }
}

/// Records unconfirmed messages that were rejected after their send had returned. Must not block.
pub trait RefusalSink: Send + Sync + fmt::Debug {
    /// Records that `receiver` rejected `count` messages with this header.
    fn refused(&self, receiver: Tid, header: &Header, why: Rejection, count: u64);
}

/// Returns whether the rejection of a message with this header is reported to its sender.
///
/// These are not reported: confirmed messages and requests, which have an outcome; replies; frames and events
/// of layers; a rejection by the handler itself; an unhandled type of a broadcast, which is only for
/// applications that handle it.
#[must_use]
pub fn is_reported(header: &Header, why: Rejection) -> bool {
    let Header { flags, kind, source, destination, .. } = *header;
    let has_an_end_of_its_own = [Flags::CONFIRM, Flags::ASK, Flags::REPLY, Flags::OUTCOME];
    let is_broadcast = !destination.is_single() && !destination.app.is_group();
    !has_an_end_of_its_own.into_iter().any(|flag| flags.has(flag))
        && kind.is_user()
        && kind != Kind::PING
        && !source.app.is_layer()
        && source.app != AppAddress::NONE
        && why != Rejection::ByHandler
        && !(is_broadcast && why == Rejection::UnknownKind)
}

/// Returns whether the receiver's node records the rejection of a message with this header. It records each
/// reported one, and confirmed messages and requests of a type that the receiver does not handle or cannot
/// decode.
#[must_use]
pub fn is_noted(header: &Header, why: Rejection) -> bool {
    let Header { flags, .. } = *header;
    let is_of_type = matches!(why, Rejection::UnknownKind | Rejection::Malformed);
    let has_outcome = flags.has(Flags::CONFIRM) || flags.has(Flags::ASK);
    let mut unconfirmed = *header;
    if is_of_type && has_outcome && !flags.has(Flags::REPLY) && !flags.has(Flags::OUTCOME) {
        unconfirmed.flags = Flags::NONE;
    }
    is_reported(&unconfirmed, why)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tid::NodeAddress;

    fn header(flags: Flags, destination: Tid) -> Header {
        let source = Tid::new(NodeAddress::new(1), AppAddress::fixed(1).unwrap());
        let mut header = Header::new(Kind::named("demo.angle"), source, destination);
        header.flags = flags;
        header
    }

    #[test]
    fn rejections_without_an_own_outcome_are_reported() {
        let knee = Tid::new(NodeAddress::new(2), AppAddress::fixed(2).unwrap());
        assert!(is_reported(&header(Flags::NONE, knee), Rejection::UnknownKind));
        assert!(is_reported(&header(Flags::NONE, Tid::group("legs")), Rejection::UnknownKind));
        for flags in [Flags::CONFIRM, Flags::ASK, Flags::REPLY, Flags::OUTCOME] {
            assert!(!is_reported(&header(flags, knee), Rejection::UnknownKind), "{flags:?}");
        }
        assert!(!is_reported(&header(Flags::NONE, knee), Rejection::ByHandler));
    }

    #[test]
    fn unhandled_types_are_noted_of_confirmed_messages_too() {
        let knee = Tid::new(NodeAddress::new(2), AppAddress::fixed(2).unwrap());
        for flags in [Flags::NONE, Flags::CONFIRM, Flags::ASK, Flags::CONFIRM.with(Flags::ASK)] {
            assert!(is_noted(&header(flags, knee), Rejection::UnknownKind), "{flags:?}");
        }
        assert!(!is_noted(&header(Flags::CONFIRM, knee), Rejection::QueueFull));
        assert!(!is_noted(&header(Flags::OUTCOME, knee), Rejection::UnknownKind));
        assert!(!is_noted(&header(Flags::REPLY, knee), Rejection::UnknownKind));
    }

    #[test]
    fn unhandled_broadcast_is_no_fault() {
        let all = Tid::new(NodeAddress::ALL, AppAddress::ALL);
        assert!(!is_reported(&header(Flags::NONE, all), Rejection::UnknownKind));
        assert!(is_reported(&header(Flags::NONE, all), Rejection::Malformed));
    }
}
