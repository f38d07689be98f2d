//! Processes that speak to a node through its door: killed, stopped, hostile. One binary, one module a claim.

mod conservation;
mod crowd;
mod direct;
mod hostile;
mod idle;
mod kills;
mod namespaces;
mod stopped;
