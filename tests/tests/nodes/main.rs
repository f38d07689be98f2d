//! Whole nodes of this host, alone or a few, to which nothing bad happens but what one of them does itself. One binary, one module a theme.

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
mod root;
mod slow;
mod start_up;
mod trees;
mod undelivered;
