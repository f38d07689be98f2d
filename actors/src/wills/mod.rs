//! The last wills of a node's applications, held by other nodes for the day that the whole node is lost.
//!
//! A node executes the wills of its own applications itself, as long as it lives. For the other case every node tells
//! each linked one the wills of its applications that are ready now; whoever loses a node executes its wills towards its
//! own applications: the name, the address or the group that a will is for, as far as it is there. No master is needed,
//! and each heir gets it once, from its own node.
//!
//! | rule | |
//! | --- | --- |
//! | WILL-1 | The whole list goes to a node when the link comes up, at each change (not sooner than 5 ms after the one before), and every 2 s as long as it is not empty. |
//! | WILL-2 | A lost node's wills are executed once for each loss; not those of a node that left: it stops its applications itself. A node that gives up has executed its wills if it says goodbye on its link, and has not if that link breaks. |
//! | WILL-3 | That a node is there in a new life is the loss of the old one, whoever says so first. |
//! | WILL-4 | A will of more than 1,024 bytes, and what is more than 256 wills of a node or than `payload_max` has room for, stays at home. One list is held of each of `ndl.nodes_max` nodes. |
//! | WILL-5 | The wills of a node whose certificate is revoked are not executed, whatever becomes of it. |
//! | WILL-6 | A list about another life of its node than the one that is linked is refused in words, and counted. |

mod core;
#[cfg(feature = "fuzzing")]
pub(crate) mod fuzzing;
mod shell;
#[cfg(test)]
pub(crate) mod tests;
mod words;

pub(crate) use core::{Core, Input};
pub(crate) use shell::{feed, next_wake, receive, revoke};
