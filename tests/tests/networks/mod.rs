//! Several hosts, each a network namespace that the test creates and removes; where that is not possible, the
//! tests are skipped and report it.

mod addresses;
mod hosts;
mod ipv6;
mod lengths;
mod lossy;
mod recordings;
mod seeds;
