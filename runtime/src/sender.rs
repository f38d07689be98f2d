//! The sending side of an application: unconfirmed sends, confirmed sends and requests.

mod awaiting;
mod builder;
mod destination;
mod directory;
mod expecting;
mod groups;
mod reply;
mod room;
mod sent_types;
mod stop;
mod transaction;
mod unknown_name;

use std::{
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    time::Duration,
};

use bytes::Bytes;

pub(crate) use self::builder::{Content, Via};
use self::sent_types::SentTypes;
pub use self::{
    awaiting::{Confirmation, GroupConfirmation, Reply},
    builder::{MessageBuilder, Value},
    destination::Destination,
    directory::Directory,
    reply::ReplyTo,
    room::{ConfirmWhenRoom, RoomBuilder, SendWhenRoom, StalledError, StalledQueue},
    unknown_name::UnknownNameError,
};
use crate::{
    clock::Clock,
    monitor::{MonitorError, MonitorId},
    outcome::{Outcome, Rejection},
    pending::Pending,
    protection::{Echo, Flows},
    router::Router,
    supervision::liveness::Liveness,
    tid::Tid,
    time::Time,
    wire::{
        Class, DecodeError, Header, Kind, Message, MessageBuffer, Payload, PayloadType, encode, remember,
    },
};

/// Maximum number of messages that one process can send in its lifetime: twelve days at a million a second.
const SEQUENCES_PER_INCARNATION: u64 = 1 << 40;

/// The reason why a message was not sent. Nothing changed.
///
/// # Examples
///
/// ```
/// use sinew::message::SendError;
///
/// fn skip_or_fail(sent: Result<(), SendError>) -> Result<(), SendError> {
///     match sent {
///         // The knee is away: the next value comes in a millisecond.
///         Err(SendError::UnknownName(_) | SendError::Rejected(_)) => Ok(()),
///         other => other,
///     }
/// }
/// ```
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SendError {
    /// The directory does not know the name.
    #[error(transparent)]
    UnknownName(#[from] UnknownNameError),
    /// The message was rejected.
    #[error("{0}")]
    Rejected(#[from] Rejection),
    /// The sender was replaced: its application hung, or did not stop in time. A later incarnation owns this TID now.
    #[error("this incarnation of the application has ended; a later one has replaced it")]
    Over,
    /// The message found no room in time.
    #[error(transparent)]
    Stalled(#[from] StalledError),
    /// Too many confirmed messages and requests await their outcomes, or too many messages wait for room.
    #[error(
        "too many confirmed messages, requests and messages without room are under way; wait for some to end"
    )]
    TooManyWaits,
    /// A group or a broadcast has one outcome per member, not a single one.
    #[error(
        "{0} is more than one application, so that the message has an outcome for each; send it with `confirmed_by_each`"
    )]
    ToMany(Tid),
    /// Kinds below `0x8000_0000` are reserved for the layers; see [`Kind`].
    #[error(
        "the kind {0} belongs to Sinew's layers, which would end a connection; take one from `Kind::named`"
    )]
    NotYours(Kind),
    /// This incarnation of the application has protected messages in 1,024 flows, one for each receiver and
    /// type. Each flow was used within its type's `within` and `age_max`.
    #[error(
        "this application has 1,024 flows of protected messages already (one for each receiver and type), and can begin another one only when one of these is idle"
    )]
    TooManyProtectedFlows,
}

/// The reason why a request has no reply.
///
/// # Examples
///
/// ```
/// use sinew::{Outcome, message::AskError};
///
/// /// Whether the request was certainly not handled, so that it may be sent again.
/// fn was_not_handled(error: &AskError) -> bool {
///     matches!(error, AskError::Send(_) | AskError::Ended(Outcome::Rejected(_) | Outcome::Expired))
/// }
/// ```
#[derive(Debug, thiserror::Error)]
pub enum AskError {
    /// The request was not sent.
    #[error(transparent)]
    Send(#[from] SendError),
    /// The request was sent and not handled.
    #[error("the request ended as {0:?}")]
    Ended(Outcome),
    /// No reply arrived in time. The request may have been handled.
    #[error("no reply came within {0:?}")]
    Deadline(Duration),
    /// The reply is not a valid value of the reply's type.
    #[error(transparent)]
    Malformed(#[from] DecodeError),
}

/// The sending side of one TID. Clones share its state; any thread may use it.
///
/// # Examples
///
/// ```
/// use sinew::{message::{SendError, Sender}, payload};
///
/// payload!("demo.force", Stream => struct Force { newtons: f32 });
///
/// /// Runs on the thread of a device whose driver blocks; `AppContext::sender` gives the sender.
/// fn read_device(sender: &Sender) -> Result<(), SendError> {
///     let newtons = 0.0;
///     sender.send("gait", &Force { newtons })
/// }
/// ```
#[derive(Clone)]
pub struct Sender {
    shared: Arc<Shared>,
    /// The incarnation that sends with this; `None` if no supervisor fences incarnations.
    incarnation: Option<Arc<Liveness>>,
    /// The flows of protected messages of this incarnation.
    flows: Arc<Flows>,
}

struct Shared {
    tid: Tid,
    router: Arc<Router>,
    directory: Arc<dyn Directory>,
    pending: Arc<Pending>,
    sequence: AtomicU64,
    payload_max: usize,
    /// The types that the directory knows as sent.
    sent_types: SentTypes,
}

impl std::fmt::Debug for Sender {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Sender({})", self.shared.tid)
    }
}

impl Sender {
    /// Creates the sending side of `tid`. Payloads above `payload_max` bytes are rejected.
    #[must_use]
    pub fn new(
        tid: Tid,
        router: Arc<Router>,
        directory: Arc<dyn Directory>,
        pending: Arc<Pending>,
        payload_max: usize,
    ) -> Self {
        let sequence = AtomicU64::new(0);
        let flows = Arc::new(Flows::new(router.clock().now()));
        let shared = Arc::new(Shared {
            tid,
            router,
            directory,
            pending,
            sequence,
            payload_max,
            sent_types: SentTypes::default(),
        });
        Self { shared, incarnation: None, flows }
    }

    /// Returns the same sending side bound to one incarnation of its application: it stops sending when the
    /// incarnation is over.
    #[must_use]
    pub(crate) fn for_incarnation(&self, incarnation: Arc<Liveness>) -> Self {
        Self {
            shared: self.shared.clone(),
            incarnation: Some(incarnation),
            flows: Arc::new(Flows::new(self.now())),
        }
    }

    fn is_over(&self) -> bool {
        self.incarnation.as_ref().is_some_and(|incarnation| incarnation.is_fenced())
    }

    /// Returns the sequence number of the last message sent from the TID, as far as this sender knows.
    #[must_use]
    pub fn last_sequence(&self) -> u64 {
        self.shared.sequence.load(Ordering::Relaxed)
    }

    /// Continues the sequence of another sender of the TID, in another process. That sender started after the
    /// sequence `began` and has sent messages up to `last`. Returns `false`, and ignores `last`, if no
    /// process can reach it in one lifetime.
    pub fn count_on_from(&self, last: u64, began: u64) -> bool {
        let is_plausible = last <= began.saturating_add(SEQUENCES_PER_INCARNATION);
        if is_plausible {
            self.shared.sequence.fetch_max(last, Ordering::Relaxed);
        }
        is_plausible
    }

    /// Returns the clock of this sender's application: the host's, or a virtual one in a replay.
    #[must_use]
    #[inline]
    pub fn clock(&self) -> &Clock {
        self.shared.router.clock()
    }

    /// Returns the current time of [the application's clock](Self::clock).
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{Time, message::Sender};
    ///
    /// /// How long a driver has been silent, on the clock that its application reads.
    /// fn silence(sender: &Sender, last: Time) -> std::time::Duration {
    ///     sender.now().since(last)
    /// }
    /// ```
    #[must_use]
    #[inline]
    pub fn now(&self) -> Time {
        self.clock().now()
    }

    /// Returns the TID that this sender sends from.
    #[must_use]
    pub fn tid(&self) -> Tid {
        self.shared.tid
    }

    /// Returns the TID that has `name` now, on any node.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{Tid, message::Sender};
    ///
    /// /// The left knee, or the right one where there is no left one.
    /// fn a_knee(sender: &Sender) -> Option<Tid> {
    ///     sender.resolve("knee.left").or_else(|| sender.resolve("knee.right"))
    /// }
    /// ```
    #[must_use]
    pub fn resolve(&self, name: &str) -> Option<Tid> {
        self.shared.directory.resolve(name)
    }

    /// Monitors the current incarnation of the application at `tid`, on any node. This application receives
    /// one [`Down`](crate::monitor::Down) when that incarnation ends, its node is lost, or no application has
    /// the TID. The monitor ends with this application's own incarnation.
    ///
    /// # Errors
    /// The TID is not that of an application, or a bound of [`MonitorError`] is reached.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{Tid, events::{MonitorError, MonitorId}, message::Sender};
    ///
    /// fn watch(sender: &Sender, drives: &[Tid]) -> Result<Vec<MonitorId>, MonitorError> {
    ///     drives.iter().map(|drive| sender.monitor(*drive)).collect()
    /// }
    /// ```
    pub fn monitor(&self, tid: Tid) -> Result<MonitorId, MonitorError> {
        if self.is_over() {
            return Err(MonitorError::LifeOver);
        }
        self.shared.directory.monitor(self.shared.tid.app, self.shared.router.absolute(tid))
    }

    /// Removes a monitor. Returns `false` if it has already reported: its [`Down`](crate::monitor::Down) may
    /// wait in the mailbox.
    #[must_use]
    pub fn demonitor(&self, monitor: MonitorId) -> bool {
        self.shared.directory.demonitor(self.shared.tid.app, monitor)
    }

    /// Sends a value, in the class of its type. Returns when a queue or a socket has accepted it.
    ///
    /// # Errors
    /// No queue and no socket accepted the message.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{Tid, message::{SendError, Sender}, payload};
    ///
    /// payload!("demo.stop" => struct Stop;);
    ///
    /// fn stop(sender: &Sender) -> Result<(), SendError> {
    ///     sender.send(Tid::group("drives"), &Stop)
    /// }
    /// ```
    pub fn send<'a, P: Payload>(
        &self,
        destination: impl Into<Destination<'a>>,
        value: &P,
    ) -> Result<(), SendError> {
        let message = self.typed(destination.into(), value)?;
        self.dispatch(message).map(drop)
    }

    /// Returns a builder for a message with other terms than its type's defaults, for a confirmed message or
    /// for a request: see [`MessageBuilder`].
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{Class, Tid, message::{SendError, Sender}, payload};
    ///
    /// payload!("demo.sample", Stream => struct Sample { newtons: f32 });
    ///
    /// /// Sends each sample of a record: as Bulk none takes the place of another, and none delays commands.
    /// fn send_record(sender: &Sender, to: Tid, record: &[Sample]) -> Result<(), SendError> {
    ///     record.iter().try_for_each(|sample| sender.message(to, sample).class(Class::Bulk).send())
    /// }
    /// ```
    pub fn message<'a, P: Payload>(
        &self,
        to: impl Into<Destination<'a>>,
        value: &'a P,
    ) -> MessageBuilder<&Self, Value<'a, P>> {
        MessageBuilder::new(self, Value { destination: to.into(), value })
    }

    /// Same as [`message`](Self::message), for memory from [`create_message`](Self::create_message) (the
    /// paper's SendMessage).
    pub const fn loaned(&self, buffer: MessageBuffer) -> MessageBuilder<&Self, MessageBuffer> {
        MessageBuilder::new(self, buffer)
    }

    /// Allocates writable memory of `length` bytes for a raw payload of `kind` (the paper's CreateMessage).
    ///
    /// # Errors
    /// The name is unknown, or the payload would be too long.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::message::{Kind, SendError, Sender};
    ///
    /// fn send_image(sender: &Sender, pixels: &[u8]) -> Result<(), SendError> {
    ///     let mut memory = sender.create_message("vision", Kind::named("camera.image"), pixels.len())?;
    ///     memory.copy_from_slice(pixels);
    ///     sender.loaned(memory).send()
    /// }
    /// ```
    pub fn create_message<'a>(
        &self,
        destination: impl Into<Destination<'a>>,
        kind: Kind,
        length: usize,
    ) -> Result<MessageBuffer, SendError> {
        if length > self.shared.payload_max {
            return Err(Rejection::TooLong.into());
        }
        let header = Header::new(kind, self.shared.tid, self.find(destination.into())?);
        Ok(MessageBuffer::new(header, length))
    }

    /// Sends an encoded payload.
    pub(crate) fn send_bytes(
        &self,
        destination: Destination<'_>,
        kind: Kind,
        class: Class,
        payload: Bytes,
    ) -> Result<(), SendError> {
        let mut header = Header::new(kind, self.shared.tid, self.find(destination)?);
        header.class = class;
        self.dispatch(Message::new(header, payload)).map(drop)
    }

    /// Builds a message of the value, in its envelope if its type is protected.
    fn typed<P: Payload>(&self, destination: Destination<'_>, value: &P) -> Result<Message, SendError> {
        let destination = self.find(destination)?;
        self.note_type::<P>();
        if P::PROTECTION.is_none() {
            return Ok(Message::of_remembered::<P>(self.shared.tid, destination, encode(value)));
        }
        let receiver = self.shared.router.absolute(destination);
        if !receiver.is_single() {
            // Each receiver has its own echo and its own data ID.
            return Err(Rejection::Unsupported.into());
        }
        let payload = self.flows.seal(self.shared.tid, receiver, value, self.now());
        let payload = payload.ok_or(SendError::TooManyProtectedFlows)?;
        Ok(Message::of_remembered::<P>(self.shared.tid, destination, payload))
    }

    /// Reports the type to the directory before the first message of it. Later it costs one load and a branch.
    #[inline]
    fn note_type<P: Payload>(&self) {
        if let Some(sent) = remember::<P>()
            && !self.shared.sent_types.contains(sent)
        {
            self.report_type(sent);
        }
    }

    #[cold]
    fn report_type(&self, sent: PayloadType) {
        if self.shared.sent_types.insert(sent) {
            self.shared.directory.sends(self.shared.tid.app, sent);
        }
    }

    /// Returns the TID with the address of its node filled in.
    pub(crate) fn absolute(&self, tid: Tid) -> Tid {
        self.shared.router.absolute(tid)
    }

    /// Reports to its sender an unconfirmed message that the application took out of its mailbox and rejected.
    pub fn refused(&self, header: &Header, why: Rejection) {
        self.shared.router.report(self.shared.tid, header, why, 1);
    }

    /// Records an echo: a receiver of protected messages requests that this time is quoted.
    pub(crate) fn echoed(&self, from: Tid, echo: Echo) {
        self.flows.record_echo(from, echo);
    }

    fn find(&self, destination: Destination<'_>) -> Result<Tid, SendError> {
        match destination {
            Destination::Tid(tid) => Ok(tid),
            Destination::Name(name) => {
                let directory = &self.shared.directory;
                let tid = directory.resolve(name);
                tid.ok_or_else(|| UnknownNameError::new(name, directory).into())
            }
        }
    }

    /// Returns why this incarnation may not send the message; `None` if it may.
    #[inline]
    fn why_not_sent(&self, message: &Message) -> Option<(Rejection, SendError)> {
        let kind = message.header.kind;
        if self.is_over() {
            Some((Rejection::Closed, SendError::Over))
        } else if !kind.is_user() {
            // Layers' messages bypass the guards, and an invalid one ends a link, so an application must not send them.
            Some((Rejection::UnknownKind, SendError::NotYours(kind)))
        } else if message.payload.len() > self.shared.payload_max {
            Some((Rejection::TooLong, Rejection::TooLong.into()))
        } else {
            None
        }
    }

    fn next_sequence(&self) -> u64 {
        self.shared.sequence.fetch_add(1, Ordering::Relaxed).wrapping_add(1)
    }

    /// Sends the message and returns when it was sent.
    fn dispatch(&self, mut message: Message) -> Result<Time, SendError> {
        if let Some((why, error)) = self.why_not_sent(&message) {
            message.reject(why);
            return Err(error);
        }
        message.header.sequence = self.next_sequence();
        let sent = self.now();
        message.header.sent = sent;
        self.shared.router.send(message)?;
        Ok(sent)
    }
}
