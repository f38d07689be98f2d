//! Central: its reaction to an e-stop, a loss, a drive that does not assist, and a host that stands still.

mod hiccup;
mod losses;
mod walk;

/// Nanoseconds in a millisecond.
const MS: u64 = 1_000_000;
