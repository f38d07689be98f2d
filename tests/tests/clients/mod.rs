//! Processes that connect to a node through its client socket: killed, stopped, hostile. One module for each
//! claim.

mod conservation;
mod crowd;
mod direct;
mod hostile;
mod idle;
mod kills;
mod namespaces;
mod stopped;
