//! Whole conversations of cores on a simulated network, in virtual time.

mod scenarios;
mod world;
