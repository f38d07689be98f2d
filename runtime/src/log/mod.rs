//! The runtime's own log, through a bounded queue and a thread of its own, so that a blocked log blocks no
//! other thread. Entries that do not fit are dropped and counted.
//!
//! The macros here are those of `tracing`. An event is recorded where it occurs. Later, on the log thread, it
//! is given to the subscriber of the recording thread. Its time is that of the writing, and it is in no span.
//!
//! Where the program has installed no subscriber, lines on the standard error are the default: see `stderr`.

mod event;
mod filter;
mod observer;
mod stderr;
mod target;
mod writer;

pub(crate) use event::now;
#[doc(hidden)]
pub use event::{apart, here, is_on};
pub(crate) use observer::show;
pub use observer::{LogObserver, observe};
pub use stderr::set_level;
pub(crate) use stderr::{Line, is_replaced, write_text};
#[doc(hidden)]
pub use target::target;
pub(crate) use writer::enqueue;
pub use writer::{begin, flush, lost, print};

#[doc(hidden)]
pub use tracing;

/// Logs an error: a failure that needs attention.
#[macro_export]
#[doc(hidden)]
macro_rules! log_error {
    (target: $($args:tt)*) => { $crate::log_apart!(ERROR, $crate::log::tracing::error!(target: $($args)*)) };
    ($($args:tt)*) => { $crate::log_apart!(ERROR, $crate::log::tracing::error!(target: $crate::log::target(module_path!()), $($args)*)) };
}

/// Logs a warning: a deviation after which operation continues.
#[macro_export]
#[doc(hidden)]
macro_rules! log_warn {
    (target: $($args:tt)*) => { $crate::log_apart!(WARN, $crate::log::tracing::warn!(target: $($args)*)) };
    ($($args:tt)*) => { $crate::log_apart!(WARN, $crate::log::tracing::warn!(target: $crate::log::target(module_path!()), $($args)*)) };
}

/// Logs a rare event that is in order.
#[macro_export]
#[doc(hidden)]
macro_rules! log_info {
    (target: $($args:tt)*) => { $crate::log_apart!(INFO, $crate::log::tracing::info!(target: $($args)*)) };
    ($($args:tt)*) => { $crate::log_apart!(INFO, $crate::log::tracing::info!(target: $crate::log::target(module_path!()), $($args)*)) };
}

/// Logs an event for fault analysis.
#[macro_export]
#[doc(hidden)]
macro_rules! log_debug {
    (target: $($args:tt)*) => { $crate::log_apart!(DEBUG, $crate::log::tracing::debug!(target: $($args)*)) };
    ($($args:tt)*) => { $crate::log_apart!(DEBUG, $crate::log::tracing::debug!(target: $crate::log::target(module_path!()), $($args)*)) };
}

/// Logs an event for very detailed analysis.
#[macro_export]
#[doc(hidden)]
macro_rules! log_trace {
    (target: $($args:tt)*) => { $crate::log_apart!(TRACE, $crate::log::tracing::trace!(target: $($args)*)) };
    ($($args:tt)*) => { $crate::log_apart!(TRACE, $crate::log::tracing::trace!(target: $crate::log::target(module_path!()), $($args)*)) };
}

/// Logs an event of this level, if events of this level have a reader.
#[macro_export]
#[doc(hidden)]
macro_rules! log_apart {
    ($level:ident, $event:expr) => {
        if $crate::log::is_on($crate::log::tracing::Level::$level) {
            $crate::log::apart(|| $event);
        }
    };
}

/// Same as the above, but the program's subscriber is called on the calling thread: `log::here!(warn: %peer, "...")`.
#[macro_export]
#[doc(hidden)]
macro_rules! log_here {
    (error: target: $($args:tt)*) => { $crate::log_here!(ERROR, $crate::log::tracing::error!(target: $($args)*)) };
    (error: $($args:tt)*) => { $crate::log_here!(ERROR, $crate::log::tracing::error!(target: $crate::log::target(module_path!()), $($args)*)) };
    (warn: target: $($args:tt)*) => { $crate::log_here!(WARN, $crate::log::tracing::warn!(target: $($args)*)) };
    (warn: $($args:tt)*) => { $crate::log_here!(WARN, $crate::log::tracing::warn!(target: $crate::log::target(module_path!()), $($args)*)) };
    (info: target: $($args:tt)*) => { $crate::log_here!(INFO, $crate::log::tracing::info!(target: $($args)*)) };
    (info: $($args:tt)*) => { $crate::log_here!(INFO, $crate::log::tracing::info!(target: $crate::log::target(module_path!()), $($args)*)) };
    (debug: target: $($args:tt)*) => { $crate::log_here!(DEBUG, $crate::log::tracing::debug!(target: $($args)*)) };
    (debug: $($args:tt)*) => { $crate::log_here!(DEBUG, $crate::log::tracing::debug!(target: $crate::log::target(module_path!()), $($args)*)) };
    ($level:ident, $event:expr) => {
        if $crate::log::is_on($crate::log::tracing::Level::$level) {
            $crate::log::here(|| $event);
        }
    };
}

pub use crate::{
    log_debug as debug, log_error as error, log_here as here, log_info as info, log_trace as trace,
    log_warn as warn,
};
