//! Monitors: an application is notified exactly once when the monitored life of another application ends, on
//! any node.
//!
//! The decisions are in `core`. The core's state survives restarts of the sync manager, which carries the
//! frames. A watcher's node sends the full list of the applications that it monitors on a node (WATCH) to
//! that node's sync manager. It sends the list at each change, when a link comes up, and every 2 s. The reply
//! (LIVES) states the current life of each application and how its previous life ended. The peer also sends
//! LIVES when a life ends. Both frames carry states, not changes: the next connection replaces anything lost
//! with the previous one.
//!
//! | rule | |
//! | --- | --- |
//! | MON-1 | A monitor watches the current life of its target: running, waiting for its start, or between two start attempts. The end of that life is reported once. |
//! | MON-2 | If no application has the address, the watcher is notified at once (NoSuchAddress). If the node is not known, it is notified at once, too (NodeLost). |
//! | MON-3 | A broken connection is not an end. The loss of the node is one (NodeLost), and so is an end that is reported after the link is up again. |
//! | MON-4 | A life that may have started after the monitor was set is not the monitored one: the end of the previous life is reported instead. |
//! | MON-5 | The monitors of a watcher end with its life. |
//! | MON-6 | Limits: 256 monitors for each application, 4,096 for each node, and 1,024 watched applications on each other node. Further monitors are rejected. An application in its own process cannot set monitors, and neither can a guest. A `Down` that a mailbox rejects is sent as soon as there is room, and counts as a monitor until it is accepted. |
//! | MON-7 | The node remembers the ends of the last 1,024 applications that were removed, and separately of the last 256 guests. |
//! | MON-8 | A watcher receives 256 reports of a missing application or an unknown node at once, then one every 10 ms. A delayed report counts as a monitor. |

mod core;
#[cfg(feature = "fuzzing")]
pub mod fuzzing;
mod protocol;
mod shell;
#[cfg(test)]
mod tests;

pub use core::{Core, Input};
pub use shell::{change, drain, feed, feed_deferred, has_outputs, next_wake, receive};
