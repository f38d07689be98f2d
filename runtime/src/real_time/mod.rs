//! Proof of real time: the rights of a process, and how late its threads wake.
//!
//! [`HostRights`] reads the rights from the files of the kernel. [`probe`] measures the lateness of the calling thread.
//! A node does both once after its start, and `sinew doctor --rt` does both on request.

mod lateness;
mod probe;
mod rights;

pub use lateness::{Band, Lateness, LatenessSummary};
pub use probe::{Plan, Probe, probe};
pub use rights::{Budget, HostRights, Locked, Preemption, Refusal};
