//! The last wills of a node's applications, which other nodes hold in case the whole node is lost.
//!
//! A node executes the wills of its own applications itself while it runs. For the loss of a node, every node
//! sends the wills of its ready applications to each linked node. A node that detects the loss of another
//! executes its wills for its own applications. The recipient of a will is a name, an address or a group. No
//! master is needed, and each recipient receives the will once, from its own node.
//!
//! | rule | |
//! | --- | --- |
//! | WILL-1 | A node sends its full list to another node when the link comes up, at each change (at least 5 ms after the previous list), and every 2 s while the list is not empty. |
//! | WILL-2 | The wills of a lost node are executed once for each loss. The wills of a node that left are not: it stops its applications itself. A node that gives up has executed its wills if it sends a goodbye on its link, and has not if that link breaks. |
//! | WILL-3 | A new incarnation of a node is the loss of the previous one, whichever source reports it first. |
//! | WILL-4 | Other nodes hold no will of more than 1,024 bytes, at most 256 wills of a node, and only as many as fit in `payload_max`. A node holds one list for each of at most `ndl.nodes_max` nodes. |
//! | WILL-5 | The wills of a node with a revoked certificate are not executed, in any case. |
//! | WILL-6 | A list about another incarnation of its node than the linked one is rejected with a description, and counted. |

mod core;
#[cfg(feature = "fuzzing")]
pub mod fuzzing;
mod protocol;
mod shell;
#[cfg(test)]
pub mod tests;

pub use core::{Core, Input};
pub use shell::{feed, is_revoked, next_wake, receive, revoke};
