//! A message as an application of another process gets it.

use std::{
    sync::atomic::{AtomicBool, Ordering},
    thread,
    time::Duration,
};

use sinew_runtime::{
    outcome::{Outcome, Rejection},
    tid::Tid,
    time::Time,
    wire::{Class, DecodeError, Flags, Kind, Message, Payload, may_be_older},
};

/// A message in hand.
///
/// If its sender wants to know the outcome it is told when this value is dropped: `Delivered`, or `Failed` if the
/// thread is panicking then; `Rejected(Malformed)` if the last [`decode`](Self::decode) of it failed. So a message counts as handled at the end of the scope that handled it, and one that was
/// in hand at a panic counts as failed. [`settle`](Self::settle) says something else, or says it sooner. The process's
/// end says `Failed`.
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
    /// It came through a guard, and is without its envelope.
    is_guarded: bool,
    /// The last try to decode it failed.
    is_malformed: AtomicBool,
}

impl Received {
    pub(super) const fn new(message: Message) -> Self {
        Self { message, is_guarded: false, is_malformed: AtomicBool::new(false) }
    }

    pub(super) const fn guarded(message: Message) -> Self {
        Self { message, is_guarded: true, is_malformed: AtomicBool::new(false) }
    }

    /// Who sent it; the sender's node answers for it.
    #[must_use]
    pub const fn source(&self) -> Tid {
        self.message.header.source
    }

    /// Whom it was sent to: this endpoint, a group, or everybody.
    #[must_use]
    pub const fn destination(&self) -> Tid {
        self.message.header.destination
    }

    /// Type of the payload.
    #[must_use]
    pub const fn kind(&self) -> Kind {
        self.message.header.kind
    }

    /// The class in which it travelled.
    #[must_use]
    pub const fn class(&self) -> Class {
        self.message.header.class
    }

    /// The source's n-th message.
    #[must_use]
    pub const fn sequence(&self) -> u64 {
        self.message.header.sequence
    }

    /// When it was sent, in this host's clock; `None` where that is not known ([`age_error`](Self::age_error)).
    #[must_use]
    pub const fn sent(&self) -> Option<Time> {
        self.message.header.known_sent()
    }

    /// Time from sending to `now`, as wrong as [`age_error`](Self::age_error) says; `None` where it is not known.
    #[must_use]
    pub const fn age(&self, now: Time) -> Option<Duration> {
        self.message.header.age(now)
    }

    /// The error of the age at most: zero for a message of this host. `None` where the age is not known: the clock of the sender's host was
    /// not measured yet, or not for so long that it may be wrong by more than 32 s.
    #[must_use]
    pub const fn age_error(&self) -> Option<Duration> {
        self.message.header.sent_error()
    }

    /// The greatest age that the message can have: `age` and its error; `None` where it is not known.
    #[must_use]
    pub fn age_at_most(&self, now: Time) -> Option<Duration> {
        self.message.header.age_at_most(now)
    }

    /// Whether the message may be older than `limit`. An unknown age counts as too old, as a program that may use fresh values only needs it.
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

    /// Whether the sender waits for a [`reply`](super::Endpoint::reply).
    #[must_use]
    pub const fn wants_reply(&self) -> bool {
        self.message.header.flags.has(Flags::ASK)
    }

    /// The payload as it came, without a copy; of what came through a guard, without its envelope.
    #[must_use]
    pub fn bytes(&self) -> &[u8] {
        &self.message.payload
    }

    /// Reads the payload as a `P`. Compare [`kind`](Self::kind) with `P::KIND` first. A number that does not fit its field is an error, which
    /// names the field.
    ///
    /// # Errors
    /// The bytes are not a `P`: a sender that asked for the outcome gets `Rejected(Malformed)`. Or it is [protected](crate::protection) and did not come through a [`guard`](super::Endpoint::guard).
    pub fn decode<P: Payload>(&self) -> Result<P, DecodeError> {
        if P::PROTECTION.is_some() && !self.is_guarded {
            return Err(DecodeError::unguarded::<P>());
        }
        let decoded = self.message.decode();
        self.is_malformed.store(decoded.is_err(), Ordering::Relaxed);
        decoded
    }

    /// Says what became of the message, if the sender wants to know.
    pub fn settle(mut self, outcome: Outcome) {
        self.message.settle(outcome);
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
