//! The audit: where is every message that was ever sent?
//!
//! A message is always in one place: a mailbox, what waits for a client, what goes to a node, what came from one. Each place counts what
//! it took and how each of these ended, and each has a law of its own: `taken = ends + waiting`. Between two nodes the numbers of the
//! session are the law: what one knows to have arrived, the other has taken. So a message that nobody can explain has a name: of a
//! place, or of a link.
//!
//! | file | what it is |
//! | --- | --- |
//! | `account.rs` | the counters of one place, and their law |
//! | `book.rs` | which places there are, and the accounts of those that are gone |
//! | `reading.rs` | what a node says of itself |
//! | `asking.rs`, `words.rs` | what nodes say to each other |
//! | `answering.rs` | the thread that answers |
//! | `compare.rs` | two readings of all nodes, and what cannot be explained in them |
//! | `system.rs`, `table.rs` | the result, and how it is shown |

mod account;
mod answering;
mod asking;
mod book;
mod compare;
#[cfg(feature = "fuzzing")]
pub(crate) mod fuzzing;
mod reading;
mod system;
mod table;
mod words;

pub use account::{Account, Place};
pub(crate) use asking::{Questions, audit, receive};
pub(crate) use book::{Book, ClientTaking};
pub(crate) use reading::read;
pub use reading::{Entry, NodeAudit, Receiving, Sending, Session};
pub use system::{At, Audit, Link, LinkState, Unexplained};
pub(crate) use words::put_together;
