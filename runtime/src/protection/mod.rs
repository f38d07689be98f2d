//! End-to-end protection of commands, from the sending application to the controlled output, independent of
//! the channel between them.
//!
//! A payload's type declares it ([`Payload::PROTECTION`]). The sender's context, or its endpoint, seals each
//! value in an envelope; the receiver's accepts nothing else. Queues, rings, sockets, layers and networks
//! between them are a black channel, which is not trusted.
//!
//! | error | counter | watchdog | age by echo | data ID | CRC-64 |
//! | --- | --- | --- | --- | --- | --- |
//! | corruption | | | | | x |
//! | unintended repetition | x | | | | |
//! | wrong sequence | x | | | | |
//! | loss | x | x | | | |
//! | unacceptable delay | | x | x | | |
//! | insertion | x | | | x | x |
//! | masquerade | | | | x | x |
//! | wrong addressee | | | | x | x |
//!
//! Modelled on IEC 61784-3 and AUTOSAR E2E; it uses their mechanisms, and no certified level is claimed.
//!
//! The output belongs to a [`Guard`]. It is safe at first, and live after [`Guard::arm`]. An error beyond the
//! limits of the type's [`Protection`] makes it safe again, until it is armed again. The watchdog runs on a
//! thread of its own, `safe-output`, which needs no layer and no reactor. That thread does not inherit the
//! CPUs or the priority of the thread that made the first guard. All outputs of a process share it: a safe
//! function must be short.
//!
//! | file | content |
//! | --- | --- |
//! | `envelope` | the bytes on the wire |
//! | `sender` | counters and echoes of the sending end |
//! | `receiver` | the checks of a message, and when the output must be safe |
//! | `guard` | the output |
//! | `safe_output` | the thread `safe-output`, which makes outputs safe |
//! | `overview` | the states of all outputs, for reports |
//! | `stop_latch` | the stop of the node, which its outputs read |
//! | `log_queue` | the log entries of that thread |
//! | `ends` | both ends for an endpoint of NodeAPI |
//! | `raw` | the same for types that are known at run time only |

mod ends;
mod envelope;
#[cfg(any(test, feature = "fuzzing"))]
#[doc(hidden)]
pub mod fuzzing;
mod guard;
mod log_queue;
mod overview;
#[doc(hidden)]
pub mod raw;
mod receiver;
mod safe_output;
mod sender;
mod stop_latch;
#[cfg(test)]
mod tests;

use std::time::Duration;

use serde::{Deserialize, Serialize};

pub use self::{
    ends::{Came, Ends, SealError},
    envelope::{DataId, OVERHEAD, Stamp, Unsealed, open, seal, unsealed},
    guard::Guard,
};
pub(crate) use self::{guard::Guarded, receiver::Verdict, sender::Flows};
#[doc(hidden)] // For a node: its reports, and its stop.
pub use self::{
    overview::{OutputState, StoppedOutputs, outputs, stopped_outputs},
    stop_latch::{Latched, StopLatch},
};
pub use crate::wire::Protection;
use crate::{
    time::Time,
    wire::{Class, Kind, Payload},
};

/// SCHED_FIFO priority of the thread that makes outputs safe, above all control threads. The priority of an
/// application must be lower. The system must grant it (`ulimit -r 99`, or CAP_SYS_NICE). Otherwise the
/// thread gets the highest priority that is granted, which is logged.
pub const SAFE_OUTPUT_PRIORITY: u8 = 90;

/// The state of an output: whether commands reach it.
///
/// # Examples
///
/// ```
/// use sinew::protection::{Cause, State};
///
/// fn lamp(state: State) -> &'static str {
///     match state {
///         State::Live => "green",
///         State::Safe(Cause::NotArmed) => "yellow",
///         State::Safe(_) => "red",
///     }
/// }
/// assert_eq!(lamp(State::Safe(Cause::Silent)), "red");
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum State {
    /// Commands reach the output.
    Live,
    /// Commands do not reach the output, for this cause, until it is armed again.
    Safe(Cause),
}

/// The cause for which an output is safe.
///
/// # Examples
///
/// ```
/// use sinew::protection::Cause;
///
/// assert_eq!(Cause::Silent.to_string(), "no good message came in time");
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Cause {
    /// The output was never armed.
    #[error("it was not armed yet")]
    NotArmed,
    /// No good message arrived in time.
    #[error("no good message came in time")]
    Silent,
    /// More consecutive messages are missing than the limit allows.
    #[error("too many messages in a row are missing")]
    TooMuchLost,
    /// More bad messages arrived than the limit allows.
    #[error("too many bad messages came")]
    TooManyBad,
    /// The sender was restarted: its counter starts again.
    #[error("the sender was restarted")]
    Restarted,
    /// The receiver's host has slept, so the age of commands that were in flight is unknown.
    #[error("the host has slept")]
    Slept,
    /// The receiver tripped the guard.
    #[error("the receiver tripped it")]
    Tripped,
    /// The guard has no owner any more: its application has ended.
    #[error("the application that had it has ended")]
    Dropped,
    /// The stop of the whole system was pressed.
    #[error("the stop was pressed")]
    Stopped,
}

/// The fault of a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ProtectionError {
    /// The bytes are not those that this sender sealed for this receiver: they are corrupted, inserted, or
    /// for another receiver.
    #[error("it is damaged, or was sealed under another data ID")]
    Corrupt,
    /// The message quotes no echo of this receiver, or one that is too old.
    #[error("it is too old, or its sender has received no echo yet")]
    TooOld,
    /// The message was received before.
    #[error("it was received before")]
    Repeated,
    /// A message that was sent later was received before it.
    #[error("a message that was sent later was received before it")]
    Backwards,
    /// The sender was restarted.
    #[error("its sender was restarted")]
    Restarted,
    /// Too many messages before this one are missing.
    #[error("too many before it are missing")]
    Gap,
    /// The message is intact, but no valid value of the receiver's type: its sender has another version of the type.
    #[error("it is no value of the receiver's type, of which its sender has another version")]
    Unreadable,
}

/// The reason why an output cannot be armed.
///
/// # Examples
///
/// ```
/// use sinew::protection::{ArmError, Guard};
///
/// /// Arms the output as soon as enough good commands have come.
/// fn arm<O: Send>(guard: &Guard<O>) -> Result<bool, ArmError> {
///     match guard.arm() {
///         Ok(()) => Ok(true),
///         Err(ArmError::NotGood { .. }) => Ok(false), // try again with the next command
///         Err(other) => Err(other),
///     }
/// }
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ArmError {
    /// Too few good messages have arrived, or the last one too long ago.
    #[error(
        "{good} good messages in a row were received{}; wait for {wanted}, and for the next one to be in time",
        .silent.map_or_else(String::new, |silent| format!(", the last one {silent:.1?} ago"))
    )]
    NotGood {
        /// Consecutive good messages that have arrived, at most [`Protection::within`] apart.
        good: u32,
        /// Good messages that are required.
        wanted: u32,
        /// Time since the last one of them; `None` if there is none.
        silent: Option<Duration>,
    },
    /// The safe function has panicked or reported a failure, and still does: whether the output is safe is unknown.
    #[error("the output's safe function panicked or failed, and is retried; see the log")]
    SafeFails,
    /// The stop of the whole system is in force, its state is not known yet, or it was released and the application has
    /// not acknowledged it.
    #[error(
        "the system is stopped, or this node does not know yet that it is not (`sinew stop status`), or the stop is released and not acknowledged \
         (`Guard::acknowledge_stop`)"
    )]
    Stopped,
}

/// The counters of a receiver.
///
/// # Examples
///
/// ```
/// use sinew::protection::Guard;
///
/// fn report<O: Send>(guard: &Guard<O>) {
///     let tally = guard.tally();
///     println!("{} good, {} lost, {} trips", tally.good, tally.lost, tally.trips);
/// }
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Tally {
    /// Number of good messages.
    pub good: u64,
    /// Number of messages with [`ProtectionError::Corrupt`].
    pub corrupt: u64,
    /// Number of messages with [`ProtectionError::TooOld`].
    pub too_old: u64,
    /// Number of messages with [`ProtectionError::Repeated`].
    pub repeated: u64,
    /// Number of messages with [`ProtectionError::Backwards`].
    pub backwards: u64,
    /// Number of messages with [`ProtectionError::Restarted`].
    pub restarted: u64,
    /// Number of messages with [`ProtectionError::Gap`].
    pub gaps: u64,
    /// Number of messages with [`ProtectionError::Unreadable`].
    pub unreadable: u64,
    /// Number of missing messages, according to the counters.
    pub lost: u64,
    /// Number of changes of the output from live to safe.
    pub trips: u64,
}

impl Tally {
    const fn count(&mut self, fault: ProtectionError) {
        let counter = match fault {
            ProtectionError::Corrupt => &mut self.corrupt,
            ProtectionError::TooOld => &mut self.too_old,
            ProtectionError::Repeated => &mut self.repeated,
            ProtectionError::Backwards => &mut self.backwards,
            ProtectionError::Restarted => &mut self.restarted,
            ProtectionError::Gap => &mut self.gaps,
            ProtectionError::Unreadable => &mut self.unreadable,
        };
        *counter += 1;
    }
}

/// An echo, sent by a receiver of protected messages to their sender, which quotes it in its next message.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Echo {
    /// The protected type.
    pub(crate) kind: Kind,
    /// Nanoseconds of the receiver's clock.
    pub(crate) at_ns: u64,
    /// The last echoes of the other types that it guards for this sender. Of class Stream only the newest
    /// message may arrive, for any of the types.
    #[serde(default)]
    pub(crate) others: Vec<(Kind, u64)>,
}

impl Payload for Echo {
    const NAME: &'static str = "sinew.echo";
    const CLASS: Class = Class::Stream;
}

impl Echo {
    pub(crate) const fn new(kind: Kind, at: Time) -> Self {
        Self { kind, at_ns: at.as_nanos(), others: Vec::new() }
    }
}
