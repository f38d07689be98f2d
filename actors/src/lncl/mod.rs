//! LNCL, the Local Node Communication Layer: moves messages between the applications of one node, in one process or
//! many.
//!
//! In one process no message passes through LNCL: it owns the registry and publishes the routes, and a sender's thread
//! puts its message into the target's mailbox. For other processes LNCL listens at a unix socket, one connection for
//! each address, with a ring in shared memory each way where both can; a sender's thread writes into the client's ring
//! itself, and LNCL's thread reads what clients send.
//!
//! | rule | |
//! | --- | --- |
//! | LNCL-1 | A connection's first frame is `LNCL_REGISTER`, complete within 2 s. One connection has one address; when it ends, however it ends, the address, the name and the memberships are free. |
//! | LNCL-2 | Only processes of the node's own user, and of root, are served; the kernel says who they are. |
//! | LNCL-3 | A client speaks for its own TID alone. A frame with another source is refused as `ForgedSource` and counted; the connection lives. |
//! | LNCL-4 | What is no frame, of another version, too long, or not for clients to send ends its connection, with `LNCL_REFUSAL` and a sentence. Nothing else is touched. |
//! | LNCL-5 | A name has 1 to 63 bytes, no control characters, and one holder on a node. A fixed address is in the fixed range and has one holder. A dynamic address that was given back is not given out again before all others. |
//! | LNCL-6 | A client that requires names gets `LNCL_REGISTERED` when all of them are ready. Nothing is sent to it before, but what is missing, if it wants to know. |
//! | LNCL-7 | Each confirmed message to a client ends in what the client says of it; as `Rejected(Closed)` if it was not sent when the connection ended. What was sent and not answered then: where the client has gone as `Failed` if it had taken it, else as `Rejected(Closed)`; where it lives on as `Unknown`, for it may take it yet. |
//! | LNCL-8 | Two names of payload types with one id are refused where both are told at registration. What another user's application tells bars none of the robot's own. |
//! | LNCL-9 | A client that can, and says so, gets a ring in shared memory for each direction; the socket then carries descriptors and last words only, and tells either side's end. |
//! | LNCL-13 | Connections that have not said who they are have bounds of their own, for all, for one process, and for users whom only the access list lets in; each of these connects at a pace, and what these send is read at one. |
//! | LNCL-14 | Unconfirmed messages of a client's that were refused are reported to it: the first at once, later ones together. |
//! | LNCL-15 | A connection ends with the process that connected, also while a child that it forked holds the socket open. |
//! | LNCL-16 | Each confirmed message of a client's has an outcome, also where its queue is full. Who takes none is not read. |
//! | LNCL-17 | Who has a direct link with a process that has ended is told so, also while a child of that process holds the link's end. |

mod actor;
mod client;
mod core;
mod descriptors;
mod door;
mod facts;
#[cfg(feature = "fuzzing")]
pub(crate) mod fuzzing;
mod guest_pace;
mod guests;
mod introductions;
mod link;
mod listener;
pub(crate) mod payload;
mod reader;
mod registrar;
mod rings;
mod server;
pub(crate) mod session;
mod shares;
mod strangers;
#[cfg(test)]
pub(crate) mod testing;
#[cfg(test)]
mod tests;
mod untold;
mod worker;

pub(crate) use actor::Lncl;
pub use core::RegisterError;
pub(crate) use core::{ClientId, Owner, Registry, User};
pub(crate) use door::Door;
pub(crate) use facts::AppFact;
pub(crate) use listener::{ListenError, Openers};
pub(crate) use reader::Reader;
pub(crate) use registrar::{
    LocalApp, app_down, app_ready, app_stopped, nearest, register_local, resolve, set_member,
    unregister_local,
};
#[cfg(test)]
pub(crate) use shares::OF_USER_AT_SYNC;
pub(crate) use shares::Shares;
pub(crate) use untold::Untold;

use sinew_runtime::tid::AppAddress;

/// What LNCL is told.
#[derive(Debug)]
pub(crate) enum Event {
    /// By the root: all that this application of another process requires is ready.
    Released { app: AppAddress },
    /// By any thread: refused messages are to be reported to their senders.
    Undelivered,
}
