//! What makes Sinew's actors live: addresses, messages, mailboxes, supervision, time.
//!
//! This crate knows no layer and no socket. Read it in this order:
//!
//! | module | what it is |
//! | --- | --- |
//! | [`tid`] | who: the 64-bit transport ID |
//! | [`time`] | when: nanoseconds of the monotonic clock |
//! | [`wire`] | what: header, payload, frames |
//! | [`outcome`] | and then: what became of a message |
//! | [`undelivered`] | unconfirmed messages that were refused |
//! | [`router`] | where to: the table that senders read without a lock |
//! | [`post`] | events into an actor that outlive it |
//! | [`mailbox`] | messages into an application that outlive it |
//! | [`monitor`] | who is told of an end |
//! | [`wakes`] | one wake for a batch of messages |
//! | [`pending`], [`sender`] | sending, and waiting for what comes of it |
//! | [`protection`] | end-to-end protection of commands, and outputs that are safe without them |
//! | [`schedule`] | what an actor does when |
//! | [`app`] | what an application is |
//! | [`timer`], [`alarm`] | the kernel's timer, exact to microseconds; a task that it wakes |
//! | [`supervision`] | who is started, when, and again after a fault |
//! | [`log`] | what the runtime says of itself, without waiting for who reads it |

#[cfg_attr(not(target_os = "linux"), path = "alarm_elsewhere.rs")]
pub mod alarm;
pub mod app;
pub mod log;
pub mod mailbox;
pub mod monitor;
pub mod outcome;
pub mod pending;
pub mod post;
pub mod protection;
pub mod router;
pub mod schedule;
#[cfg(test)]
mod seeded;
pub mod sender;
pub mod supervision;
pub mod tid;
pub mod time;
// A timerfd; `alarm` stands in for it elsewhere.
#[cfg(target_os = "linux")]
pub mod timer;
pub mod undelivered;
pub mod wakes;
pub mod wire;
