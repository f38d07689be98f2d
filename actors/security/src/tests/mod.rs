//! Nodes of a test project, their handshakes in memory, and the rejected ones.

mod files;
mod handshakes;
mod unauthenticated;
