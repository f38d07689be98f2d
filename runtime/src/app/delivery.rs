//! A message as its handler receives it.

use std::{ops::Deref, time::Duration};

use bytes::Bytes;

use crate::{
    sender::ReplyTo,
    tid::Tid,
    time::Time,
    wire::{Flags, Header, Kind, may_be_older},
};

/// A payload with its source and its age.
///
/// # Examples
///
/// ```
/// use sinew::prelude::*;
///
/// payload!("demo.angle", Stream => struct Angle { degrees: f32 });
///
/// struct Knee { hip_degrees: f32 }
/// # impl Actor for Knee { type Context = AppContext<Self>; }
///
/// impl Handler<Delivery<Angle>> for Knee {
///     type Result = ();
///     fn handle(&mut self, angle: Delivery<Angle>, _: &mut Self::Context) {
///         if !angle.is_older_than(Duration::from_millis(5)) {
///             self.hip_degrees = angle.degrees; // a field of the payload
///         }
///         println!("message {} of {}, {:?} old", angle.sequence, angle.source, angle.age);
///     }
/// }
/// ```
#[derive(Clone, Debug)]
pub struct Delivery<P> {
    /// The value that was sent.
    pub payload: P,
    /// The sender. The sender's node guarantees this address.
    pub source: Tid,
    /// The destination of the message: this application, a group, or all applications.
    pub destination: Tid,
    /// The sequence number that the source gave to this message.
    pub sequence: u64,
    /// When the message was sent, in this host's clock. `None` if the time is unknown;
    /// [`age_error`](Self::age_error) is its error.
    pub sent: Option<Time>,
    /// Time from sending to handling, with an error of [`age_error`](Self::age_error). `None` if the age is unknown.
    ///
    /// A handler that accepts only fresh values checks [`is_older_than`](Self::is_older_than).
    pub age: Option<Duration>,
    /// Type of the payload.
    pub kind: Kind,
    age_error: Option<Duration>,
    is_retained: bool,
    reply_to: Option<ReplyTo>,
}

impl<P> Delivery<P> {
    pub(crate) fn new(payload: P, header: &Header, now: Time) -> Self {
        Self {
            payload,
            source: header.source,
            destination: header.destination,
            sequence: header.sequence,
            sent: header.known_sent(),
            age: header.age(now),
            kind: header.kind,
            age_error: header.sent_error(),
            is_retained: false,
            reply_to: header.flags.has(Flags::ASK).then(|| ReplyTo::of(header)),
        }
    }

    /// Reads from the header whether this is a retained value. Types that are not retained do not pay for it.
    pub(crate) fn marked(mut self, header: &Header) -> Self {
        self.is_retained = header.flags.has(Flags::RETAINED);
        self
    }

    /// Returns the maximum error of `age` and of `sent`: zero for a message of this host. Returns `None` if
    /// the age is unknown: the clock of the sender's host was not measured yet, or not for so long that the
    /// error may exceed 32 s.
    ///
    /// The bound holds as long as the drift of the hosts' clocks is within its limits
    /// (`docs/protocol/ndl.md`, NDL-6.1).
    #[must_use]
    pub const fn age_error(&self) -> Option<Duration> {
        self.age_error
    }

    /// Returns the maximum age that the message can have had: `age` plus its error. Returns `None` if the age
    /// is unknown.
    #[must_use]
    pub fn age_at_most(&self) -> Option<Duration> {
        Some(self.age?.saturating_add(self.age_error?))
    }

    /// Returns whether the message may have been older than `limit` when its handler was called. An unknown
    /// age counts as too old: this is safe for a handler that accepts only fresh values.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::prelude::*;
    ///
    /// # struct Setpoint { degrees: f32 }
    /// fn follow(setpoint: &Delivery<Setpoint>) -> Option<f32> {
    ///     (!setpoint.is_older_than(Duration::from_millis(5))).then_some(setpoint.degrees)
    /// }
    /// ```
    #[must_use]
    pub fn is_older_than(&self, limit: Duration) -> bool {
        may_be_older(self.age_at_most(), limit)
    }

    /// Returns whether this is a retained value: it was sent to the group before this application joined it, or while
    /// its node was not linked. See [`Payload::RETAINED`](crate::wire::Payload::RETAINED). `age` counts from its
    /// sending, so [`is_older_than`](Self::is_older_than) shows a control loop that it is old.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::prelude::*;
    ///
    /// payload!("demo.mode", retained => struct Mode { is_walking: bool });
    ///
    /// fn is_a_change(mode: &Delivery<Mode>) -> bool {
    ///     !mode.is_retained()
    /// }
    /// ```
    #[must_use]
    pub const fn is_retained(&self) -> bool {
        self.is_retained
    }

    /// Returns the destination of the reply, or `None` if the sender does not wait for a reply.
    #[must_use]
    pub const fn reply_to(&self) -> Option<ReplyTo> {
        self.reply_to
    }
}

impl<P> Deref for Delivery<P> {
    type Target = P;

    fn deref(&self) -> &P {
        &self.payload
    }
}

impl<P: 'static> actix::Message for Delivery<P> {
    type Result = ();
}

/// The bytes of a payload as they were received, without a copy.
///
/// # Examples
///
/// ```
/// use sinew::{app::Raw, message::Kind, prelude::*};
///
/// struct Recorder { bytes: usize }
/// # impl Actor for Recorder { type Context = AppContext<Self>; }
///
/// impl Handler<Delivery<Raw>> for Recorder {
///     type Result = ();
///     fn handle(&mut self, samples: Delivery<Raw>, _: &mut Self::Context) {
///         self.bytes += samples.payload.len();
///     }
/// }
///
/// let recorder = AppSpec::new("recorder", || Recorder { bytes: 0 }).handles_raw(Kind::named("plate.samples"));
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Raw(pub Bytes);

impl Deref for Raw {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        &self.0
    }
}
