//! Why a replay did not reach its end.

use std::time::Duration;

use sinew_runtime::time::Time;

use crate::{FirstDifference, Misfit, TimedMessage};

/// A replay that did not reach its end.
///
/// # Examples
///
/// ```
/// use sinew::replay::{ReplayError, RunError};
///
/// fn report(error: &ReplayError) {
///     eprintln!("{error}; {} messages were sent before", error.outputs.len());
///     if let RunError::Panicked { app, .. } = &error.fault {
///         eprintln!("see the log for where {app} panicked");
///     }
/// }
/// ```
#[derive(Debug, thiserror::Error)]
#[error("at {at:?} of virtual time: {fault}")]
pub struct ReplayError {
    /// The virtual time.
    pub at: Time,
    /// The cause.
    pub fault: RunError,
    /// The outputs until then.
    pub outputs: Vec<TimedMessage>,
}

/// The cause for which a replay did not reach its end.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// An application panicked. A node would restart it; a replay ends, as no recording has the same restart.
    #[error("{app} panicked: {message}; the log has the place")]
    Panicked {
        /// The name of the application.
        app: String,
        /// The message of the panic.
        message: String,
    },
    /// An application ended, or its start failed.
    #[error("{app} ended: {why}; an application under test runs until the end of its replay")]
    Ended {
        /// The name of the application.
        app: String,
        /// The reason.
        why: String,
    },
    /// An application has work again and again without any progress of virtual time.
    #[error(
        "{app} never becomes idle: {rounds} turns at one virtual time; look for messages that it sends to itself, and for a future that wakes itself"
    )]
    NeverIdle {
        /// The name of the application that had the last turn.
        app: String,
        /// The number of turns.
        rounds: usize,
    },
    /// A turn of an application did not end. Its thread is given up.
    #[error(
        "a turn of {app} has not ended for {within:?} of real time; look for a wait or a loop without an end in its handlers"
    )]
    Blocked {
        /// The name of the application.
        app: String,
        /// Real time without the end of the turn.
        within: Duration,
    },
    /// The inputs are not in the order of their times.
    #[error("input {number} is at {at:?}, before the one at {before:?}; sort the inputs by time")]
    Unordered {
        /// The number of the input, from 1.
        number: u64,
        /// Its time.
        at: Time,
        /// The time of the input before it.
        before: Time,
    },
    /// Two applications under test have one name or one address.
    #[error(
        "two applications under test are called {0}, or have its address; give each its own by `Replay::name`"
    )]
    Twice(String),
    /// The system refuses the thread of the replay.
    #[error("no thread for the replay: {0}")]
    NoThread(std::io::Error),
}

/// A replay that differs from its recording, or did not reach its end.
#[derive(Debug, thiserror::Error)]
pub enum CheckError {
    /// The replay did not reach its end.
    #[error(transparent)]
    Replay(#[from] ReplayError),
    /// The replay differs.
    #[error(transparent)]
    Differs(#[from] FirstDifference),
    /// The replay differs, and an application under test could not decode recorded messages.
    #[error(
        "{0}. The first difference after that: {1}. Give new fields `#[serde(default)]`, or record again"
    )]
    Misfit(Box<Misfit>, Box<FirstDifference>),
}

/// The result of a check that found no difference.
///
/// # Examples
///
/// ```
/// use sinew::replay::Checked;
///
/// fn report(checked: &Checked) {
///     println!("identical: {} messages of {} sources", checked.messages, checked.sources);
///     checked.misfits.iter().for_each(|misfit| println!("{misfit}"));
/// }
/// ```
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Checked {
    /// The messages that were compared.
    pub messages: usize,
    /// The applications that sent them.
    pub sources: usize,
    /// Recorded messages that an application under test could not decode.
    pub misfits: Vec<Misfit>,
}
