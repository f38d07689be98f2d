//! Several hosts, each a network namespace that the test makes and removes; skipped, which is said, where that is not possible. One binary, one
//! module a theme.

mod addresses;
mod hosts;
mod ipv6;
mod lengths;
mod lossy;
mod seeds;
