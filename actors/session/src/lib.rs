//! The session between two nodes: it delivers messages once and in order over any number of connections.
//!
//! Each direction has its own numbers. The sender numbers a message when it first writes it, and keeps it
//! until the receiver has acknowledged it. The receiver accepts only the next number. Each side of a new
//! connection first sends the next number that it expects ([`Ack`]), and the other side continues there. Both
//! halves outlive connections and restarts of GNCL.
//!
//! ```text
//!  Sending     Paused ── Ack ──► Flowing ── link ended ──► Paused
//!                        Ack of another epoch ──► AwaitingEpochAck, all kept are reported ── our Ack goes out ──► Flowing
//!  Receiving   Fenced ── attached, epoch known ──► Taking ── next link ──► Fenced
//! ```
//!
//! | rule | meaning |
//! | --- | --- |
//! | SESSION-1 | A message gets the next number when it is first written, and keeps it on every later connection. |
//! | SESSION-2 | The sender keeps it until it is acknowledged; the kept messages are bounded in number and bytes. |
//! | SESSION-3 | On a new connection nothing is sent before the receiver's Ack; then all from the number in it. |
//! | SESSION-4 | The receiver accepts the next number only, on the latest connection only, and counts it before it forwards it. |
//! | SESSION-5 | An Ack after a loss of state ends an epoch (one numbering): kept messages are reported, not resent. The next follows its Ack. |
//! | SESSION-6 | A kept message that is not needed any more (expired, superseded) is sent as a void of the same number. |
//!
//! Destinations that cannot be sent to at present are in `backlog.rs`, with its rules (CREDIT-1 to CREDIT-5).
//!
//! Besides: [`outlet`], the writing half of a connection, [`counts`] of the messages at one
//! [`place`], and the [`book`] of all places.
//!
//! The session has no socket and no clock: the same calls give the same answers. `docs/protocol/gncl.md`
//! defines the encoding.

mod backlog;
#[cfg(test)]
mod backlog_tests;
pub mod book;
pub mod counts;
#[cfg(test)]
mod credit_model;
pub mod direct_links;
#[cfg(feature = "fuzzing")]
#[doc(hidden)]
pub mod fuzzing;
#[cfg(test)]
mod model;
pub mod outlet;
pub mod place;
mod receiving;
#[cfg(test)]
mod room_tests;
mod sending;
#[cfg(test)]
mod table;
#[cfg(test)]
mod tests;

pub use backlog::{BacklogLimits, Expires, HeldChange, ReceiveBacklog, SendBacklog};
pub use receiving::{Arrival, Receiving};
pub use sending::{AckEffect, Sending, Window};

use serde::{Deserialize, Serialize};
use sinew_runtime::{time::Time, wire::Message};

impl Expires for Message {
    fn expiry(&self) -> Time {
        self.header.expiry()
    }
}

/// The number of an epoch's first message.
const FIRST: u64 = 1;

/// The acknowledgement of one side for both directions: payload of the frame ACK.
#[derive(Clone, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Ack {
    /// The identity of the sender's receive state for this peer. A different value means that the earlier
    /// state, with all accepted numbers, is lost.
    #[serde(rename = "memory")]
    pub receiver_id: u64,
    /// The epoch of the messages that this ACK's sender sends. A later epoch is larger.
    pub epoch: u64,
    /// The epoch of this ACK's receiver that `next` refers to; 0 if its sender knows none.
    #[serde(rename = "of")]
    pub peer_epoch: u64,
    /// The next number that this ACK's sender expects. It has received all before it.
    pub next: u64,
    /// Number of the last change of `held`.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub change: u64,
    /// Destinations that accept nothing now; see [`ReceiveBacklog`].
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub held: Vec<u64>,
    /// Messages, and bytes of their frames, that may arrive from `next` on; see [`ReceiveBacklog::room`]. An
    /// earlier, larger value remains valid.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub room: Option<(u64, u64)>,
}

/// The position of the sending half of a session, at one moment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SendPosition {
    /// The epoch of these numbers.
    pub epoch: u64,
    /// The identity of the peer's receive state in this epoch.
    pub receiver_id: Option<u64>,
    /// The peer has acknowledged all messages before this number.
    pub acknowledged: u64,
    /// The number of the next message.
    pub next: u64,
}

/// The position of the receiving half, at one moment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ReceivePosition {
    /// The identity of this receive state.
    pub receiver_id: u64,
    /// The peer's epoch; 0 before the first.
    pub epoch: u64,
    /// The next expected number.
    pub next: u64,
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde calls it with a reference")]
const fn is_zero(number: &u64) -> bool {
    *number == 0
}
