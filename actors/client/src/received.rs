//! A message as an application in another process receives it.

use std::{
    sync::atomic::{AtomicBool, Ordering},
    thread,
    time::Duration,
};

use bytes::Bytes;
use sinew_runtime::{
    outcome::{Outcome, Rejection},
    tid::Tid,
    time::Time,
    wire::{Class, DecodeError, Flags, Kind, Message, Payload, may_be_older},
};

/// A received message that is being handled.
///
/// If its sender wants the outcome, dropping this value reports it: `Delivered`, or `Failed` if the thread is
/// panicking then; `Rejected(Malformed)` if the last [`decode`](Self::decode) failed. So a message counts as
/// handled at the end of the scope that handled it, and as failed if its handler panicked.
/// [`settle`](Self::settle) reports another outcome, or reports it sooner. The end of the process reports
/// `Failed`.
///
/// # Examples
///
/// ```
/// use sinew::{Outcome, Payload, Time, client::{ApiError, Received}, message::Rejection, payload};
///
/// payload!("demo.angle", Stream => struct Angle { degrees: f32 });
///
/// fn handle(received: Received) -> Result<(), ApiError> {
///     if received.kind() != Angle::KIND {
///         received.settle(Outcome::Rejected(Rejection::UnknownKind));
///         return Ok(());
///     }
///     let angle: Angle = received.decode()?;
///     println!("{} degrees, {:?} old", angle.degrees, received.age(Time::now()));
///     Ok(())
/// }
/// ```
#[derive(Debug)]
#[must_use = "a received message that is dropped counts as handled"]
pub struct Received {
    message: Message,
    /// It passed a guard, and is without its envelope.
    is_guarded: bool,
    /// The last decoding failed.
    is_malformed: AtomicBool,
}

impl Received {
    pub(super) const fn new(message: Message) -> Self {
        Self { message, is_guarded: false, is_malformed: AtomicBool::new(false) }
    }

    pub(super) const fn guarded(message: Message) -> Self {
        Self { message, is_guarded: true, is_malformed: AtomicBool::new(false) }
    }

    /// Returns the sender; the sender's node guarantees it.
    #[must_use]
    pub const fn source(&self) -> Tid {
        self.message.header.source
    }

    /// Returns the destination: this endpoint, a group, or all applications.
    #[must_use]
    pub const fn destination(&self) -> Tid {
        self.message.header.destination
    }

    /// Returns the type of the payload.
    #[must_use]
    pub const fn kind(&self) -> Kind {
        self.message.header.kind
    }

    /// Returns the class of the message.
    #[must_use]
    pub const fn class(&self) -> Class {
        self.message.header.class
    }

    /// Returns the sequence number of the message at its source.
    #[must_use]
    pub const fn sequence(&self) -> u64 {
        self.message.header.sequence
    }

    /// Returns when the message was sent, in this host's clock; `None` if unknown ([`age_error`](Self::age_error)).
    #[must_use]
    pub const fn sent(&self) -> Option<Time> {
        self.message.header.known_sent()
    }

    /// Returns the time from sending to `now`, with the error of [`age_error`](Self::age_error); `None` if unknown.
    #[must_use]
    pub const fn age(&self, now: Time) -> Option<Duration> {
        self.message.header.age(now)
    }

    /// Returns the maximum error of the age: zero for a message of this host. `None` if the age is unknown.
    /// Then the clock of the sender's host was not measured yet, or so long ago that the error may exceed 32
    /// s.
    #[must_use]
    pub const fn age_error(&self) -> Option<Duration> {
        self.message.header.sent_error()
    }

    /// Returns the maximum age of the message: `age` and its error; `None` if unknown.
    #[must_use]
    pub fn age_at_most(&self, now: Time) -> Option<Duration> {
        self.message.header.age_at_most(now)
    }

    /// Returns whether the message may be older than `limit`. An unknown age counts as too old, which is the
    /// safe answer for a program that may use fresh values only.
    ///
    /// # Examples
    ///
    /// ```no_run
    /// # use std::time::Duration;
    /// # use sinew::{Endpoint, Time, client::ApiError};
    /// # sinew::payload!("doc.setpoint", Stream => struct Setpoint { degrees: f32 });
    /// # fn step(endpoint: &mut Endpoint, setpoint: &mut Option<Setpoint>) -> Result<(), ApiError> {
    /// while let Some(received) = endpoint.receive(Duration::ZERO)? {
    ///     if !received.is_older_than(Duration::from_millis(5), Time::now()) {
    ///         *setpoint = Some(received.decode()?);
    ///     }
    /// }
    /// # Ok(())
    /// # }
    /// ```
    #[must_use]
    pub fn is_older_than(&self, limit: Duration, now: Time) -> bool {
        may_be_older(self.age_at_most(now), limit)
    }

    /// Returns whether this is a retained value, which was sent to the group before this endpoint joined it. `age`
    /// counts from its sending. See [`Payload::RETAINED`].
    #[must_use]
    pub const fn is_retained(&self) -> bool {
        self.message.header.flags.has(Flags::RETAINED)
    }

    /// Returns whether the sender waits for a [`reply`](super::Endpoint::reply).
    #[must_use]
    pub const fn wants_reply(&self) -> bool {
        self.message.header.flags.has(Flags::ASK)
    }

    /// Returns the received payload, without a copy; without its envelope if it passed a guard.
    #[must_use]
    pub fn bytes(&self) -> &[u8] {
        &self.message.payload
    }

    /// Returns the received payload as a value of its own, which shares the memory without a copy.
    #[must_use]
    pub fn payload(&self) -> Bytes {
        self.message.payload.clone()
    }

    /// Decodes the payload as a `P`. Compare [`kind`](Self::kind) with `P::KIND` first. A number that does
    /// not fit its field is an error that names the field.
    ///
    /// # Errors
    /// The bytes are not a `P`: a sender that asked for the outcome gets `Rejected(Malformed)`. Or the type
    /// is [protected](sinew_runtime::protection) and the message did not pass a [`guard`](super::Endpoint::guard).
    pub fn decode<P: Payload>(&self) -> Result<P, DecodeError> {
        if P::PROTECTION.is_some() && !self.is_guarded {
            return Err(DecodeError::unguarded::<P>());
        }
        let decoded = self.message.decode();
        self.is_malformed.store(decoded.is_err(), Ordering::Relaxed);
        decoded
    }

    /// Reports the outcome of the message, if the sender wants it.
    pub fn settle(mut self, outcome: Outcome) {
        self.message.settle(outcome);
    }

    /// Returns when the sender stops waiting, in this host's clock; [`Time::MAX`] if it never does.
    pub(super) fn expiry(&self) -> Time {
        self.message.header.expiry()
    }

    pub(super) const fn correlation(&self) -> u64 {
        self.message.header.correlation
    }
}

impl Drop for Received {
    fn drop(&mut self) {
        let outcome = match *self.is_malformed.get_mut() {
            _ if thread::panicking() => Outcome::Failed,
            true => Outcome::Rejected(Rejection::Malformed),
            false => Outcome::Delivered,
        };
        self.message.settle(outcome);
    }
}
