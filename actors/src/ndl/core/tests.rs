//! Whole conversations of cores on a simulated network, in virtual time.

mod contests;
mod duplicates;
mod endings;
mod lives;
mod memory;
mod paces;
mod properties;
mod proven;
mod replayed;
mod routes;
mod scenarios;
mod several_addresses;
mod signs;
mod troubles;
mod world;
