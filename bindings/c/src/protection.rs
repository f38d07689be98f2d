//! Protected payloads: commands that are checked from end to end, and outputs that are safe without them. What is believed, when an output has to
//! be safe and who makes it so is the runtime's to say (`sinew::protection`), for C as for Rust; here are the types and handles of C.
//!
//! | file | what it is |
//! | --- | --- |
//! | `guards.rs` | guards, whose outputs are pointers, and their handles |
//! | `watchdog.rs` | the threads that make outputs safe, begun for a process of C's |
//! | `names.rs` | names of types, which stay |

pub(crate) mod guards;
pub(crate) mod names;
mod watchdog;

use std::{ffi::c_void, time::Duration};

use sinew::{
    message::Kind,
    protection::{
        Cause, Fault as Wrong, OVERHEAD, Protection, State,
        raw::{Protected, Reads},
    },
};

pub(crate) use sinew::protection::Ends;

use crate::{message::TidBits, status::Fault, text::Text};

/// Bytes before the payload of a sealed message.
pub const SINEW_SEALED_HEAD: usize = 32;
/// Bytes that sealing adds to a payload: 32 before it and 8 behind it.
pub const SINEW_SEALED_OVERHEAD: usize = 40;

const _: () = assert!(SINEW_SEALED_OVERHEAD == OVERHEAD, "the envelope is that of Rust");

/// A type of payloads that are protected: what it is called, and what a receiver bears. Both ends use the same one, best from a header of theirs;
/// in Rust it is `Payload::NAME` and `Payload::PROTECTION`. `sinew_protected_type_of` fills all of it.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub struct ProtectedType {
    /// Its name, at least 1 byte.
    pub name: Text,
    /// Length of each payload in bytes, `sizeof` of a plain struct: one of another length is not sent, and is a bad one where it comes. 0: any. It is all
    /// that a guard looks at of a payload: whoever cannot read one that came through it calls `sinew_trip`, or it keeps the output live for ever.
    pub length: usize,
    /// Longest time from one good message to the next, above 0: then the output is made safe.
    pub within_ns: u64,
    /// Greatest age of a message, at least 4 ns: from an echo that the receiver has sent to the moment at which the message that quotes it arrives.
    pub age_max_ns: u64,
    /// Messages that may be missing in a row.
    pub lost_max: u64,
    /// Bad ones that may be among the last 64; none of them is used.
    pub bad_max: u32,
    /// Good ones in a row before the output may be armed, at least 1.
    pub good_min: u32,
    /// One of `sinew_message_class`, for the sender. Of `SINEW_STREAM` only the newest one may arrive: those that it replaces are missing ones.
    pub message_class: i32,
    /// Zero.
    pub reserved: u32,
}

/// What a flow of protected messages is called by both of its ends. It is not sent: whoever is not meant computes another checksum.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub struct DataId {
    /// Who sends: its whole TID, the node's address included.
    pub source: TidBits,
    /// Who receives, as well; one application.
    pub destination: TidBits,
    /// Name of the payload's type.
    pub name: Text,
}

/// What the sender says of one protected message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(C)]
pub struct Stamp {
    /// Counts the messages of the flow, from 1.
    pub counter: u64,
    /// Which life of the sender counts: never the same one twice. `sinew_now_ns` at its beginning will do.
    pub incarnation: u64,
    /// The newest time that the sender has heard from the receiver (`sinew_guard_echo`); 0 for none.
    pub echo_ns: u64,
}

/// Whether commands reach an output and, if not, since what.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(i32)]
#[allow(clippy::enum_variant_names, reason = "these are the names in C, which has no other name spaces")]
pub enum OutputState {
    /// They do.
    SinewLive = 0,
    /// It was never armed.
    SinewSafeNotArmed = 1,
    /// No good message came in time.
    SinewSafeSilent = 2,
    /// More messages are missing in a row than is borne.
    SinewSafeTooMuchLost = 3,
    /// More bad messages came than is borne.
    SinewSafeTooManyBad = 4,
    /// The sender counts anew: it was restarted.
    SinewSafeRestarted = 5,
    /// The receiver's host has slept: how old commands are that came meanwhile is not known.
    SinewSafeSlept = 6,
    /// `sinew_trip` was called, or the guard's endpoint was unregistered.
    SinewSafeTripped = 7,
    /// The guard is being released.
    SinewSafeReleased = 8,
}

/// What is wrong with a protected message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(i32)]
#[allow(clippy::enum_variant_names, reason = "these are the names in C, which has no other name spaces")]
pub enum SealedFault {
    /// Nothing.
    SinewFaultNone = 0,
    /// Its bytes are not those that were sealed for this receiver by this sender: damaged, inserted, or meant for another.
    SinewFaultCorrupt = 1,
    /// It quotes no time of this receiver's, or one that is too long ago.
    SinewFaultTooOld = 2,
    /// It has come before.
    SinewFaultRepeated = 3,
    /// One that was sent later has come before it.
    SinewFaultBackwards = 4,
    /// Its sender counts anew: another incarnation than that of the last one.
    SinewFaultRestarted = 5,
    /// Too many before it are missing.
    SinewFaultGap = 6,
    /// It is what was sealed, and its payload is not as long as the type says.
    SinewFaultUnreadable = 7,
}

/// What a guard has counted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(C)]
pub struct Tally {
    /// Good messages.
    pub good: u64,
    /// Those of `SINEW_FAULT_CORRUPT`.
    pub corrupt: u64,
    /// Those of `SINEW_FAULT_TOO_OLD`.
    pub too_old: u64,
    /// Those of `SINEW_FAULT_REPEATED`.
    pub repeated: u64,
    /// Those of `SINEW_FAULT_BACKWARDS`.
    pub backwards: u64,
    /// Those of `SINEW_FAULT_RESTARTED`.
    pub restarted: u64,
    /// Those of `SINEW_FAULT_GAP`.
    pub gaps: u64,
    /// Those of `SINEW_FAULT_UNREADABLE`.
    pub unreadable: u64,
    /// Messages that are missing, by their numbers.
    pub lost: u64,
    /// How often the output went from live to safe.
    pub trips: u64,
}

/// The only way to an output. Only pointers to it are handed out.
#[derive(Debug)]
pub struct OutputGuard {
    _opaque: (),
}

/// Makes an output safe, and returns 0; anything else says that it could not, and it is called again each millisecond. Any thread calls it, mostly one of
/// the library's own: it must be short and wait for nobody, as the outputs of all guards wait for it. It must return, by no exception and no `longjmp`, and
/// may call nothing of a guard but `sinew_trip` and `sinew_release_later`, and no `sinew_receive_message` of an endpoint that sends or receives protected
/// payloads: `SINEW_ERROR_BUSY`.
pub type MakeSafe = Option<unsafe extern "C" fn(output: *mut c_void, why: OutputState) -> i32>;

/// Moves an output that is live; what makes it safe waits meanwhile. It must return as `sinew_make_safe`, and soon, and may call as little.
pub type Command = Option<unsafe extern "C" fn(output: *mut c_void, argument: *mut c_void)>;

/// A [`ProtectedType`] that was looked at.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Typed<'call> {
    pub(crate) name: &'call str,
    pub(crate) kind: Kind,
    pub(crate) length: usize,
    pub(crate) protection: Protection,
    pub(crate) message_class: i32,
}

impl ProtectedType {
    pub(crate) fn read(&self) -> Result<Typed<'_>, Fault> {
        let fault = |words: &str| Err(Fault::argument(words));
        if self.reserved != 0 {
            return Err(Fault::argument(format!(
                "`payload_type.reserved` is {}: set it to 0",
                self.reserved
            )));
        }
        let name = self.name.read("payload_type.name")?;
        if name.is_empty() {
            return fault("`payload_type.name` is empty");
        }
        if self.within_ns == 0 {
            return fault(
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
            return fault(
                "`payload_type.age_max_ns` is below 4: each message is too old; take some periods of the sender's",
            );
        }
        if protection.good_min == 0 {
            return fault(
                "`payload_type.good_min` is 0: an output is armed by good messages; take 1 at least",
            );
        }
        let (length, message_class) = (self.length, self.message_class);
        Ok(Typed { name, kind: Kind::named(name), length, protection, message_class })
    }
}

impl Typed<'_> {
    /// As the runtime has it; `name` stays, and is this one's or that of the data ID that counts.
    pub(crate) const fn protected(&self, name: &'static str) -> Protected {
        let reads = match self.length {
            0 => Reads::Any,
            length => Reads::OfLength(length),
        };
        Protected { name, kind: self.kind, protection: self.protection, reads }
    }

    /// A payload of the sender's.
    pub(crate) fn check_length(&self, length: usize) -> Result<(), Fault> {
        if self.length == 0 || self.length == length {
            return Ok(());
        }
        Err(Fault::argument(format!(
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
            Cause::Tripped => OutputState::SinewSafeTripped,
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

impl From<sinew::protection::Tally> for Tally {
    fn from(tally: sinew::protection::Tally) -> Self {
        let sinew::protection::Tally {
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
