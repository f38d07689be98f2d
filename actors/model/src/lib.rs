//! The types and services that all layers of Sinew share. Programs use it through the package `sinew`.
//!
//! | module | content |
//! | --- | --- |
//! | [`context`] | the state that all layers of one node share |
//! | [`ports`] | the traits by which layers call each other |
//! | [`config`] | the configuration of a node |
//! | [`contracts`] | the contracts of a whole system, and the check that they close |
//! | [`clocks`] | the clock offsets of other nodes |
//! | [`directory`] | the directory of names, and the applications that wait for names |
//! | [`events`], [`event_backlog`], [`app_backlog`] | the event queues of the layers, and the backlogs of events for full ones |
//! | [`app_notifier`], [`room_notifier`] | events for applications, which wait while a mailbox is full |
//! | [`address`] | addresses of this host and of others |
//! | [`barrier`] | the payloads of run-time barriers |
//! | [`guest_quotas`] | quotas of guests in the queues of the layers |
//! | [`periodic_checks`] | periodic checks, only while there is something to check |
//! | [`notifications`] | makes a restarted layer the only waiter for its notifications |
//! | [`bounded`] | lists from outside, with a limit |
//! | [`cause`] | how an application ended |
//! | [`rejections`], [`undelivered`] | reasons of rejections, and reports of them, as they travel |
//! | [`progress`] | the stalled parts of a node |
//! | [`facts`] | the notifications between layers |
//! | [`leave_reason`] | why a node gave up |
//! | [`limits`] | limits that several layers share |
//! | [`nearest`] | names that are similar to one that does not exist |
//! | [`rate_limiter`] | rate limits, of one source and of many |
//! | [`accept_limiter`], [`log_quotas`], [`refusals`] | limits and counts of the effects that unauthenticated peers can cause |
//! | [`thread_priority`] | threads with a lower priority than those that carry messages |

pub mod accept_limiter;
pub mod address;
pub mod app_backlog;
pub mod app_notifier;
pub mod barrier;
pub mod bounded;
pub mod cause;
pub mod clocks;
pub mod config;
pub mod context;
pub mod contracts;
pub mod directory;
pub mod event_backlog;
pub mod events;
pub mod facts;
pub mod guest_quotas;
pub mod leave_reason;
pub mod limits;
pub mod log_quotas;
pub mod nearest;
pub mod notifications;
pub mod periodic_checks;
pub mod ping;
pub mod ports;
pub mod progress;
pub mod rate_limiter;
pub mod refusals;
pub mod rejections;
pub mod room_notifier;
pub mod thread_priority;
pub mod undelivered;
