//! Supervision: every layer and every application is a supervised actor.

pub mod core;
#[cfg(test)]
mod core_tests;
mod ready;

pub use ready::{ReadyGate, ReadyPart};
