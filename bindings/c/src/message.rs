//! Messages as C sees them: a pointer to the bytes, and a token by which the library identifies the message.

use std::{ffi::c_char, time::Duration};

use sinew_runtime::{tid::Tid, time::Time, wire::Class};

use crate::outcome::code_of as outcome_code;

/// A transport ID (TID): the node's address in the upper half, the application's in the lower. 0 is no
/// application.
pub type TidBits = u64;

/// Type of a payload: see `sinew_kind_named`. No type has 0.
pub type KindBits = u32;

/// An endpoint: a transport address of this process. Programs have only pointers to it.
#[derive(Debug)]
pub struct Endpoint {
    _opaque: (),
}

/// The urgency of a message, and the effect of a newer message on an older one.
#[derive(Clone, Copy, Debug)]
#[repr(i32)]
#[allow(
    clippy::enum_variant_names,
    dead_code,
    reason = "these are the names in C, which hands their numbers in"
)]
pub enum MessageClass {
    /// Delivered in order, ahead of all other classes.
    SinewControl = 0,
    /// Only the newest value of each source and kind: a late setpoint is a hazard. Cannot be confirmed.
    SinewStream = 1,
    /// Delivered in order, after the other classes.
    SinewBulk = 2,
}

/// A message under construction. `bytes` is writable until it is sent or discarded; do not change the other
/// fields.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub struct Message {
    /// The payload, all zeros at first.
    pub bytes: *mut u8,
    /// Length of the payload in bytes.
    pub length: usize,
    /// For the library: identifies the message.
    pub token: u64,
}

/// A received message. `bytes` is readable until it is settled; do not change the fields.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub struct Received {
    /// The payload.
    pub bytes: *const u8,
    /// Length of the payload in bytes.
    pub length: usize,
    /// The sender; the sender's node vouches for it.
    pub source: TidBits,
    /// The destination: this endpoint, a group, or all applications.
    pub destination: TidBits,
    /// The number of the message among the source's messages, from 1.
    pub sequence: u64,
    /// Time of sending, on the clock of `sinew_now_ns`, with an error of up to `sent_error_ns`. Valid only if
    /// `is_sent_known`. For an age use `sinew_age`, `sinew_age_at_most` or `sinew_is_older_than`.
    pub sent_ns: u64,
    /// Maximum error of `sent_ns`, if `is_sent_known`: 0 for a message of this host. It grows while the clock
    /// of the sender's host is not measured.
    pub sent_error_ns: u64,
    /// For the library: identifies the message.
    pub token: u64,
    /// Type of the payload: compare it with `sinew_kind_named`.
    pub kind: KindBits,
    /// One of `sinew_message_class`.
    pub message_class: u8,
    /// Whether the sender waits for `sinew_reply`.
    pub wants_reply: bool,
    /// Whether `sent_ns` is known. It is not while the clock of the sender's host is not measured, or may be
    /// wrong by more than 32 s.
    pub is_sent_known: bool,
    /// Zero.
    pub reserved: u8,
}

/// Unconfirmed messages to one destination, of one type, that were not delivered for one reason.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub struct Undelivered {
    /// Destination; 0, which no application has: several that are no longer distinguished.
    pub destination: TidBits,
    /// Number of messages since the last report. Never 0.
    pub count: u64,
    /// Time of the first rejection, on the clock of `sinew_now_ns`.
    pub since_ns: u64,
    /// Lowest sequence of these messages, if `are_sequences_known`.
    pub first_sequence: u64,
    /// Highest sequence of these messages, if `are_sequences_known`.
    pub last_sequence: u64,
    /// Reason: one of `sinew_outcome`. `SINEW_REJECTED_UNKNOWN_KIND`: the destination does not handle this
    /// type.
    pub outcome: i32,
    /// Type of the payload; 0, which no type has: several, or not known.
    pub kind: KindBits,
    /// One of `sinew_message_class`, of the first message; -1, which is none of them: not known.
    pub message_class: i32,
    /// Name of the destination, at most 63 bytes, terminated by a zero; empty if it is not known.
    pub name: [c_char; 64],
    /// Whether `first_sequence` and `last_sequence` are known.
    pub are_sequences_known: bool,
    /// Zero.
    pub reserved: [u8; 7],
}

/// The outcome of a message to many at one of its members.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub struct MemberOutcome {
    /// The member. If a node has not named its members: its node, and the application address that the
    /// message was sent to.
    pub tid: TidBits,
    /// One of `sinew_outcome`.
    pub outcome: i32,
    /// Zero.
    pub reserved: u32,
}

impl MemberOutcome {
    pub(crate) fn of(member: &sinew_runtime::outcome::MemberOutcome) -> Self {
        Self { tid: member.tid.bits(), outcome: i32::from(member.outcome.code()), reserved: 0 }
    }
}

impl Message {
    /// The caller's struct after the library has consumed the message.
    pub(crate) const GONE: Self = Self { bytes: std::ptr::null_mut(), length: 0, token: 0 };
}

/// Whole nanoseconds; saturates at 584 years.
pub(crate) fn nanos(time: Duration) -> u64 {
    u64::try_from(time.as_nanos()).unwrap_or(u64::MAX)
}

impl Received {
    /// As [`Message::GONE`].
    pub(crate) const GONE: Self = Self {
        bytes: std::ptr::null(),
        length: 0,
        source: Tid::NONE.bits(),
        destination: Tid::NONE.bits(),
        sequence: 0,
        sent_ns: 0,
        sent_error_ns: 0,
        token: 0,
        kind: 0,
        message_class: 0,
        wants_reply: false,
        is_sent_known: false,
        reserved: 0,
    };

    pub(crate) fn of(received: &sinew_client::Received, token: u64) -> Self {
        let sent = received.sent().zip(received.age_error());
        // If it is not known, both say the greatest age to a program that does not check.
        let (sent_ns, sent_error_ns) = sent.map_or((0, 0), |(sent, error)| (sent.as_nanos(), nanos(error)));
        Self {
            bytes: received.bytes().as_ptr(),
            length: received.bytes().len(),
            source: received.source().bits(),
            destination: received.destination().bits(),
            sequence: received.sequence(),
            sent_ns,
            sent_error_ns,
            token,
            kind: received.kind().bits(),
            message_class: code_of(received.class()),
            wants_reply: received.wants_reply(),
            is_sent_known: sent.is_some(),
            reserved: 0,
        }
    }

    /// Time from sending to `now`; `None` if it is not known.
    pub(crate) fn age(&self, now: Time) -> Option<Duration> {
        self.is_sent_known.then(|| now.since(Time::from_nanos(self.sent_ns)))
    }

    /// The greatest possible age; `None` if it is not known.
    pub(crate) fn age_at_most(&self, now: Time) -> Option<Duration> {
        Some(self.age(now)?.saturating_add(Duration::from_nanos(self.sent_error_ns)))
    }
}

impl Undelivered {
    pub(crate) fn of(undelivered: &sinew_runtime::undelivered::Undelivered) -> Self {
        Self {
            destination: undelivered.destination.bits(),
            count: undelivered.count,
            since_ns: undelivered.since.as_nanos(),
            first_sequence: undelivered.first_sequence.unwrap_or(0),
            last_sequence: undelivered.last_sequence.unwrap_or(0),
            outcome: outcome_code(sinew_runtime::outcome::Outcome::Rejected(undelivered.why)) as i32,
            kind: undelivered.kind.map_or(0, sinew_runtime::wire::Kind::bits),
            message_class: undelivered.class.map_or(-1, |class| i32::from(code_of(class))),
            name: name_in_c(undelivered.name.as_deref().unwrap_or_default()),
            are_sequences_known: undelivered.first_sequence.is_some(),
            reserved: [0; 7],
        }
    }
}

/// A name terminated by a zero; cut off if it is too long.
fn name_in_c(name: &str) -> [c_char; 64] {
    let mut bytes = [0; 64];
    for (slot, byte) in bytes.iter_mut().zip(name.bytes()).take(63) {
        *slot = c_char::from_ne_bytes([byte]);
    }
    bytes
}

/// Returns the class with this number.
pub(crate) fn class_of(code: i32) -> Option<Class> {
    [Class::Control, Class::Stream, Class::Bulk].into_iter().find(|class| i32::from(code_of(*class)) == code)
}

const fn code_of(class: Class) -> u8 {
    match class {
        Class::Control => MessageClass::SinewControl as u8,
        Class::Stream => MessageClass::SinewStream as u8,
        Class::Bulk => MessageClass::SinewBulk as u8,
    }
}
