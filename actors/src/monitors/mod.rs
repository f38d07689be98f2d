//! Monitors: an application is told, exactly once, when the life of another ends, on this node or on any.
//!
//! The decisions are in `core`; the state outlives the sync manager, which carries the frames. A watcher's node sends
//! the whole list of whom it watches on a node to that node's sync manager (WATCH), at each change, when a link comes up,
//! and every 2 s; the answer, and the word at each end, is which life each of them is in and how the last one ended
//! (LIVES). Both are states, not steps: what is lost with a connection is made good by the next one.
//!
//! | rule | |
//! | --- | --- |
//! | MON-1 | A monitor watches the present life of its target: the one that runs, waits for its start, or is between two attempts. Its end is told once. |
//! | MON-2 | Who has no such address is told at once (NoSuchAddress); whose node is not known, too (NodeLost). |
//! | MON-3 | A cut connection is no end. Its node's loss is (NodeLost), and so is an end that is learned of when the link is back. |
//! | MON-4 | A life that may have begun after the monitor was set is not taken for the one that was to be watched: its former one's end is told. |
//! | MON-5 | A watcher's monitors end with its life. |
//! | MON-6 | 256 monitors of one application, 4,096 of a node, 1,024 applications watched on one other node: the next one is refused. An application in a process of its own, so every guest, has none. A `Down` that a mailbox does not take is offered again every 10 ms, and counts as a monitor until then. |
//! | MON-7 | The ends of the 1,024 applications that went last are remembered, and of the 256 of guests beside them. |
//! | MON-8 | That nobody is there, or no such node is known, is told to one watcher 256 times at once and then once every 10 ms; what waits for its time counts as a monitor. |

mod core;
#[cfg(feature = "fuzzing")]
pub(crate) mod fuzzing;
mod shell;
#[cfg(test)]
mod tests;
mod words;

pub(crate) use core::{Core, Input};
pub(crate) use shell::{change, drain, feed, has_orders, next_wake, note, receive};
pub(crate) use words::Cause;
