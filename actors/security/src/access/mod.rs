//! The access list: rules for the messages on this node and for the host users' registrations.
//!
//! Without a list every message is allowed. With a list
//! ([`SecurityConfig::access`](sinew_model::config::SecurityConfig::access)), a message that no rule allows is
//! refused. The node of the target application refuses it, whether it arrives from another node, another process or
//! this one.
//! `docs/decisions/0025-access-list.md` gives the reasons. `docs/book/src/reference/access-list.md` describes the
//! format of a list.
//!
//! Pure modules:
//!
//! - `selector` matches applications; `rule` finds the first rule that applies; `index` caches its results by address.
//! - `client` authorizes users of this host; `memberships` limits the groups that they join.
//! - `asked` is the table of pending requests: their replies need no rule.
//! - `file` parses a list.
//!
//! `guard` is the shell: it publishes the active list to senders without a lock, and logs refusals.

mod client;
mod file;
#[cfg(feature = "fuzzing")]
#[doc(hidden)]
pub mod fuzzing;
mod guard;
mod index;
mod memberships;
mod pending_requests;
mod rule;
mod selector;
#[cfg(test)]
mod tests;

pub use client::Applicant;
pub use file::read;
pub use guard::{Access, Explanation, ReportedNames};
pub use guard::{AccessError, AccessSummary};
pub use memberships::JoinGroupError;
pub use rule::{List, Question};
