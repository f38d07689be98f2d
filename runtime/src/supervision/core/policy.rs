//! What a supervisor may do with its children: strategy, restart type, times, intensity.

use std::time::Duration;

/// Who is restarted when one child fails.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Strategy {
    /// That child alone.
    OneForOne,
    /// That child and those started after it.
    RestForOne,
    /// All children.
    OneForAll,
}

/// When a child that ended is started again.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Restart {
    /// Always.
    Permanent,
    /// Only if it failed.
    Transient,
    /// Never.
    Temporary,
}

/// What a supervisor may do with a child.
#[derive(Clone, Debug)]
pub struct Policy {
    /// When it is started again. Default [`Restart::Permanent`].
    pub restart: Restart,
    /// Time to become ready. Default 10 s.
    pub start_within: Duration,
    /// Time to stop before it is abandoned. Default 500 ms.
    pub stop_within: Duration,
    /// First wait before a restart; doubles with each failure in a row. Default 1 ms.
    pub backoff_min: Duration,
    /// Longest wait before a restart. Default 2 s.
    pub backoff_max: Duration,
    /// Longest time that one turn (a handler, a timer, `started`) may take before the actor counts as hung. Default 1 s;
    /// `None`: it may take as long as it likes.
    pub progress_within: Option<Duration>,
    /// Whether it waits for its release before its first start and after each failure. Default no.
    pub held: bool,
}

impl Default for Policy {
    fn default() -> Self {
        Self {
            restart: Restart::Permanent,
            start_within: Duration::from_secs(10),
            stop_within: Duration::from_millis(500),
            backoff_min: Duration::from_millis(1),
            backoff_max: Duration::from_secs(2),
            progress_within: Some(Duration::from_secs(1)),
            held: false,
        }
    }
}

/// How many restarts are too many.
#[derive(Clone, Copy, Debug)]
pub struct Intensity {
    /// Restarts allowed in one window; one more and the supervisor gives up.
    pub restarts_max: usize,
    /// The window.
    pub window: Duration,
}

impl Default for Intensity {
    fn default() -> Self {
        Self { restarts_max: 5, window: Duration::from_secs(10) }
    }
}
