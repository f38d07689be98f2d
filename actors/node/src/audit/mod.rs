//! The audit: where is every message that was ever sent?
//!
//! A message is always in one place: a mailbox, a client's outlet, a session to a node, or a session from
//! one. Each place counts the messages that it took and the outcome of each, and satisfies an invariant:
//! `taken = ends + waiting`. Between two nodes the sequence numbers of the session give the invariant: the
//! receiver has taken all messages that the sender knows as acknowledged. So every message that is not
//! accounted for is attributed to a place or to a link.
//!
//! | file | content |
//! | --- | --- |
//! | `reading.rs` | the report of a node about itself |
//! | `questions.rs`, `protocol.rs` | the questions and answers between nodes |
//! | `answer_thread.rs` | the thread that answers |
//! | `compare.rs` | two readings of all nodes, and the messages that are not accounted for |
//! | `system.rs`, `table.rs` | the result, and its display |

mod answer_thread;
mod compare;
#[cfg(feature = "fuzzing")]
#[doc(hidden)]
pub mod fuzzing;
mod protocol;
mod questions;
mod reading;
mod system;
mod table;

pub(crate) use protocol::put_together;
pub(crate) use questions::{Frames, Questions, audit};
pub(crate) use reading::read;
pub use reading::{Entry, NodeAudit, Receiving, Sending, Session};
pub use sinew_session::{counts::Account, place::Place};
pub use system::{At, Audit, Link, LinkState, Unexplained};
