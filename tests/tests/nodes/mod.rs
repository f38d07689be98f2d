//! Whole nodes of this host, alone or a few, without faults except those that a node causes itself.

mod access;
mod audits;
mod bad_input;
mod barriers;
mod directory;
mod healthy;
mod lives;
mod messages;
mod other_language;
mod phases;
mod retained;
mod root;
mod slow;
mod start_up;
mod threads;
mod trees;
mod types;
mod undelivered;
