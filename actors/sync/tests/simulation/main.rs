//! Simulations of the sync manager's core: many nodes, with accidents from a seed, on the kit `sinew-sim`.

#![expect(clippy::unwrap_used, reason = "a test says what failed by failing")]

mod barriers;
mod directory;
