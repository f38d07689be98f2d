//! Sinew: an actor runtime for distributed control.

pub mod config;
mod gncl;
mod lncl;
mod ndl;
mod node;
mod refusals;
mod stores;
mod sync;

pub use ndl::{LossReason, NodeEvent};
pub use sync::{RequirementEvent, Waiting};
