//! A client of one node for bridges to other systems. It knows no other system.
//!
//! A [`NodeClient`] is an application in a process of its own, as any other: it has an address, a name if it wants
//! one, and the rights that the access list gives to that name. It sends and receives payloads as bytes, and knows
//! their types by name only.
//!
//! | module | content |
//! | --- | --- |
//! | [`client`] | registration, messages, outcomes, replies |
//! | [`seen`] | received messages, and changes of the directory and of nodes |
//! | [`types`] | the structure of a type, and which types are protected |

pub mod client;
pub mod seen;
pub mod types;

pub use client::{Destination, NodeClient, Options, Outgoing};
pub use seen::Seen;
pub use types::ProtectedTypes;
