//! Command-line options that several programs have.

use clap::Args;

/// The seed of all random decisions of a program.
#[derive(Args, Clone, Copy, Debug)]
pub struct Seed {
    /// Random seed; a new one on each run by default.
    #[arg(long, default_value_t = u64::from(std::process::id()))]
    pub seed: u64,
}
