//! Whole nodes of this host. One binary, which is linked once; one module for each theme.

mod away;
mod black_channel;
mod clients;
mod contracts;
mod faults;
mod nodes;
mod processes;
mod recordings;
mod stop;
