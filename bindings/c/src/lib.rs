//! NodeAPI for C and C++. What it promises is said in `include/sinew.h`, which is written from this source, and in
//! `README.md`.
//!
//! | file | what is there |
//! | --- | --- |
//! | `border.rs` | what every call passes: panics are caught, errors become a number and a sentence, NULL is refused |
//! | `table.rs` | handles: numbers that are looked up, never followed; one thread at a time |
//! | `session.rs`, `hand.rs` | an endpoint with the messages that the program in C has in hand |
//! | `fork.rs` | a child of `fork` is told apart |
//! | `log.rs`, `log/` | what the library says on the standard error, and the thread that writes it |
//! | `protection.rs`, `protection/` | protected payloads: their types, and the runtime's guards behind handles |
//! | `registration.rs`, `sending.rs`, `receiving.rs`, `meeting.rs`, `sealing.rs`, `guarding.rs`, `naming.rs`, `words.rs` | the functions |
//! | `payload.rs`, `payload/` | typed payloads: a C struct as MessagePack, by a table of its fields |
//! | `options.rs`, `text.rs`, `message.rs`, `status.rs` | the types |
//! | `conformance.rs` | for the suite that holds all forms of NodeAPI to the same claims; with the feature `conformance` alone |
//!
//! All other modules are private: the functions are reached through C only, whose programs must keep what the header asks of
//! every pointer. That is the one thing that the unsafe blocks here stand on; what can be checked is checked.

// In this order the functions stand in the header.
mod registration;

mod naming;

mod sending;

mod receiving;

mod payload;

mod meeting;

mod sealing;

mod guarding;

mod words;

mod options;

mod message;

mod protection;

mod text;

mod status;

mod border;
#[cfg(feature = "conformance")]
pub mod conformance;
mod fork;
mod hand;
mod log;
mod session;
mod table;
