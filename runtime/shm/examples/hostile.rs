//! Hostile.
fn main() {}
