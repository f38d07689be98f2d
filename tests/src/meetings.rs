//! Four nodes, each a process, that start in any order, meet at a barrier again and again, and are killed.
//!
//! Everybody writes down when it started, arrived and went on, by the clock that all processes of a host share; a judge reads it.

mod director;
pub mod figures;
mod node;
mod verdict;

pub use director::{Cast, PARTIES, permutations};
pub use node::play;
pub use verdict::{Event, Verdict};
