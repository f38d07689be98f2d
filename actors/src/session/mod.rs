//! The session between two nodes: what makes messages arrive once and in order through any number of connections.
//!
//! Each direction counts for itself. The sender numbers a message when it writes it first, and keeps it until the receiver
//! has acknowledged it; the receiver takes the next number and nothing else. Whoever has a new connection says first what
//! it takes next ([`Ack`]), and the other goes on from there. Both halves outlive connections and restarts of GNCL.
//!
//! ```text
//!  Sending     Paused ── Ack ──► Flowing ── link ended ──► Paused
//!                        Ack of another epoch ──► Untold, all kept are reported ── our Ack goes out ──► Flowing
//!  Receiving   Fenced ── attached, epoch known ──► Taking ── next link ──► Fenced
//! ```
//!
//! | rule | what it says |
//! | --- | --- |
//! | SESSION-1 | A message has the next number when it is written first, and keeps it on every later connection. |
//! | SESSION-2 | The sender keeps it until it is acknowledged; what it keeps is bounded in messages and bytes. |
//! | SESSION-3 | On a new connection nothing is sent before the receiver's Ack; then all from the number in it. |
//! | SESSION-4 | The receiver takes the next number only, on the latest connection only, and counts it before it hands it on. |
//! | SESSION-5 | An epoch is one counting. An Ack of a peer that has forgotten what it took ends the epoch: what is kept is reported, not sent again, and nothing of the next one goes out before the Ack that names it. |
//! | SESSION-6 | What has lost its use while it was kept (expired, superseded) is sent as a void of the same number. |
//!
//! Who cannot be sent to at present is in `shelf.rs`, with its rules (CREDIT-1 to CREDIT-5).
//!
//! No socket, no clock: the same calls give the same answers. `docs/protocol/gncl.md` has the bytes.

#[cfg(test)]
mod credit_model;
#[cfg(feature = "fuzzing")]
pub(crate) mod fuzzing;
#[cfg(test)]
mod model;
mod receiving;
#[cfg(test)]
mod room_tests;
mod sending;
mod shelf;
#[cfg(test)]
mod shelf_tests;
#[cfg(test)]
mod table;
#[cfg(test)]
mod tests;

pub(crate) use receiving::{Arrival, Receiving};
pub(crate) use sending::{Heard, Sending, Window};
pub(crate) use shelf::{Held, Shelf, ShelfLimits, Turn, Waits};

use serde::{Deserialize, Serialize};
use sinew_runtime::{time::Time, wire::Message};

impl Waits for Message {
    fn expiry(&self) -> Time {
        self.header.expiry()
    }
}

/// The number of an epoch's first message.
const FIRST: u64 = 1;

/// What one side says of both directions: payload of the frame ACK.
#[derive(Clone, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub(crate) struct Ack {
    /// Which memory of the receiver of this its sender has: another one has forgotten all that was taken.
    pub(crate) memory: u64,
    /// Epoch in which the sender of this counts what it sends. A later one is larger.
    pub(crate) epoch: u64,
    /// Epoch of the receiver of this that `next` is about; 0 if its sender knows none.
    pub(crate) of: u64,
    /// The number that the sender of this takes next: it has all before it.
    pub(crate) next: u64,
    /// Number of the last change of `held`.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub(crate) change: u64,
    /// Destinations that take nothing now; see [`Shelf`].
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(crate) held: Vec<u64>,
    /// Messages, and bytes of their frames, that may come from `next` on; see [`Shelf::room`]. What was said before holds as well.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) room: Option<(u64, u64)>,
}

/// How far the sending half of a session is, at one moment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Sent {
    pub(crate) epoch: u64,
    /// The memory of the peer that this epoch's messages were for.
    pub(crate) memory: Option<u64>,
    /// The peer has said to have all before this number.
    pub(crate) acknowledged: u64,
    /// The number of the next message.
    pub(crate) next: u64,
}

/// How far the receiving half is, at one moment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Came {
    pub(crate) memory: u64,
    /// Epoch of the peer; 0 before the first.
    pub(crate) epoch: u64,
    /// The number that is taken next.
    pub(crate) next: u64,
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde calls it with a reference")]
const fn is_zero(number: &u64) -> bool {
    *number == 0
}
