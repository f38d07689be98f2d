//! The sync manager: no application starts before its requirements are ready.
//!
//! Every node's sync manager publishes the list of its node's applications to the sync managers of all linked
//! nodes. It holds each local application at the start-up barrier until all names that it requires are ready,
//! on any node. There is no master: each node decides for its own applications, from the published state of
//! the others.
//!
//! | rule | |
//! | --- | --- |
//! | SYNC-1 | A list replaces the previous one of its node. The newest version of the newest incarnation wins; an older one is ignored. A list about another incarnation than the linked one is rejected. |
//! | SYNC-2 | A node sends its full list to a peer when the link comes up, at each change (at least 1 ms after the previous list, or 5 ms if that had more than 4 KiB), and every 2 s. |
//! | SYNC-3 | An entry counts as ready while its list says so, its node's link is up, a list has arrived since it came up, and the node is not lost. When a node is linked in another incarnation, or found in another that is not linked, the list of the previous one becomes stale. |
//! | SYNC-4 | A list has at most 1,024 entries of at most 64 requirements, and 1,024 groups. Names have 1 to 63 bytes and no control characters. No name, address or group occurs twice. Any other list is rejected as a whole, counted and logged. |
//! | SYNC-5 | An application is released once in each of its lives, when all that it requires is met. A life begins when the application registers (not if it registers again with the same data) and when it fails. |
//! | SYNC-6 | A name resolves to the application of this node, ready or not; else to a ready one; else to one of a linked node; else to one of a node without a link. Among several nodes the lowest address wins. Any application of the name satisfies a requirement. |
//! | SYNC-7 | Applications that require each other in a cycle are not released, in any order of arrival; the cycle is reported with its names. Applications that already run are not stopped. A node with such applications ends if none of its applications has run, after 1 s if other nodes are in the cycle, so that they find it too. No cycle is formed by patterns, unregistered names, requirements with a wait limit, and counts for which too few applications are known. |
//! | SYNC-8 | A released application is notified when a requirement is lost and when it is met again, each once and in that order. An event that its mailbox rejects is sent in its latest form as soon as there is room. An unreachable requirement (its link is down, or up without a list, and its node neither lost nor restarted) is reported after 50 ms. |
//! | SYNC-9 | A wait that reaches its deadline is reported with the missing requirements, since when and why, and again each time that the deadline passes. The wait continues. |
//! | SYNC-10 | An application waits at a barrier of its own node: a name, and parties that are requirements on the applications that wait there. The application must be one of them. It waits until the barrier opens, its deadline passes, it leaves, or its life ends. |
//! | SYNC-11 | A node sends its barrier state to each linked node when the link comes up, at each change (at least 1 ms after the previous frame), and every 2 s. A node with a waiting application opens a barrier when all parties wait behind the last generation that it knows; of other nodes only the reachable ones count. The opening has the next generation, and the waiting applications are its members. |
//! | SYNC-12 | A node that receives a higher generation than the known one adopts it with its members; of the same generation it merges the members. An application that waits behind an earlier one passes if it is a member, and otherwise waits for the next one. |
//! | SYNC-13 | If a named party is missing for 50 ms because it failed, was stopped, or its node is lost, this ends the wait of each application that does not wait for its return. |
//! | SYNC-14 | An application that subscribed to the directory receives every entry when it is ready, then each change, until its life ends. An event that its mailbox rejects is sent as soon as there is room, in the state of that time. |
//! | SYNC-15 | A phase that an application reports as reached counts until its life ends, and is published in its node's list. The application waits there until all parties have reached the phase in their current lives, its deadline passes, it leaves, or its life ends; a lost party ends the wait as in SYNC-13. A requirement on a phase is met by an application that has reached it, ready or not. |
//! | SYNC-16 | A node reports nothing as lost, expired or overdue while events wait in its event queue. If its own timer was late by more than 10 ms, it first has as long to read its pending input as the delay, at most 50 ms. This applies at most three times in a row. |

#![allow(
    missing_docs,
    rustdoc::private_intra_doc_links,
    reason = "the public face is the package `sinew`; all that is public here is for the node alone"
)]

mod actor;
#[cfg(test)]
mod actor_tests;
#[doc(hidden)]
pub mod arrivals;
#[doc(hidden)]
pub mod core;
mod discovery;
#[cfg(feature = "fuzzing")]
pub mod fuzzing;
#[doc(hidden)]
pub mod list;
pub mod monitors;
mod own_app;
mod ports;
mod state;
pub mod wills;

pub use actor::SyncManager;
pub use core::{Core, Input, Output, Reason, cycle_of};
pub use list::Name;
pub use own_app::{AppTypes, ListVersion, OwnApp};
pub use state::{FrameHandler, State};

pub use sinew_model::events::SyncEvent as Event;
