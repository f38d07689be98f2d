//! Who may send what to whom on this node, and which users of the host may register what.
//!
//! Without a list everything may be sent. With one ([`SecurityConfig::access`](crate::config::SecurityConfig::access)) what no rule allows is
//! refused by the node of the application that it is for, whichever way it comes: from another node, another process or this one.
//! `docs/decisions/0025-access-list.md` says why it is so, `docs/CONFIGURATION.md` how a list is written.
//!
//! - `who`: how a rule names applications; `rule`: a rule, and which of several counts; `index`: the same answer without a search
//!   through names; `client`: users of this host; `memberships`: how many groups they are in. Pure.
//! - `asked`: questions that may be replied to. `file`: reads a list. `guard`: the list in force, as senders read it, and what is told of it.

mod asked;
mod client;
mod file;
#[cfg(feature = "fuzzing")]
pub(crate) mod fuzzing;
mod guard;
mod index;
mod memberships;
mod rule;
#[cfg(test)]
mod tests;
mod who;

pub(crate) use client::Applicant;
pub(crate) use file::read;
pub(crate) use guard::{Access, Explanation, Said};
pub use guard::{AccessError, AccessSummary};
pub(crate) use memberships::JoinRefusal;
pub(crate) use rule::{List, Question};
