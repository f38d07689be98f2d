//! Values of class Stream that are sent to another node by UDP, so that a lost packet delays only itself.
//!
//! TCP delivers nothing behind a missing segment, and retransmits it after 200 ms at the earliest if little
//! is in flight. Here each value is a datagram of its own. The newest one of each flow (source, destination
//! and kind) is repeated after a time-out of some milliseconds until it is acknowledged, superseded, or too
//! old. Values older than the last received one are not forwarded. Values longer than a datagram, and all
//! values while datagrams do not get through, are sent over the connection of the class. Their numbers come
//! from the same counter. `docs/protocol/gncl.md` defines the encoding.
//!
//! | rule | meaning |
//! | --- | --- |
//! | DATAGRAM-1 | A datagram has the key that its receiver has given to its sender; one without it is dropped before all else. |
//! | DATAGRAM-2 | Each side announces its datagram address and key on each Stream connection; a new key sends the newest values by connection. |
//! | DATAGRAM-3 | Values of both transports share their numbers; a receiver forwards no value of a flow with a number not above the last one. |
//! | DATAGRAM-4 | The newest value of a flow is repeated until it is acknowledged, superseded, too old, or the connection has accepted it. |
//! | DATAGRAM-5 | No value is sent by datagram before one was answered; after 500 ms without any answer none is, and probes are sent at intervals. |
//! | DATAGRAM-6 | At most 256 datagrams and 32 KiB are in flight to a peer. |
//! | DATAGRAM-7 | No value's datagram is longer than an acknowledged one; lengths no longer acknowledged use the connection and are probed again. |
//!
//! | file | content |
//! | --- | --- |
//! | `core.rs` | both directions together: no socket, no clock |
//! | `outgoing.rs` | values that are sent, repeated, and waiting |
//! | `incoming.rs` | values that are forwarded and acknowledged |
//! | `path.rs` | whether datagrams get through |
//! | `lengths.rs` | which lengths of them do |
//! | `round_trip.rs` | when a datagram counts as lost |
//! | `packet.rs` | the encoding |
//! | `channel.rs` | the core of one peer, its lock, and the sending |
//! | `alarm.rs` | the alarm of all channels |
//! | `faults.rs` | faults that the simulation plants |
//! | `sockets.rs` | the node's sockets, and their announcement to peers |

mod alarm;
mod channel;
mod core;
#[cfg(feature = "testing")]
mod faults;
#[cfg(feature = "fuzzing")]
pub(super) mod fuzzing;
mod incoming;
mod lengths;
mod outgoing;
mod packet;
mod path;
mod round_trip;
mod sockets;
#[cfg(test)]
mod tests;

#[cfg(feature = "testing")]
pub use self::faults::Fault;
pub use self::{
    core::{Core, Order, stamp},
    incoming::{FLOWS_MAX, Incoming},
    lengths::{Report, SHORTEST},
    outgoing::{LIMITS, Offered, Outgoing, Position},
    packet::{Acknowledgement, DATAGRAM_MAX},
};

pub(super) use alarm::Alarm;
pub(super) use channel::{Channel, ForwardedNumbers, Freshness, read_value};
pub(super) use packet::Prefix;
pub(super) use sockets::{Announcement, Sockets};
