//! The runtime of Sinew's actors: addresses, messages, mailboxes, supervision, time.
//!
//! This crate depends on no layer and no socket. Read it in this order:
//!
//! | module | content |
//! | --- | --- |
//! | [`tid`] | the 64-bit transport ID |
//! | [`time`], [`clock`] | nanoseconds of the monotonic clock; the clock of an application, which a test may move |
//! | [`wire`] | header, payload, frames |
//! | [`outcome`] | outcomes of confirmed messages |
//! | [`undelivered`] | unconfirmed messages that were rejected |
//! | [`router`] | the routing table, which senders read without a lock |
//! | [`event_queue`] | event queues of actors, which outlive the actors |
//! | [`mailbox`] | message queues of applications, which outlive the applications |
//! | [`monitor`] | notifications of the end of an application |
//! | [`wakes`], [`WakerList`] | one wake for a batch of messages; the tasks that wait for one event |
//! | [`remedy`] | remedies for failed system calls |
//! | [`safe_wake`] | wakes from threads without usable thread-local variables |
//! | [`pending`], [`sender`] | sending, and waiting for outcomes and replies |
//! | [`protection`] | end-to-end protection of commands, and outputs that are safe without them |
//! | [`schedule`] | the timers of an actor |
//! | [`app`] | applications |
//! | [`parameters`] | values of an application that are tuned while it runs |
//! | [`timer`], [`alarm`] | the kernel's timer, exact to microseconds; a task that it wakes |
//! | [`supervision`] | starts, restarts and failures of actors |
//! | [`real_time`] | the real-time rights of a process, and how late its threads wake |
//! | [`lock`] | locks that survive the panic of their holder |
//! | [`log`] | the log of the runtime, which never waits for its reader |
//! | [`incident`] | faults around which nodes freeze their recordings |

#[cfg_attr(not(target_os = "linux"), path = "alarm_elsewhere.rs")]
pub mod alarm;
pub mod app;
pub mod clock;
pub mod event_queue;
#[cfg(feature = "fuzzing")]
#[doc(hidden)]
pub mod fuzzing;
pub mod incident;
mod locking;
pub mod log;
pub mod mailbox;
pub mod monitor;
pub mod name;
mod observers;
pub mod outcome;
pub mod own_types;
pub mod pending;
pub mod protection;
pub mod real_time;
pub mod remedy;
pub mod router;
pub mod safe_wake;
pub mod schedule;
pub mod sender;
pub mod stop;
pub mod supervision;
mod thread;
pub mod tid;
pub mod time;
// A timerfd; `alarm` replaces it on other systems.
#[cfg(target_os = "linux")]
pub mod timer;
pub mod undelivered;
mod waker_list;
pub mod wakes;
pub mod wire;

pub use locking::lock;
pub use sinew_params as parameters;
pub use waker_list::WakerList;
