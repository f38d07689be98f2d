//! Protected payloads: commands that are checked end to end, and outputs that are safe without them. The
//! runtime (`sinew_runtime::protection`) has the rules for C as for Rust: which messages are accepted, when an output
//! has to be safe, and which thread makes it so. Here are the types and handles of C.
//!
//! | file | contents |
//! | --- | --- |
//! | `guards.rs` | guards with pointers as outputs, and their handles |
//! | `watchdog.rs` | starts the threads that make outputs safe, for a process in C |
//! | `names.rs` | names of types, kept until the process ends |

pub(crate) mod guards;
pub(crate) mod names;
mod watchdog;

use std::{ffi::c_void, time::Duration};

use sinew_runtime::{
    protection::{
        Cause, OVERHEAD, Protection, ProtectionError as Wrong, State,
        raw::{Protected, Reads},
    },
    wire::Kind,
};

pub(crate) use sinew_runtime::protection::Ends;

use crate::{message::TidBits, status::CallError, text::Text};

/// Bytes before the payload of a sealed message.
pub const SINEW_SEALED_HEAD: usize = 32;
/// Bytes that sealing adds to a payload: 32 before it and 8 behind it.
pub const SINEW_SEALED_OVERHEAD: usize = 40;

const _: () = assert!(SINEW_SEALED_OVERHEAD == OVERHEAD, "the envelope is that of Rust");

/// A type of protected payloads: its name, and the limits of the receiver. Both ends use the same one, best
/// from a shared header; in Rust it is `Payload::NAME` and `Payload::PROTECTION`. `sinew_protected_type_of`
/// fills all of it.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub struct ProtectedType {
    /// The name, at least 1 byte.
    pub name: Text,
    /// Length of each payload in bytes, `sizeof` of a plain struct: a payload of another length is not sent,
    /// and counts as bad when it arrives. 0: any length. A guard checks nothing else of a payload: if you
    /// cannot read one that came through, call `sinew_trip`, or such payloads keep the output live forever.
    pub length: usize,
    /// Maximum time between two good messages, above 0; after it the output is made safe.
    pub within_ns: u64,
    /// Maximum age of a message, at least 4 ns: from an echo that the receiver has sent to the arrival of the
    /// message that quotes it.
    pub age_max_ns: u64,
    /// Maximum number of consecutive missing messages.
    pub lost_max: u64,
    /// Maximum number of bad messages among the last 64; none of them is used.
    pub bad_max: u32,
    /// Number of consecutive good messages before the output may be armed, at least 1.
    pub good_min: u32,
    /// One of `sinew_message_class`, for the sender. With `SINEW_STREAM` only the newest one may arrive: the
    /// messages that it replaces count as missing.
    pub message_class: i32,
    /// Zero.
    pub reserved: u32,
}

/// Identifies a flow of protected messages at both of its ends. It is not sent: any other receiver computes
/// another checksum.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub struct DataId {
    /// The sender: its whole TID, the node's address included.
    pub source: TidBits,
    /// The receiver, in the same form; one application.
    pub destination: TidBits,
    /// Name of the payload's type.
    pub name: Text,
}

/// The sender's data in one protected message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(C)]
pub struct Stamp {
    /// Counts the messages of the flow, from 1.
    pub counter: u64,
    /// The sender's incarnation, never the same one twice. `sinew_now_ns` at its start is sufficient.
    pub incarnation: u64,
    /// The newest time that the sender has received from the receiver (`sinew_guard_echo`); 0 for none.
    pub echo_ns: u64,
}

/// Whether commands reach an output and, if not, the cause.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(i32)]
#[allow(clippy::enum_variant_names, reason = "these are the names in C, which has no other name spaces")]
pub enum OutputState {
    /// Commands reach the output.
    SinewLive = 0,
    /// It was never armed.
    SinewSafeNotArmed = 1,
    /// No good message arrived in time.
    SinewSafeSilent = 2,
    /// More consecutive messages are missing than `lost_max`.
    SinewSafeTooMuchLost = 3,
    /// More bad messages arrived than `bad_max`.
    SinewSafeTooManyBad = 4,
    /// The sender counts from a new start: it was restarted.
    SinewSafeRestarted = 5,
    /// The receiver's host was suspended: the age of the commands that arrived meanwhile is not known.
    SinewSafeSlept = 6,
    /// `sinew_trip` was called, or the guard's endpoint was unregistered.
    SinewSafeTripped = 7,
    /// The guard is being released.
    SinewSafeReleased = 8,
}

/// The fault of a protected message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(i32)]
#[allow(clippy::enum_variant_names, reason = "these are the names in C, which has no other name spaces")]
pub enum SealedFault {
    /// None.
    SinewFaultNone = 0,
    /// Its bytes are not those that this sender sealed for this receiver: damaged, inserted, or meant for
    /// another receiver.
    SinewFaultCorrupt = 1,
    /// It quotes no time of this receiver, or one that is too long ago.
    SinewFaultTooOld = 2,
    /// It has arrived before.
    SinewFaultRepeated = 3,
    /// A message that was sent later has arrived before it.
    SinewFaultBackwards = 4,
    /// Its sender was restarted: its incarnation is not that of the last message.
    SinewFaultRestarted = 5,
    /// Too many messages before it are missing.
    SinewFaultGap = 6,
    /// The seal is valid, but the payload does not have the length of the type.
    SinewFaultUnreadable = 7,
}

/// The counts of a guard.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(C)]
pub struct Tally {
    /// Good messages.
    pub good: u64,
    /// Messages with `SINEW_FAULT_CORRUPT`.
    pub corrupt: u64,
    /// Messages with `SINEW_FAULT_TOO_OLD`.
    pub too_old: u64,
    /// Messages with `SINEW_FAULT_REPEATED`.
    pub repeated: u64,
    /// Messages with `SINEW_FAULT_BACKWARDS`.
    pub backwards: u64,
    /// Messages with `SINEW_FAULT_RESTARTED`.
    pub restarted: u64,
    /// Messages with `SINEW_FAULT_GAP`.
    pub gaps: u64,
    /// Messages with `SINEW_FAULT_UNREADABLE`.
    pub unreadable: u64,
    /// Missing messages, by their counters.
    pub lost: u64,
    /// Number of times that the output went from live to safe.
    pub trips: u64,
}

/// The only access to an output. Programs have only pointers to it.
#[derive(Debug)]
pub struct OutputGuard {
    _opaque: (),
}

/// Makes an output safe and returns 0. Any other result means failure; then it is called again each
/// millisecond. Any thread calls it, mostly one of the library's own: it must be short and must not wait, as
/// the outputs of all guards wait for it. It must return normally, by no exception and no `longjmp`. Of the
/// functions of a guard it may call only `sinew_trip` and `sinew_release_later`. It must not call
/// `sinew_receive_message` of an endpoint that sends or receives protected payloads: `SINEW_ERROR_BUSY`.
pub type MakeSafe = Option<unsafe extern "C" fn(output: *mut c_void, why: OutputState) -> i32>;

/// Moves an output that is live; `sinew_make_safe` waits meanwhile. It must return as `sinew_make_safe` does,
/// and soon, and may call no other functions than that.
pub type Command = Option<unsafe extern "C" fn(output: *mut c_void, argument: *mut c_void)>;

/// A [`ProtectedType`] that was checked.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Typed<'call> {
    pub(crate) name: &'call str,
    pub(crate) kind: Kind,
    pub(crate) length: usize,
    pub(crate) protection: Protection,
    pub(crate) message_class: i32,
}

impl ProtectedType {
    pub(crate) fn read(&self) -> Result<Typed<'_>, CallError> {
        let invalid = |sentence: &str| Err(CallError::argument(sentence));
        if self.reserved != 0 {
            return Err(CallError::argument(format!(
                "`payload_type.reserved` is {}: set it to 0",
                self.reserved
            )));
        }
        let name = self.name.read("payload_type.name")?;
        if name.is_empty() {
            return invalid("`payload_type.name` is empty");
        }
        if self.within_ns == 0 {
            return invalid(
                "`payload_type.within_ns` is 0: each message is late; take some periods of the sender's",
            );
        }
        let protection = Protection {
            within: Duration::from_nanos(self.within_ns),
            age_max: Duration::from_nanos(self.age_max_ns),
            lost_max: self.lost_max,
            bad_max: self.bad_max,
            good_min: self.good_min,
        };
        if protection.echo_period().is_zero() {
            return invalid(
                "`payload_type.age_max_ns` is below 4: each message is too old; take some periods of the sender's",
            );
        }
        if protection.good_min == 0 {
            return invalid(
                "`payload_type.good_min` is 0: an output is armed by good messages; take 1 at least",
            );
        }
        let (length, message_class) = (self.length, self.message_class);
        Ok(Typed { name, kind: Kind::named(name), length, protection, message_class })
    }
}

impl Typed<'_> {
    /// Converts to the runtime's type. `name` stays, and is this one's or that of the data ID that counts.
    pub(crate) const fn protected(&self, name: &'static str) -> Protected {
        let reads = match self.length {
            0 => Reads::Any,
            length => Reads::OfLength(length),
        };
        Protected { name, kind: self.kind, protection: self.protection, reads }
    }

    /// Checks the length of a payload to send.
    pub(crate) fn check_length(&self, length: usize) -> Result<(), CallError> {
        if self.length == 0 || self.length == length {
            return Ok(());
        }
        Err(CallError::argument(format!(
            "`length` is {length}, and each '{}' has {} bytes",
            self.name, self.length
        )))
    }
}

pub(crate) const fn code_of(state: State) -> OutputState {
    match state {
        State::Live => OutputState::SinewLive,
        State::Safe(cause) => match cause {
            Cause::NotArmed => OutputState::SinewSafeNotArmed,
            Cause::Silent => OutputState::SinewSafeSilent,
            Cause::TooMuchLost => OutputState::SinewSafeTooMuchLost,
            Cause::TooManyBad => OutputState::SinewSafeTooManyBad,
            Cause::Restarted => OutputState::SinewSafeRestarted,
            Cause::Slept => OutputState::SinewSafeSlept,
            // The stop of a node makes these outputs safe by their silence: they read no latch.
            Cause::Tripped | Cause::Stopped => OutputState::SinewSafeTripped,
            Cause::Dropped => OutputState::SinewSafeReleased,
        },
    }
}

impl From<Wrong> for SealedFault {
    fn from(wrong: Wrong) -> Self {
        match wrong {
            Wrong::Corrupt => Self::SinewFaultCorrupt,
            Wrong::TooOld => Self::SinewFaultTooOld,
            Wrong::Repeated => Self::SinewFaultRepeated,
            Wrong::Backwards => Self::SinewFaultBackwards,
            Wrong::Restarted => Self::SinewFaultRestarted,
            Wrong::Gap => Self::SinewFaultGap,
            Wrong::Unreadable => Self::SinewFaultUnreadable,
        }
    }
}

impl From<sinew_runtime::protection::Tally> for Tally {
    fn from(tally: sinew_runtime::protection::Tally) -> Self {
        let sinew_runtime::protection::Tally {
            good,
            corrupt,
            too_old,
            repeated,
            backwards,
            restarted,
            gaps,
            unreadable,
            lost,
            trips,
        } = tally;
        Self { good, corrupt, too_old, repeated, backwards, restarted, gaps, unreadable, lost, trips }
    }
}
