//! Linux: sealed memfds, futexes, eventfds.

mod bells;
mod mapping;
mod memfd;
mod passing;
#[cfg(test)]
mod tests;

pub(crate) use bells::{bell_pair, button};
pub(crate) use mapping::{OwnHeaderMemory, OwnMemory, OwnRingMemory, PeerMemory};
pub(crate) use memfd::{adopt, create};
pub(crate) use passing::{receive, send};
