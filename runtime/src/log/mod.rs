//! What the runtime logs of itself: through a bounded queue and a thread of its own, so that a log which takes nothing stops
//! nobody. What does not fit is dropped and counted.
//!
//! The macros here are those of `tracing`. An event is taken down where it happens, and given to the subscriber that was
//! the thread's own there, later and on the log's thread: its time is when it is written, and it stands in no span.
//!
//! Where the program has installed no subscriber, lines on the standard error are the default: see `stderr`.

mod event;
mod filter;
mod stderr;
mod writer;

pub(crate) use event::now;
#[doc(hidden)]
pub use event::{apart, here, is_on};
pub use stderr::set_level;
pub(crate) use stderr::{Line, is_replaced, write_text};
pub(crate) use writer::enter;
pub use writer::{begin, flush, lost, print};

#[doc(hidden)]
pub use tracing;

/// An error: something failed and somebody should look at it.
#[macro_export]
#[doc(hidden)]
macro_rules! log_error {
    ($($said:tt)*) => { $crate::log_apart!(ERROR, $crate::log::tracing::error!($($said)*)) };
}

/// A warning: something is not as it should be, and things go on.
#[macro_export]
#[doc(hidden)]
macro_rules! log_warn {
    ($($said:tt)*) => { $crate::log_apart!(WARN, $crate::log::tracing::warn!($($said)*)) };
}

/// Something that happens seldom and is as it should be.
#[macro_export]
#[doc(hidden)]
macro_rules! log_info {
    ($($said:tt)*) => { $crate::log_apart!(INFO, $crate::log::tracing::info!($($said)*)) };
}

/// For who looks for a fault.
#[macro_export]
#[doc(hidden)]
macro_rules! log_debug {
    ($($said:tt)*) => { $crate::log_apart!(DEBUG, $crate::log::tracing::debug!($($said)*)) };
}

/// For who looks very closely.
#[macro_export]
#[doc(hidden)]
macro_rules! log_trace {
    ($($said:tt)*) => { $crate::log_apart!(TRACE, $crate::log::tracing::trace!($($said)*)) };
}

/// One event of this level, if anybody reads events of this level.
#[macro_export]
#[doc(hidden)]
macro_rules! log_apart {
    ($level:ident, $event:expr) => {
        if $crate::log::is_on($crate::log::tracing::Level::$level) {
            $crate::log::apart(|| $event);
        }
    };
}

/// The same of an event that the program's subscriber is told on the calling thread: `log::here!(warn: %peer, "...")`.
#[macro_export]
#[doc(hidden)]
macro_rules! log_here {
    (error: $($said:tt)*) => { $crate::log_here!(ERROR, $crate::log::tracing::error!($($said)*)) };
    (warn: $($said:tt)*) => { $crate::log_here!(WARN, $crate::log::tracing::warn!($($said)*)) };
    (info: $($said:tt)*) => { $crate::log_here!(INFO, $crate::log::tracing::info!($($said)*)) };
    (debug: $($said:tt)*) => { $crate::log_here!(DEBUG, $crate::log::tracing::debug!($($said)*)) };
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
