//! Supervision: every layer and every application is a supervised actor.

mod ready;

pub use ready::{ReadyGate, ReadyPart};
