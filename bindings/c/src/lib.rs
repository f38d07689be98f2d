//! NodeAPI for C and C++. Its contract is in `include/sinew.h`, which is generated from this source, and in
//! `README.md`.
//!
//! | file | contents |
//! | --- | --- |
//! | `ffi_boundary.rs` | the wrapper of every call: catches panics, turns errors into a number and a sentence, rejects NULL |
//! | `table.rs` | handles: numbers that are looked up, never dereferenced; one thread at a time |
//! | `session.rs`, `handles.rs` | an endpoint with the messages that the program in C holds |
//! | `fork.rs` | detects a child of `fork` |
//! | `log.rs`, `log/` | the library's log on the standard error, and the thread that writes it |
//! | `protection.rs`, `protection/` | protected payloads: their types, and the runtime's guards behind handles |
//! | `registration.rs`, `sending.rs`, `receiving.rs`, `meeting.rs`, `stopping.rs`, `naming.rs`, `outcome.rs` | the functions |
//! | `sealing.rs`, `guarding.rs` | the functions for protected payloads |
//! | `payload.rs`, `payload/` | typed payloads: a C struct as MessagePack, by a table of its fields |
//! | `options.rs`, `text.rs`, `message.rs`, `status.rs` | the types |
//! | `conformance.rs` | for the conformance suite of all forms of NodeAPI; with the feature `conformance` only |
//!
//! All other modules are private: the functions are called through C only. The unsafe blocks rely on one
//! thing: programs keep the header's requirements for every pointer. All other requirements are checked.

// The functions appear in the header in this order.
mod registration;

mod naming;

mod sending;

mod receiving;

mod payload;

mod meeting;

mod stopping;

mod sealing;

mod guarding;

mod outcome;

mod options;

mod message;

mod protection;

mod text;

mod status;

#[cfg(feature = "conformance")]
pub mod conformance;
mod ffi_boundary;
mod fork;
mod handles;
mod log;
mod session;
mod table;
