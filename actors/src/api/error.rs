//! What can go wrong between an application and its node.

use std::{io, path::PathBuf, time::Duration};

use sinew_runtime::{
    outcome::Outcome,
    wire::{DecodeError, FrameError, Kind},
};

/// Why an operation of NodeAPI failed.
#[derive(Debug, thiserror::Error)]
pub enum ApiError {
    /// Nobody listens at the path. The environment is at fault; nothing changed.
    #[error("no node can be reached at {path:?}: {cause}; does it run, with this path as its `lncl.socket`?")]
    NoNode {
        /// The path.
        path: PathBuf,
        /// What the system said.
        cause: io::Error,
    },
    /// The node refused, in its words. The connection is closed and nothing is registered.
    #[error("the node refused: {0}")]
    Refused(String),
    /// The registration's deadline passed at the start-up barrier. Nothing is registered.
    #[error("after {waited:?} still waiting for these to be ready: {}", requires.join(", "))]
    Waiting {
        /// The names that were required; at least one of them is not ready.
        requires: Vec<String>,
        /// How long it waited.
        waited: Duration,
    },
    /// The node did not answer in time. Whether it did what was asked is not known.
    #[error("the node did not answer within {0:?}; does it hang?")]
    NoAnswer(Duration),
    /// The connection has ended, and the registration with it; register again.
    #[error("the connection to the node has ended: {0}")]
    Closed(String),
    /// The connection has ended through no fault of this endpoint, which registers again by itself while it is used: each
    /// send tries, and [`receive`](super::Endpoint::receive) waits for it. A message of this call was not sent.
    #[error("the connection to the node has ended: {0}; the endpoint registers again by itself")]
    Away(String),
    /// There was no room for so long: the patience of the endpoint, or the time that the call was given. Or another send's
    /// patience was over before, and nothing was taken since. Nothing of this message is received; it may be sent again.
    #[error(
        "no room for the message for {0:?}: the node, or the receiver on a direct link, is stopped or too slow; it was not sent"
    )]
    Stalled(Duration),
    /// A message that was lent was neither sent nor dropped. The caller is at fault; nothing was sent.
    #[error("memory for a message is lent; send that message or drop it first")]
    Lent,
    /// The payload is above the node's limit. The caller is at fault; nothing was sent.
    #[error("a payload of {length} bytes is above the node's limit of {limit}; raise `payload_max`")]
    TooLong {
        /// Length of the payload.
        length: usize,
        /// The node's limit.
        limit: usize,
    },
    /// The kind is one of the layers' own. The caller is at fault; nothing was sent.
    #[error(
        "the kind {0} belongs to Sinew's layers, which would end the connection; take one from `Kind::named`"
    )]
    NotYours(Kind),
    /// A request was not handled, or a group not joined.
    #[error("it ended as {0:?}")]
    Ended(Outcome),
    /// No reply came in time. The request may have been handled.
    #[error("no reply came within {0:?}")]
    NoReply(Duration),
    /// The message asks for no reply. The caller is at fault; nothing was sent.
    #[error("the message asks for no reply")]
    NotAsked,
    /// The payload of a reply or of an answer is not what it should be. The peer is at fault.
    #[error(transparent)]
    Malformed(#[from] DecodeError),
    /// The node sent something that is no frame. The connection is closed.
    #[error("the node sent what cannot be read: {0}")]
    Frame(#[from] FrameError),
}
