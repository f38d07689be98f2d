//! The parts of the programs: configuration, and the session with a router.

pub mod config;
pub mod session;
pub mod tunnel;
