//! Stalls of a host, and whether the host or the measured program itself caused them.

mod blame;
mod cpu;
mod witness;

pub use blame::{Evidence, HostStall, merged};
pub use cpu::{CpuTimes, HostCpu, process_seconds};
pub use witness::{CpuStall, LATE_MAX, Testimony, Witness, sleep_until};
