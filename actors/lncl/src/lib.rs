//! LNCL, the Local Node Communication Layer: moves messages between the applications of one node, in one process or
//! many.
//!
//! Within one process no message passes through LNCL. It owns the registry and publishes the routes, and a sender's
//! thread puts its message into the target's mailbox. For other processes LNCL listens on a Unix socket, with one
//! connection per address. If both sides can, they use a ring in shared memory for each direction. A sender's thread
//! writes into the client's ring itself, and LNCL's thread reads the frames of clients.
//!
//! | rule | |
//! | --- | --- |
//! | LNCL-1 | A connection's first frame is `LNCL_REGISTER`, complete within 2 s. One connection has one address; any end of it frees the address, the name and the memberships. |
//! | LNCL-2 | Only processes of the node's own user, of root, and of users of the access list are served; the kernel reports the user. The number of unmapped users is refused. |
//! | LNCL-3 | A client sends only as its own TID. A frame with another source is rejected as `ForgedSource` and counted; the connection continues. |
//! | LNCL-4 | A malformed frame, another version, an overlong frame, or a kind not for clients ends its connection, with `LNCL_REFUSAL` and a sentence. It has no other effect. |
//! | LNCL-5 | A name has 1 to 63 bytes, no control characters, and one holder on a node. A fixed address is in the fixed range and has one holder. A released dynamic address is not used again before all others. |
//! | LNCL-6 | A client that requires names gets `LNCL_REGISTERED` when all of them are ready. Before that it gets no frame but the missing names, if it asked for them. |
//! | LNCL-7 | Each confirmed message to a client ends with the client's outcome, or as `Rejected(Closed)` if it was not sent when the connection ended. A message that was sent and not answered then ends as `Unknown` if the client still lives, since the client may yet take it. If the client is gone, it ends as `Failed` if the client had taken it, else as `Rejected(Closed)`. |
//! | LNCL-8 | Two names of payload types with one id are rejected if both are registered. A name of another user's application blocks none of the robot's own. |
//! | LNCL-9 | A client that supports rings, and reports that, gets a ring in shared memory for each direction. The socket then carries only descriptors and the final refusal, and signals either side's end. |
//! | LNCL-13 | Unregistered connections have limits of their own: for all, for one process, and for users that only the access list admits. Connections of such a user are limited in rate, and so are reads from them. |
//! | LNCL-14 | Unconfirmed messages of a client that were rejected are reported to it: the first at once, later ones together. |
//! | LNCL-15 | A connection ends with the process that connected, even while a child that it forked holds the socket open. |
//! | LNCL-16 | Each confirmed message of a client has an outcome, even if its queue is full. A client that does not read its outcomes is not read. |
//! | LNCL-17 | A client with a direct link to a process that has ended is notified, even while a child of that process holds the link's end. |
//! | LNCL-20 | While an application with direct links is watched, its client reports the messages on them; a report never delays a message. |
//! | LNCL-21 | A client may declare the structures of its types, for comparisons with those of other applications. A declaration without room, or of invalid bytes, is counted and ignored. |
//! | LNCL-22 | The name of a command of the node is given only to processes in the process group that the node started for it. |

#![allow(
    missing_docs,
    rustdoc::private_intra_doc_links,
    reason = "the public face is the package `sinew`; all that is public here is for the node alone"
)]

mod actor;
mod client;
mod client_socket;
mod command;
mod core;
mod descriptors;
#[cfg(feature = "fuzzing")]
pub mod fuzzing;
mod guest_connections;
mod guest_reads;
mod link;
mod link_broker;
mod listener;
mod observed_links;
mod ports;
mod process_watch;
mod reader;
mod registrar;
mod rings;
mod server;
pub mod session;
#[cfg(all(any(test, feature = "testing"), target_os = "linux"))]
#[doc(hidden)]
pub mod slow_close;
mod state;
#[cfg(any(test, feature = "testing"))]
#[doc(hidden)]
pub mod testing;
#[cfg(test)]
mod tests;
mod unauthenticated;
pub mod undelivered;
mod worker;

pub use actor::Lncl;
pub use client_socket::ClientSocket;
pub use command::{ClaimError, CommandPort, Commands, Presence, Reading, Signs};
pub use core::RegisterError;
pub use core::{Owner, Registry};
pub use listener::{ListenError, SocketAccess};
pub use reader::Reader;
pub use registrar::{
    LocalApp, app_down, app_ready, app_stopped, nearest, register_command, register_local, resolve,
    set_member, types_known, unregister_local,
};
pub use state::State;

pub use sinew_model::events::LnclEvent as Event;
