//! Three hosts, each on a network of its own, that reach each other through two routers alone. Where hosts
//! cannot be made, or the nodes' program is not built, the tests are skipped and report it.
//!
//! ```sh
//! cargo build -p sinew-tests                                           # in the main workspace: the nodes
//! cargo test --manifest-path bridges/zenoh/Cargo.toml --test routers   # as root
//! ```
//!
//! `SINEW_PROGRAMS` names another folder with the program `scenarios`. `SINEW_FAULTS=160 SINEW_RATE=2500` runs
//! the long form of `history`: 100,000 confirmed messages, a fault each 5 s.
//!
//! `SINEW_HOSTS=30 .. --test routers -- --ignored --nocapture` prints the cost of a host among 30.

mod cost;
mod history;
mod losses;
mod site;
