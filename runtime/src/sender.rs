//! How an application sends: fire and forget, confirmed, or asking.

mod awaiting;
mod builder;
mod clock;
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
pub use self::{
    awaiting::{Confirmation, GroupConfirmation, Reply},
    builder::{MessageBuilder, Value},
    unknown_name::UnknownNameError,
};
use crate::{
    monitor::{MonitorError, MonitorId},
    outcome::{Outcome, Receipt, Rejection, Ticket},
    pending::{Awaited, Pending, Wait},
    protection::{Echo, Flows},
    router::Router,
    supervision::vitals::Vitals,
    tid::{AppAddress, Tid},
    time::Time,
    wire::{Class, DecodeError, Flags, Header, Kind, Message, MessageBuffer, Payload, encode},
};

/// Messages that one process can send at most in its life: at a million a second it is twelve days.
const SEQUENCES_PER_LIFE: u64 = 1 << 40;

/// What a node knows of names and groups.
pub trait Directory: Send + Sync {
    /// The TID that has `name` now, or `None` if nobody has it.
    fn resolve(&self, name: &str) -> Option<Tid>;

    /// Names of applications that are similar to `name`, three at most, the most similar first; none where no names are at hand. It compares
    /// names, so it is for what is shown to people.
    fn nearest(&self, name: &str) -> Vec<String> {
        let _ = name;
        Vec::new()
    }

    /// Makes the application at `app` of this node a member of `group`, or no longer one.
    fn set_member(&self, app: AppAddress, group: AppAddress, member: bool);

    /// Lets the application at `watcher` of this node watch the present life of `target`.
    ///
    /// # Errors
    /// Why not; nothing changed.
    fn monitor(&self, watcher: AppAddress, target: Tid) -> Result<MonitorId, MonitorError> {
        let _ = (watcher, target);
        Err(MonitorError::Unsupported)
    }

    /// Ends a monitor of `watcher`. `false` if there is none, or if it has spoken already.
    fn demonitor(&self, watcher: AppAddress, monitor: MonitorId) -> bool {
        let _ = (watcher, monitor);
        false
    }
}

/// Whom a message is for: a TID (an application, a group, everybody) or a name.
///
/// # Examples
///
/// ```
/// use sinew::{Tid, message::Destination};
///
/// let by_name: Destination<'_> = "knee.drive".into();
/// let by_address: Destination<'_> = Tid::group("drives").into();
/// assert_ne!(by_name, by_address);
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Destination<'a> {
    /// By address.
    Tid(Tid),
    /// By name, looked up in the directory that all nodes share.
    Name(&'a str),
}

impl From<Tid> for Destination<'_> {
    fn from(tid: Tid) -> Self {
        Self::Tid(tid)
    }
}

impl<'a> From<&'a str> for Destination<'a> {
    fn from(name: &'a str) -> Self {
        Self::Name(name)
    }
}

/// Why a message was not sent. Nothing changed.
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
    /// Nobody took the message.
    #[error("{0}")]
    Rejected(#[from] Rejection),
    /// The sender was replaced: its application hung, or did not stop in its time. A later life speaks for this TID.
    #[error("this life of the application is over; a later one speaks for it")]
    Over,
    /// Too many confirmed messages and requests wait for their end.
    #[error("too many confirmed messages and requests are under way; wait for some to end")]
    TooManyWaits,
    /// A group or a broadcast has no outcome of its own: each member has one.
    #[error(
        "{0} is more than one application, so that the message has an outcome for each; send it with `confirmed_by_each`"
    )]
    ToMany(Tid),
    /// Kinds below `0x8000_0000` are the layers' own; see [`Kind`].
    #[error(
        "the kind {0} belongs to Sinew's layers, which would end a connection; take one from `Kind::named`"
    )]
    NotYours(Kind),
    /// This life of the application has sent protected messages to 1,024 receivers, to each of them within its type's `within` and `age_max`.
    #[error(
        "this application sends protected messages to 1,024 receivers already, and can to no further one while it goes on with these"
    )]
    TooManyProtectedFlows,
}

/// Why a request has no reply.
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
    /// It was not sent.
    #[error(transparent)]
    Send(#[from] SendError),
    /// It was sent and not handled.
    #[error("the request ended as {0:?}")]
    Ended(Outcome),
    /// No reply came in time. The request may have been handled.
    #[error("no reply came within {0:?}")]
    Deadline(Duration),
    /// What came is not the reply's type.
    #[error(transparent)]
    Malformed(#[from] DecodeError),
}

/// The sending side of one TID. Clones share it; any thread may use it.
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
    /// The life of the application that sends with this; `None` where nobody takes lives.
    life: Option<Arc<Vitals>>,
    /// Its flows of protected messages.
    flows: Arc<Flows>,
}

struct Shared {
    tid: Tid,
    router: Arc<Router>,
    directory: Arc<dyn Directory>,
    pending: Arc<Pending>,
    sequence: AtomicU64,
    payload_max: usize,
}

impl std::fmt::Debug for Sender {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Sender({})", self.shared.tid)
    }
}

impl Sender {
    /// The sending side of `tid`. Payloads above `payload_max` bytes are refused.
    #[must_use]
    pub fn new(
        tid: Tid,
        router: Arc<Router>,
        directory: Arc<dyn Directory>,
        pending: Arc<Pending>,
        payload_max: usize,
    ) -> Self {
        let sequence = AtomicU64::new(0);
        let shared = Arc::new(Shared { tid, router, directory, pending, sequence, payload_max });
        Self { shared, life: None, flows: Arc::new(Flows::new(Time::now())) }
    }

    /// The same sending side for one life of its application: with that, it is over.
    #[must_use]
    pub(crate) fn in_life(&self, life: Arc<Vitals>) -> Self {
        Self { shared: self.shared.clone(), life: Some(life), flows: Arc::new(Flows::new(Time::now())) }
    }

    fn is_over(&self) -> bool {
        self.life.as_ref().is_some_and(|life| life.is_over())
    }

    /// Sequence of the last message that was sent from the TID, as far as this side of it knows.
    #[must_use]
    pub fn last_sequence(&self) -> u64 {
        self.shared.sequence.load(Ordering::Relaxed)
    }

    /// Another sending side of the TID, in another process that began behind the sequence `began`, has sent messages up to
    /// `last`: this one counts on from there. Returns whether that can be: a number that no process reaches in one life is
    /// not taken.
    pub fn count_on_from(&self, last: u64, began: u64) -> bool {
        let is_plausible = last <= began.saturating_add(SEQUENCES_PER_LIFE);
        if is_plausible {
            self.shared.sequence.fetch_max(last, Ordering::Relaxed);
        }
        is_plausible
    }

    /// The TID that this sends from.
    #[must_use]
    pub fn tid(&self) -> Tid {
        self.shared.tid
    }

    /// The TID that has `name` now, on any node.
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

    /// Makes this application a member of the group called `name`: what is sent to [`Tid::group`] reaches it. A name that breaks the
    /// grammar of [names](crate::name) is refused with an error in the log.
    pub fn join(&self, name: &str) {
        if let Err(why) = crate::name::check_name(name) {
            let group: String = name.escape_debug().take(crate::name::NAME_BYTES_MAX).collect();
            crate::log::error!(%group, %why, "the group is not joined: its name cannot be used");
            return;
        }
        self.set_member(name, true);
    }

    /// Ends the membership.
    pub fn leave(&self, name: &str) {
        self.set_member(name, false);
    }

    fn set_member(&self, name: &str, member: bool) {
        if !self.is_over() {
            self.shared.directory.set_member(self.shared.tid.app, AppAddress::group(name), member);
        }
    }

    /// Watches the present life of the application at `tid`, on any node: when it ends, its node is lost, or nobody has the
    /// TID, this application gets one [`Down`](crate::monitor::Down). The monitor ends with this application's own life.
    ///
    /// # Errors
    /// The TID is not that of an application, or the bounds of [`MonitorError`] are reached.
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

    /// Ends a monitor. `false` if it has spoken already: its [`Down`](crate::monitor::Down) may wait in the mailbox.
    #[must_use]
    pub fn demonitor(&self, monitor: MonitorId) -> bool {
        self.shared.directory.demonitor(self.shared.tid.app, monitor)
    }

    /// Sends a value, in the class of its type. Returns when a queue or a socket has taken it.
    ///
    /// # Errors
    /// Nobody took it.
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

    /// A value to be sent otherwise than as its type says, confirmed, or as a request: see [`MessageBuilder`].
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
        &'a self,
        to: impl Into<Destination<'a>>,
        value: &'a P,
    ) -> MessageBuilder<&'a Self, Value<'a, P>> {
        MessageBuilder::new(self, Value { destination: to.into(), value })
    }

    /// The same for memory that [`create_message`](Self::create_message) lent (the paper's SendMessage).
    pub const fn loaned(&self, buffer: MessageBuffer) -> MessageBuilder<&Self, MessageBuffer> {
        MessageBuilder::new(self, buffer)
    }

    /// Whether whoever asked still waits for the reply, as far as is known here: its deadline is not over, and it has not given
    /// up. For a handler that works long, or replies later: what nobody wants need not be done.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{app::Delivery, message::Sender};
    ///
    /// # struct Plan;
    /// fn is_to_go_on(sender: &Sender, request: &Delivery<Plan>) -> bool {
    ///     request.reply_to().is_some_and(|reply_to| sender.is_wanted(&reply_to))
    /// }
    /// ```
    #[must_use]
    pub fn is_wanted(&self, request: &ReplyTo) -> bool {
        let ReplyTo { source, correlation, sent, until } = *request;
        Time::now() <= until && !self.shared.pending.is_given_up(source, correlation, sent)
    }

    /// Replies to requests of this application that came when nobody waited for them any more, and were dropped.
    #[must_use]
    pub fn late_replies(&self) -> u64 {
        self.shared.pending.late_replies()
    }

    /// Answers a request.
    ///
    /// # Errors
    /// Nobody took the reply, or the message asked for none.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{app::Delivery, message::Sender, payload};
    ///
    /// payload!("demo.plan" => struct Plan;);
    /// payload!("demo.planned" => struct Planned { steps: u32 });
    ///
    /// /// Replies from a thread that has the time to plan.
    /// fn plan(sender: Sender, request: Delivery<Plan>) {
    ///     let Some(reply_to) = request.reply_to() else { return };
    ///     std::thread::spawn(move || sender.reply(reply_to, &Planned { steps: 12 }));
    /// }
    /// ```
    pub fn reply<R: Payload>(&self, to: ReplyTo, value: &R) -> Result<(), SendError> {
        let mut message = Message::typed(self.shared.tid, to.source, value);
        message.header.class = Class::Control;
        message.header.flags = Flags::REPLY;
        message.header.correlation = to.correlation;
        self.dispatch(message).map(drop)
    }

    /// Writable memory of `length` bytes for a raw payload of `kind` (the paper's CreateMessage).
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

    /// Sends a payload that was encoded before.
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

    /// A message of the value, in its envelope if its type is protected.
    fn typed<P: Payload>(&self, destination: Destination<'_>, value: &P) -> Result<Message, SendError> {
        let destination = self.find(destination)?;
        if P::PROTECTION.is_none() {
            return Ok(Message::of_type::<P>(self.shared.tid, destination, encode(value)));
        }
        let receiver = self.shared.router.absolute(destination);
        if !receiver.is_single() {
            // Each receiver has its own echo, and its own data_id.
            return Err(Rejection::Unsupported.into());
        }
        let payload = self.flows.seal(self.shared.tid, receiver, value, Time::now());
        let payload = payload.ok_or(SendError::TooManyProtectedFlows)?;
        Ok(Message::of_type::<P>(self.shared.tid, destination, payload))
    }

    /// The TID with its node spelled out.
    pub(crate) fn absolute(&self, tid: Tid) -> Tid {
        self.shared.router.absolute(tid)
    }

    /// The application refused a message that it had taken out of its mailbox: an unconfirmed one is reported to its sender.
    pub fn refused(&self, header: &Header, why: Rejection) {
        self.shared.router.report(self.shared.tid, header, why, 1);
    }

    /// A receiver of protected messages wants this time quoted.
    pub(crate) fn echoed(&self, from: Tid, echo: Echo) {
        self.flows.heard(from, echo);
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

    /// Returns how long it is waited for, too: no longer than the message lives.
    fn expect_answer(
        &self,
        message: &mut Message,
        awaited: Awaited,
        within: Duration,
    ) -> Result<(Wait, Duration), SendError> {
        let destination = self.shared.router.absolute(message.header.destination);
        let wait = self.shared.pending.open(awaited, destination).ok_or(SendError::TooManyWaits)?;
        let within = self.confirm_to(message, destination, &wait, within);
        Ok((wait, within))
    }

    /// The same for the outcomes of all members of a message to many.
    fn expect_each(&self, message: &mut Message, within: Duration) -> Result<(Wait, Duration), SendError> {
        let destination = self.shared.router.absolute(message.header.destination);
        let wait = self.shared.pending.open_each(destination, self.shared.router.node());
        let wait = wait.ok_or(SendError::TooManyWaits)?;
        let within = self.confirm_to(message, destination, &wait, within);
        Ok((wait, within))
    }

    /// Has the message confirmed to a wait.
    fn confirm_to(&self, message: &mut Message, destination: Tid, wait: &Wait, within: Duration) -> Duration {
        message.header.flags = message.header.flags.with(Flags::CONFIRM);
        message.header.correlation = wait.correlation();
        let within = message.header.limit_time_to_live(within);
        let ticket = Ticket { source: self.shared.tid, destination, correlation: wait.correlation() };
        message.receipt = Some(Receipt::new(self.shared.pending.clone(), ticket));
        within
    }

    /// Returns when it was sent.
    fn dispatch(&self, mut message: Message) -> Result<Time, SendError> {
        if self.is_over() {
            message.reject(Rejection::Closed);
            return Err(SendError::Over);
        }
        let kind = message.header.kind;
        if !kind.is_user() {
            // What layers say is asked of no guard, and ends a link where it makes no sense.
            message.reject(Rejection::UnknownKind);
            return Err(SendError::NotYours(kind));
        }
        if message.payload.len() > self.shared.payload_max {
            message.reject(Rejection::TooLong);
            return Err(Rejection::TooLong.into());
        }
        message.header.sequence = self.shared.sequence.fetch_add(1, Ordering::Relaxed).wrapping_add(1);
        let sent = Time::now();
        message.header.sent = sent;
        self.shared.router.send(message)?;
        Ok(sent)
    }
}

/// Where a reply goes: made from the request that it answers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ReplyTo {
    pub(crate) source: Tid,
    pub(crate) correlation: u64,
    pub(crate) sent: Time,
    pub(crate) until: Time,
}

impl ReplyTo {
    /// When whoever asked stops waiting, in this host's clock; [`Time::MAX`] if it never does.
    #[must_use]
    pub const fn deadline(&self) -> Time {
        self.until
    }
}
