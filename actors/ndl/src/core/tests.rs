//! Whole exchanges of cores on a simulated network, in virtual time.

mod address_claims;
mod address_conflicts;
mod authenticated;
mod endings;
mod incarnations;
mod liveness_hints;
mod paces;
mod properties;
mod remembered;
mod replayed;
mod routes;
mod scenarios;
mod several_addresses;
mod troubles;
mod world;

use sinew_sim::Seeds;

/// Returns the seeds of a test. `SINEW_NDL_SEEDS` sets their number, and `SINEW_NDL_SEED` replays one.
const fn seeds(test: &'static str, count: u64) -> Seeds {
    Seeds { variable: "SINEW_NDL_SEED", package: "sinew-ndl", target: "--lib", test, count }
}
