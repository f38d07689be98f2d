//! Sinew: an actor runtime for distributed control.

pub mod api;
pub mod config;
mod gncl;
mod lncl;
mod ndl;
mod node;
mod outlet;
mod refusals;
mod stores;
mod sync;

pub use lncl::RegisterError;
pub use ndl::{LossReason, NodeEvent};
pub use sync::{RequirementEvent, Waiting};
