//! Values of class Stream that go to another node by UDP, so that one packet that is lost holds up nothing but itself.
//!
//! TCP hands on nothing behind a segment that is missing, and looks for it after 200 ms at the earliest where little is under way. Here each
//! value is a datagram of its own. The newest one of each flow (source, destination and kind) is repeated after a time-out of some
//! milliseconds until it is acknowledged, or superseded, or too old; what is older than the last one that came is not handed on.
//! What is longer than a datagram, and everything where datagrams do not get through, goes by the connection of the class, and has its number
//! from the same counter. `docs/protocol/gncl.md` has the bytes.
//!
//! | rule | what it says |
//! | --- | --- |
//! | DATAGRAM-1 | A datagram has the key that its receiver has given to its sender; what has not is dropped before all else. |
//! | DATAGRAM-2 | Each side says on each connection for Stream where it reads datagrams, and with which key; another key has the newest values go by the connection. |
//! | DATAGRAM-3 | Values of both ways are numbered together; who has one of a flow hands on none with the same number or a smaller one. |
//! | DATAGRAM-4 | The newest value of a flow is repeated until it is acknowledged, superseded, too old, or the connection has taken it. |
//! | DATAGRAM-5 | No value goes by datagram before a datagram was answered; after 500 ms without any answer none does, and it is tried now and then. |
//! | DATAGRAM-6 | 256 datagrams and 32 KiB are on the way to a peer at most. |
//! | DATAGRAM-7 | No value goes in a datagram that is longer than one that was acknowledged; where lengths are acknowledged no more, such values go by the connection, and the lengths are probed again. |
//!
//! | file | what it is |
//! | --- | --- |
//! | `core.rs` | both directions together: no socket, no clock |
//! | `outgoing.rs` | what is sent, repeated, and waits |
//! | `incoming.rs` | what is handed on and acknowledged |
//! | `path.rs` | whether datagrams get through |
//! | `lengths.rs` | which lengths of them do |
//! | `round_trip.rs` | when a datagram counts as lost |
//! | `packet.rs` | the bytes |
//! | `channel.rs` | the core of one peer, its lock, and what is written |
//! | `reader.rs` | where datagrams arrive, and who looks at the time |
//! | `sockets.rs` | the node's sockets, and where a peer finds them |

mod channel;
mod core;
#[cfg(feature = "fuzzing")]
pub(super) mod fuzzing;
mod incoming;
mod lengths;
mod outgoing;
mod packet;
mod path;
mod reader;
mod round_trip;
#[cfg(test)]
mod simulation;
mod sockets;
#[cfg(test)]
mod tests;

pub(super) use channel::{Channel, Freshness, HandedOn};
pub(super) use outgoing::Position;
pub(super) use reader::{Alarm, keep_time, read_all};
pub(super) use sockets::{Announcement, Sockets};
