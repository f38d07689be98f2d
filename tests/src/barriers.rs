//! Four node processes that start in any order, meet at a barrier repeatedly, and are killed.
//!
//! Each process records the times at which it started, arrived and continued, on the clock that all processes
//! of a host share. A judge evaluates the records.

pub mod figures;
mod node;
mod parties;
mod verdict;

pub(crate) use node::run as run_party;
pub use parties::{PARTIES, Scenario, permutations};
pub use verdict::{Event, Verdict};
