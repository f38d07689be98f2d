//! Real GNCL actors over loopback, and handwritten peers, as in another language.

mod access;
mod audits;
mod bench;
mod cancels;
mod classes;
mod credit;
mod datagrams;
mod departed;
mod former_incarnations;
mod handshakes;
mod leaving;
mod links;
mod messages;
mod node_down_events;
mod outcomes;
mod periodic_checks;
mod restarts;
mod secured;
#[cfg(target_os = "linux")]
mod starved;
mod threads;
