//! Nodes of a project of the tests' own, their handshakes in memory, and what is refused in them.

pub(crate) mod ground;

mod files;
mod handshakes;
mod strangers;
