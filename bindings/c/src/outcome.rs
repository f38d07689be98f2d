//! Outcomes as numbers, and the texts for statuses and outcomes.

use std::ffi::{CStr, c_char};

use sinew_runtime::outcome::Rejection;

use crate::status::{Status, last_sentence};

/// The outcome of a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(i32)]
#[allow(clippy::enum_variant_names, reason = "these are the names in C, which has no other name spaces")]
pub enum Outcome {
    /// The destination has handled it.
    SinewDelivered = 0,
    /// Its time ran out before it was handled.
    SinewExpired = 1,
    /// The destination failed, or ended before it settled the message.
    SinewFailed = 2,
    /// The connection to its node was lost before it was sent: it was not handled.
    SinewPeerLost = 3,
    /// Not known.
    SinewUnknown = 4,
    /// Not handled: no application has this TID.
    SinewRejectedNoSuchApplication = 16,
    /// Not handled: the node is not known or not connected.
    SinewRejectedNoSuchNode = 17,
    /// Not handled: the destination does not handle this kind.
    SinewRejectedUnknownKind = 18,
    /// Not handled: the payload is not a value of its kind.
    SinewRejectedMalformed = 19,
    /// Not handled: a queue was full.
    SinewRejectedQueueFull = 20,
    /// Not handled: too long.
    SinewRejectedTooLong = 21,
    /// Not handled: the application has ended.
    SinewRejectedClosed = 22,
    /// Not handled: the source is not the sender's own address.
    SinewRejectedForgedSource = 23,
    /// Not handled: the handler refused it.
    SinewRejectedByHandler = 24,
    /// Not handled: the destination does not support this request.
    SinewRejectedUnsupported = 25,
    /// Not handled: the application has ended and is not ready again.
    SinewRejectedDown = 26,
    /// Not handled: the access list of the destination's node does not allow it.
    SinewRejectedNotAllowed = 27,
    /// Not handled: a confirmed message to many has too many members or nodes, or too many such messages are
    /// in flight.
    SinewRejectedTooManyMembers = 28,
}

/// Gives a text for a status: its general meaning. Never NULL. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_status_text(status: i32) -> *const c_char {
    Status::text_of(status).as_ptr()
}

/// Gives a sentence about the last error of the calling thread: the cause in this case, and the remedy. Never
/// NULL; empty if there was no error. It stays until the thread's next error. Any thread, each of which has
/// its own.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_last_error() -> *const c_char {
    last_sentence()
}

/// Gives a text for an outcome. Never NULL. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_outcome_text(outcome: i32) -> *const c_char {
    outcome_of(outcome).map_or(c"no outcome", text_of).as_ptr()
}

pub(crate) fn outcome_of(code: i32) -> Option<sinew_runtime::outcome::Outcome> {
    sinew_runtime::outcome::Outcome::from_code(u8::try_from(code).ok()?)
}

pub(crate) const fn code_of(outcome: sinew_runtime::outcome::Outcome) -> Outcome {
    match outcome {
        sinew_runtime::outcome::Outcome::Delivered => Outcome::SinewDelivered,
        sinew_runtime::outcome::Outcome::Expired => Outcome::SinewExpired,
        sinew_runtime::outcome::Outcome::Failed => Outcome::SinewFailed,
        sinew_runtime::outcome::Outcome::PeerLost => Outcome::SinewPeerLost,
        sinew_runtime::outcome::Outcome::Unknown => Outcome::SinewUnknown,
        sinew_runtime::outcome::Outcome::Rejected(why) => match why {
            Rejection::NoSuchApplication => Outcome::SinewRejectedNoSuchApplication,
            Rejection::NoSuchNode => Outcome::SinewRejectedNoSuchNode,
            Rejection::UnknownKind => Outcome::SinewRejectedUnknownKind,
            Rejection::Malformed => Outcome::SinewRejectedMalformed,
            Rejection::QueueFull => Outcome::SinewRejectedQueueFull,
            Rejection::TooLong => Outcome::SinewRejectedTooLong,
            Rejection::Closed => Outcome::SinewRejectedClosed,
            Rejection::ForgedSource => Outcome::SinewRejectedForgedSource,
            Rejection::ByHandler => Outcome::SinewRejectedByHandler,
            Rejection::Unsupported => Outcome::SinewRejectedUnsupported,
            Rejection::Down => Outcome::SinewRejectedDown,
            Rejection::NotAllowed => Outcome::SinewRejectedNotAllowed,
            Rejection::TooManyMembers => Outcome::SinewRejectedTooManyMembers,
        },
    }
}

pub(crate) const fn text_of(outcome: sinew_runtime::outcome::Outcome) -> &'static CStr {
    match code_of(outcome) {
        Outcome::SinewDelivered => c"delivered: the destination has handled it",
        Outcome::SinewExpired => c"expired before it was handled",
        Outcome::SinewFailed => c"failed: the destination ended, or failed, before it settled the message",
        Outcome::SinewPeerLost => c"not sent: the connection to its node was lost",
        Outcome::SinewUnknown => c"unknown: it may have been handled",
        Outcome::SinewRejectedNoSuchApplication => {
            c"not handled: no application has this TID; is it registered and spelled right?"
        }
        Outcome::SinewRejectedNoSuchNode => c"not handled: the node is not known or not connected",
        Outcome::SinewRejectedUnknownKind => c"not handled: the destination does not handle this kind",
        Outcome::SinewRejectedMalformed => {
            c"not handled: the payload is not what its kind says; do both sides use the same type?"
        }
        Outcome::SinewRejectedQueueFull => {
            c"not handled: a queue was full; the destination is slower than its senders"
        }
        Outcome::SinewRejectedTooLong => c"not handled: the payload is longer than `node.payload_max` of a node on its way; raise that on all nodes, or send it in parts",
        Outcome::SinewRejectedClosed => c"not handled: the destination's application has ended",
        Outcome::SinewRejectedForgedSource => c"not handled: the source TID is not the sender's",
        Outcome::SinewRejectedByHandler => c"not handled: the destination's handler refused it",
        Outcome::SinewRejectedUnsupported => c"not handled: this cannot be asked of this destination",
        Outcome::SinewRejectedDown => {
            c"not handled: the destination's application has ended and is not ready again"
        }
        Outcome::SinewRejectedNotAllowed => {
            c"not handled: the access list of the destination's node does not allow it"
        }
        Outcome::SinewRejectedTooManyMembers => c"not handled: a confirmed message reaches at most 256 members of a group on one node, and 256 other nodes, and an application has 64 of them under way; send it to smaller groups, or unconfirmed",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_outcome_has_its_number_on_the_wire() {
        let outcomes: Vec<_> = (0..=i32::from(u8::MAX)).filter_map(outcome_of).collect();
        assert_eq!(outcomes.len(), 18);
        for outcome in outcomes {
            assert_eq!(code_of(outcome) as i32, i32::from(outcome.code()), "{outcome:?}");
        }
        assert_eq!((outcome_of(-1), outcome_of(5), outcome_of(256)), (None, None, None));
    }
}
