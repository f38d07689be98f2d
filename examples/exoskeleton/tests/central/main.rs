//! Central: what it does about an e-stop, a loss, a drive that does not help, and a host that stands still.

mod hiccup;
mod losses;
mod walk;

/// Nanoseconds in a millisecond.
const MS: u64 = 1_000_000;
