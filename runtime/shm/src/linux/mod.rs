//! Linux: sealed memfds, futexes, eventfds.

mod bells;
mod futex_set;
mod mapping;
mod memfd;
mod passing;
mod rights;
#[cfg(all(test, not(loom)))]
mod tests;

pub(crate) use bells::{Announcement, Buttons, SharedPage, bells, buttons, which_ended};
pub(crate) use futex_set::{FutexSet, sleep_at};
pub use mapping::{Counters, PeerCounters};
pub(crate) use mapping::{OwnHeaderMemory, OwnMemory, OwnRingMemory, PeerMemory};
pub(crate) use memfd::{adopt, create};
pub(crate) use passing::{receive, send};
pub(crate) use rights::{keep_urgent_in_line, peer_pidfd, set_descriptors};
