//! Real GNCL actors over loopback, and peers that are written by hand, as another language's would be.

mod access;
mod audits;
mod bench;
mod cancels;
mod classes;
mod credit;
mod datagrams;
mod ends;
mod former_lives;
mod gone;
mod handshakes;
mod leaving;
mod links;
mod messages;
mod outcomes;
mod secured;
#[cfg(target_os = "linux")]
mod starved;
mod takeovers;
mod threads;
mod ticks;
