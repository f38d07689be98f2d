//! End-to-end protection of commands: from the application that sends to the output that it moves, whatever lies between.
//!
//! Marked on the payload's type ([`Payload::PROTECTION`]): the sender's context, or its endpoint, puts each value
//! into an envelope, the receiver's lets nothing else through. Queues, rings, sockets, layers and networks between them
//! are a black channel, of which nothing is believed.
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
//! Modelled on IEC 61784-3 and AUTOSAR E2E; the mechanisms are theirs, and no certified level is claimed.
//!
//! The output belongs to a [`Guard`]. It is safe at first, live after [`Guard::arm`], and safe again, until it is armed again, once
//! something is wrong that the type's [`Protection`] does not bear. The watchdog is kept by a thread of its own, `safe-output`,
//! which needs no layer and no reactor, and has neither the CPUs nor the priority of whoever made the first guard. All outputs of a process share it: what makes one of them safe must be short.
//!
//! | file | what it is |
//! | --- | --- |
//! | `envelope` | the bytes |
//! | `sender` | counters and echoes of those who send |
//! | `receiver` | what is believed, and when the output has to be safe |
//! | `guard` | the output |
//! | `keeper` | the thread that makes outputs safe |
//! | `said` | what is said of that in the log |
//! | `ends` | both ends for an endpoint of NodeAPI |
//! | `raw` | all of that for types that are known at run time alone |

mod ends;
mod envelope;
#[cfg(any(test, feature = "fuzzing"))]
#[doc(hidden)]
pub mod fuzzing;
mod guard;
mod keeper;
#[doc(hidden)]
pub mod raw;
mod receiver;
mod said;
mod sender;
#[cfg(test)]
mod tests;

use std::time::Duration;

use serde::{Deserialize, Serialize};

pub use self::{
    ends::{Came, Ends, SealError},
    envelope::{DataId, OVERHEAD, Stamp, open, seal},
    guard::Guard,
};
pub(crate) use self::{guard::Guarded, receiver::Verdict, sender::Flows};
use crate::{
    time::Time,
    wire::{Class, Kind, Payload},
};

/// SCHED_FIFO priority of the thread that makes outputs safe: above all that controls. An application's own is below it, and the system must
/// grant it (`ulimit -r 99`, or CAP_SYS_NICE): where it does not, the thread has the highest that is granted, which the log says.
pub const SAFE_OUTPUT_PRIORITY: u8 = 90;

/// What a receiver of protected messages bears.
///
/// # Examples
///
/// ```
/// use sinew::{prelude::*, protection::Protection, serde::{Deserialize, Serialize}};
///
/// #[derive(Serialize, Deserialize)]
/// #[serde(crate = "sinew::serde")]
/// struct Torque { newton_metres: f32 }
///
/// impl Payload for Torque {
///     const NAME: &'static str = "demo.torque";
///     const CLASS: Class = Class::Stream;
///     /// One each 5 ms, of which no more than one in a row may be missing.
///     const PROTECTION: Option<Protection> =
///         Some(Protection { lost_max: 1, ..Protection::of_period(Duration::from_millis(5)) });
/// }
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Protection {
    /// Longest time from one good message to the next.
    pub within: Duration,
    /// Greatest age of a message: measured in the receiver's clock, from an echo that it sent to the moment at which the message that
    /// quotes it arrives. So it holds the echo's way, the time until the sender sends next, the message's way, and the echo's period.
    pub age_max: Duration,
    /// Messages that may be missing in a row.
    pub lost_max: u64,
    /// Bad ones that may be among the last 64; none of them is used.
    pub bad_max: u32,
    /// Good ones in a row before the output may be armed, at least 1: none bad among them, and from one to the next less than `within`.
    pub good_min: u32,
}

impl Protection {
    /// For a message each `period`: two may be late or missing, one in 64 bad, and the output may be armed after eight good ones.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{prelude::*, protection::Protection};
    ///
    /// let bears = Protection::of_period(Duration::from_millis(5));
    /// assert_eq!(bears.within, Duration::from_millis(15));
    /// assert_eq!(bears.age_max, Duration::from_millis(40));
    /// ```
    #[must_use]
    pub const fn of_period(period: Duration) -> Self {
        let within = period.saturating_mul(3);
        let age_max = period.saturating_mul(8);
        Self { within, age_max, lost_max: 2, bad_max: 1, good_min: 8 }
    }

    /// Time between two echoes: a quarter of the greatest age.
    #[must_use]
    pub const fn echo_period(&self) -> Duration {
        Duration::from_nanos((self.age_max.as_nanos() / 4) as u64)
    }
}

/// Whether commands reach the output.
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
    /// They do.
    Live,
    /// They do not, since this; it stays so until the output is armed.
    Safe(Cause),
}

/// Why an output is safe.
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
    /// It was never armed.
    #[error("it was not armed yet")]
    NotArmed,
    /// No good message came in time.
    #[error("no good message came in time")]
    Silent,
    /// More messages are missing in a row than is borne.
    #[error("too many messages in a row are missing")]
    TooMuchLost,
    /// More bad messages came than is borne.
    #[error("too many bad messages came")]
    TooManyBad,
    /// The sender counts anew: it was restarted.
    #[error("the sender was restarted")]
    Restarted,
    /// The receiver's host has slept: how old commands are that came meanwhile is not known.
    #[error("the host has slept")]
    Slept,
    /// The receiver said so.
    #[error("the receiver tripped it")]
    Tripped,
    /// Nobody has the guard any more: its application has ended.
    #[error("the application that had it has ended")]
    Dropped,
}

/// What is wrong with a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Fault {
    /// Its bytes are not those that were sealed for this receiver by this sender: damaged, inserted, or meant for another.
    #[error("it is damaged, or was sealed by or for somebody else")]
    Corrupt,
    /// It quotes no time of this receiver's, or one that is too long ago.
    #[error("it is too old, or its sender has heard no echo yet")]
    TooOld,
    /// It has come before.
    #[error("it has come before")]
    Repeated,
    /// One that was sent later has come before it.
    #[error("one that was sent later came before it")]
    Backwards,
    /// Its sender counts anew.
    #[error("its sender was restarted")]
    Restarted,
    /// Too many before it are missing.
    #[error("too many before it are missing")]
    Gap,
    /// It is what was sealed, and no value of the receiver's type: its sender has another version of that.
    #[error("it is no value of the receiver's type, of which its sender has another version")]
    Unreadable,
}

/// Why an output cannot be armed.
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
    /// Too few good messages have come, or the last one too long ago.
    #[error(
        "{good} good messages in a row have come, the last one {silent:?} ago; wait for {wanted}, and for the next one to be in time"
    )]
    NotGood {
        /// Good messages in a row that have come, [`Protection::within`] apart at most.
        good: u32,
        /// How many must have come.
        wanted: u32,
        /// Time since the last one.
        silent: Duration,
    },
    /// What makes the output safe has panicked, or says that it has failed, and goes on to: whether it is safe is not known.
    #[error(
        "what makes the output safe has panicked, or says that it has failed, and is tried again; see the log"
    )]
    SafeFails,
}

/// What a receiver has counted.
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
    /// Good messages.
    pub good: u64,
    /// Those of [`Fault::Corrupt`].
    pub corrupt: u64,
    /// Those of [`Fault::TooOld`].
    pub too_old: u64,
    /// Those of [`Fault::Repeated`].
    pub repeated: u64,
    /// Those of [`Fault::Backwards`].
    pub backwards: u64,
    /// Those of [`Fault::Restarted`].
    pub restarted: u64,
    /// Those of [`Fault::Gap`].
    pub gaps: u64,
    /// Those of [`Fault::Unreadable`].
    pub unreadable: u64,
    /// Messages that are missing, by their numbers.
    pub lost: u64,
    /// How often the output went from live to safe.
    pub trips: u64,
}

impl Tally {
    const fn count(&mut self, fault: Fault) {
        let counter = match fault {
            Fault::Corrupt => &mut self.corrupt,
            Fault::TooOld => &mut self.too_old,
            Fault::Repeated => &mut self.repeated,
            Fault::Backwards => &mut self.backwards,
            Fault::Restarted => &mut self.restarted,
            Fault::Gap => &mut self.gaps,
            Fault::Unreadable => &mut self.unreadable,
        };
        *counter += 1;
    }
}

/// From a receiver of protected messages to their sender: to be quoted in the next one.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Echo {
    /// The type that is protected.
    pub(crate) kind: Kind,
    /// Nanoseconds of the receiver's clock.
    pub(crate) at_ns: u64,
    /// The same of the other types that it guards of this sender, as they were said last: of class Stream only the newest message may
    /// arrive, whichever type it is for.
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
