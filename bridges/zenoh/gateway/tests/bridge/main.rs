//! A node, a router, the bridge and Zenoh programs, over loopback. Without the program of the router the tests are
//! skipped and report it.
//!
//! ```sh
//! cargo build --manifest-path bridges/zenoh/Cargo.toml -p sinew-zenoh      # the router
//! cargo test --manifest-path bridges/zenoh/Cargo.toml -p sinew-zenoh-bridge
//! ```
//!
//! The test with the Zenoh of PyPI uses `SINEW_PYTHON`, or `python3`.

mod access;
mod command;
mod liveness;
mod passing;
mod protection;
mod python;
mod refusals;
mod stage;
