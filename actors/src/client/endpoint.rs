//! One transport address of this process, with a connection of its own.

use std::{path::Path, sync::Arc, time::Duration};

use sinew_runtime::{
    name::{NAME_BYTES_MAX, check_name},
    outcome::{Outcome, Rejection},
    protection::Ends,
    sender::Destination,
    tid::{AppAddress, NodeAddress, Tid},
    time::Time,
    wire::{Flags, Header, Kind, Message, Payload},
};
use sinew_shm::{Bell, CommonBell};
use tokio::task::coop;

use super::{
    ApiError, MessageBuilder, Received, Registration, Transport,
    barrier::Leaves,
    builder::{SendTerms, Value},
    direct::{Direct, Terms},
    form::{Form, at_once},
    inbox::{Answer, Awaited, Inbox},
    incoming::WhenFull,
    link::{Ended, Link, Reader, Writer, ring::Rest},
    loan::{Lender, LoanedMessage},
    returning::Home,
    undelivered::Refusals,
};
use crate::lncl::payload::{self, Group, Registered, Resolve};

/// Time that the node has to answer what it answers at once.
const PROMPT: Duration = Duration::from_secs(2);
/// Time that what waits for room on direct links has to find it when an endpoint is dropped by a thread.
const PARTING: Duration = Duration::from_millis(20);
/// Time between two questions for names that are similar to one that nobody has.
const NEAREST_AGAIN: Duration = Duration::from_secs(1);
pub(super) const LNCL: Tid = payload::lncl_of(NodeAddress::HERE);

/// A registered transport address: sends and receives, from one thread at a time.
///
/// Dropping it gives the address back at once; [`unregister`](Self::unregister) waits until the node has taken it.
///
/// # Examples
///
/// ```no_run
/// use std::time::Duration;
///
/// use sinew::{NodeApi, Registration, payload};
///
/// payload!("demo.angle", Stream, expires_after = 20 ms => struct Angle { degrees: f32 });
///
/// let node = NodeApi::connect("/run/sinew/knee.sock")?;
/// let mut sensor = node.register_transport_address(Registration::new().requires(["knee.drive"]))?;
/// let drive = sensor.resolve("knee.drive", Duration::from_secs(1))?.expect("it was required");
/// for number in 0..10_u8 {
///     sensor.send(drive, &Angle { degrees: f32::from(number) })?;
///     std::thread::sleep(Duration::from_millis(10));
/// }
/// # Ok::<(), sinew::client::ApiError>(())
/// ```
pub struct Endpoint {
    pub(super) tid: Tid,
    pub(super) node_name: String,
    pub(super) payload_max: usize,
    pub(super) writer: Arc<Writer>,
    pub(super) reader: Reader,
    /// Links to other processes that the node is not on the way of.
    pub(super) direct: Direct,
    pub(super) inbox: Inbox,
    /// What the node has said of messages that nobody has taken, and what this endpoint has refused.
    pub(super) refusals: Refusals,
    pub(super) sequence: u64,
    pub(super) correlation: u64,
    /// Why the connection has ended, once it has.
    pub(super) ended: Option<Ended>,
    pub(super) home: Home,
    pub(super) form: Form,
    pub(super) lender: Lender,
    /// What it sends and receives of protected payloads.
    pub(super) ends: Ends,
    /// What is left of a frame of which a part is in the ring to the node.
    pub(super) rest: Option<Rest>,
    /// What the node had taken when a sender's stall timeout with it was over.
    pub(super) stalled: Option<u32>,
    /// The number of its last request.
    pub(super) asked: u64,
    /// When it last asked for names that are similar to one that nobody has.
    pub(super) nearest_asked: Option<Time>,
    pub(super) leaves: Leaves,
}

impl std::fmt::Debug for Endpoint {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Endpoint({})", self.tid)
    }
}
impl Endpoint {
    pub(super) fn register(path: &Path, mut registration: Registration) -> Result<Self, ApiError> {
        if registration.register.direct {
            // Without it there is a bell for each link, which are slept at together.
            registration.link.bell = CommonBell::create().map_or(registration.link.bell, Bell::Common);
        }
        let link = registration.greet(path, registration.deadline, || true)?;
        Ok(Self::new(path, registration, link, Form::Thread))
    }

    /// One that is registered.
    pub(super) fn new(path: &Path, registration: Registration, link: Link, form: Form) -> Self {
        let Registration { mut register, deadline: _, inbox_capacity, link: options, returning } =
            registration;
        let Link { registered, writer, reader } = link;
        let terms = Terms::of(&registered, &options);
        let Registered { node, app, node_name, payload_max, ring: _ } = registered;
        let control = reader.control().filter(|_| register.direct);
        let inbox = Inbox::new(Tid::new(node, app), inbox_capacity, payload_max as usize, writer.clone());
        register.former = Some(app);
        crate::log::here!(debug: tid = %Tid::new(node, app), node = node_name, "registered");
        Self {
            tid: Tid::new(node, app),
            node_name,
            payload_max: payload_max as usize,
            writer,
            reader,
            direct: Direct::new(terms, control),
            inbox,
            refusals: Refusals::default(),
            sequence: 0,
            // The outcome of a former life's message must not be taken for one of this: no number comes again.
            correlation: Time::now().as_nanos(),
            ended: None,
            home: Home::new(path.to_owned(), register, options, returning),
            form,
            lender: Lender::default(),
            ends: Ends::new(Time::now()),
            rest: None,
            stalled: None,
            asked: 0,
            nearest_asked: None,
            leaves: Leaves::default(),
        }
    }

    /// The address that was registered.
    #[must_use]
    pub const fn tid(&self) -> Tid {
        self.tid
    }

    /// What carries the messages: what was asked for, or the socket where the system or the node has no rings.
    #[must_use]
    pub fn transport(&self) -> Transport {
        self.writer.transport()
    }

    /// The name of the node.
    #[must_use]
    pub fn node_name(&self) -> &str {
        &self.node_name
    }

    /// Longest payload that the node takes, in bytes.
    #[must_use]
    pub const fn payload_max(&self) -> usize {
        self.payload_max
    }

    /// Writable memory of `length` bytes, all zeros, for a raw payload of `kind` (the paper's CreateMessage): in the ring
    /// itself where that is possible. Never waits. One message is lent at a time, and nothing else goes out until it is sent or
    /// dropped: see [`LoanedMessage`].
    ///
    /// # Errors
    /// It would be longer than the node takes, `kind` is one of the layers' own, or another message is lent
    /// ([`ApiError::LoanActive`]).
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{Endpoint, Tid, client::ApiError, message::Kind};
    ///
    /// /// Sends an image without a copy, where there is room for it in the ring.
    /// fn send_image(endpoint: &mut Endpoint, to: Tid, pixels: &[u8]) -> Result<(), ApiError> {
    ///     let mut image = endpoint.create_message(to, Kind::named("camera.image"), pixels.len())?;
    ///     image.copy_from_slice(pixels);
    ///     endpoint.loaned(image).send()
    /// }
    /// ```
    pub fn create_message(
        &mut self,
        destination: Tid,
        kind: Kind,
        length: usize,
    ) -> Result<LoanedMessage, ApiError> {
        self.check_length(length)?;
        if !kind.is_user() {
            return Err(ApiError::NotYours(kind));
        }
        self.lend(Header::new(kind, self.tid, destination), length)
    }

    /// Sends a value as its type says; in an envelope if its type is [protected](crate::protection), see [`guard`](Self::guard).
    /// Whoever guards that may have sent an echo before: a message of kind `sinew.echo`, which who has sent nothing protected to it yet receives, and leaves alone.
    /// Returns when the way to the node, or the ring of a direct link, has taken it. For anything else see [`message`](Self::message).
    ///
    /// A name is looked up by the node with each call, which costs a round trip to it: a loop resolves it once, and sends to the TID.
    ///
    /// # Errors
    /// It was not sent. [`ApiError::UnknownName`]: no application has the name now.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{Endpoint, Tid, client::ApiError, payload};
    ///
    /// payload!("demo.stop" => struct Stop;);
    ///
    /// fn stop(endpoint: &mut Endpoint) -> Result<(), ApiError> {
    ///     endpoint.send(Tid::group("drives"), &Stop)
    /// }
    /// ```
    pub fn send<'a, P: Payload>(
        &mut self,
        to: impl Into<Destination<'a>>,
        value: &'a P,
    ) -> Result<(), ApiError> {
        at_once(self.send_as(Value::new(to, value), SendTerms::PLAIN))
    }

    /// A value to be sent otherwise than as its type says, confirmed, as a request, or with a limit to the wait for room: see
    /// [`MessageBuilder`].
    ///
    /// # Examples
    ///
    /// ```
    /// use std::time::Duration;
    ///
    /// use sinew::{Endpoint, Outcome, Tid, client::ApiError, payload};
    ///
    /// payload!("demo.calibrate" => struct Calibrate { zero_degrees: f32 });
    ///
    /// fn calibrate(endpoint: &mut Endpoint, drive: Tid) -> Result<bool, ApiError> {
    ///     let command = Calibrate { zero_degrees: 0.5 };
    ///     let outcome = endpoint.message(drive, &command).confirmed(Duration::from_secs(1))?;
    ///     Ok(outcome == Outcome::Delivered)
    /// }
    /// ```
    pub fn message<'a, P: Payload>(
        &'a mut self,
        to: impl Into<Destination<'a>>,
        value: &'a P,
    ) -> MessageBuilder<'a, Self, Value<'a, P>> {
        MessageBuilder::new(self, Value::new(to, value))
    }

    /// The same for memory that [`create_message`](Self::create_message) lent (the paper's SendMessage): without a copy if it lies in the ring.
    /// It may have been another endpoint's: then [`ApiError::LoanActive`] if this one has lent one too.
    pub const fn loaned(&mut self, message: LoanedMessage) -> MessageBuilder<'_, Self, LoanedMessage> {
        MessageBuilder::new(self, message)
    }

    /// Answers a request. With a limit to the wait for room: [`MessageBuilder::reply_to`].
    ///
    /// # Errors
    /// The message asks for no reply, or the reply was not sent.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{Endpoint, Payload, client::{ApiError, Received}, payload};
    ///
    /// payload!("demo.ask_angle" => struct AskAngle;);
    /// payload!("demo.angle" => struct Angle { degrees: f32 });
    ///
    /// fn answer(endpoint: &mut Endpoint, request: &Received, degrees: f32) -> Result<(), ApiError> {
    ///     if request.kind() == AskAngle::KIND && request.wants_reply() {
    ///         endpoint.reply(request, &Angle { degrees })?;
    ///     }
    ///     Ok(())
    /// }
    /// ```
    pub fn reply<R: Payload>(&mut self, request: &Received, value: &R) -> Result<(), ApiError> {
        at_once(self.reply_as(request, Value::new(request.source(), value), SendTerms::PLAIN))
    }

    /// Waits for a message, at most `within` this time; `None` if none came (the paper's ReceiveMessage). Control
    /// comes first, then Stream, of which only the newest value of each source and kind, then Bulk.
    ///
    /// When the connection has ended, through no fault of this endpoint, it registers again: the first call says so with
    /// [`ApiError::Disconnected`], each later one waits for the node's return as for a message.
    ///
    /// # Errors
    /// The connection has ended, and everything that came before was received.
    ///
    /// # Examples
    ///
    /// ```
    /// use std::time::Duration;
    ///
    /// use sinew::{Endpoint, Payload, client::ApiError, payload};
    ///
    /// payload!("demo.setpoint", Stream => struct Setpoint { degrees: f32 });
    ///
    /// /// One turn of a control loop: takes what has come, and does not wait.
    /// fn take_setpoint(endpoint: &mut Endpoint, setpoint: &mut f32) -> Result<(), ApiError> {
    ///     while let Some(received) = endpoint.receive(Duration::ZERO)? {
    ///         if received.kind() == Setpoint::KIND {
    ///             *setpoint = received.decode::<Setpoint>()?.degrees;
    ///         }
    ///     }
    ///     Ok(())
    /// }
    /// ```
    pub fn receive(&mut self, within: Duration) -> Result<Option<Received>, ApiError> {
        let now = Time::now();
        at_once(self.receive_until(now + within, now))
    }

    /// The clock is read once for each look: it costs as much as a look.
    pub(super) async fn receive_until(
        &mut self,
        deadline: Time,
        mut now: Time,
    ) -> Result<Option<Received>, ApiError> {
        // The deadline bounds waiting. What is there at the first look is taken, or who never waits would be late for ever with what is not
        // for the program.
        let mut left = None;
        loop {
            // The socket first: what came just now may be more urgent or newer than what waits.
            self.take_in(None, WhenFull::Leave, now)?;
            if self.leaves.are_to_be_told() {
                self.tell_leaves();
            }
            let echo_due = self.echo(now).await;
            let left = left.get_or_insert(self.inbox.len());
            if let Some(message) = self.inbox.pop(now) {
                if let Some(received) = self.received(message) {
                    return Ok(Some(received));
                }
                // A flood of that keeps nobody much beyond its deadline.
                *left = left.saturating_sub(1);
                now = Time::now();
                if *left > 0 || now < deadline {
                    if matches!(self.form, Form::Reactor(_)) {
                        // Nor other tasks of the thread from their turn.
                        coop::consume_budget().await;
                    }
                    continue;
                }
            }
            let ended = self.ended.clone();
            if let Some(ended) = &ended {
                self.tell(ended)?;
            }
            // The clock is asked by us: a flood keeps the link readable for ever.
            if now >= deadline {
                return Ok(None);
            }
            match ended {
                Some(_) => self.await_return(deadline).await,
                None => self.wait(deadline.min(echo_due), now).await,
            }
            now = Time::now();
        }
    }

    /// How often this endpoint has registered: 1, and one more each time that it came back after its connection had
    /// ended. Its address may be another one since then if somebody else has got the former one.
    #[must_use]
    pub const fn registrations(&self) -> u64 {
        self.home.registrations
    }

    /// Joins the group called `name`: what is sent to [`Tid::group`] reaches this endpoint from now on.
    ///
    /// # Errors
    /// It is a member of 256 groups already, or its user or node has as many memberships as it may ([`ApiError::TooManyGroups`]); the node's access
    /// list does not let its user join this one ([`ApiError::Ended`], `NotAllowed`); or the node did not answer.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{Endpoint, client::ApiError};
    ///
    /// /// From now on messages to `Tid::group("drives")` come here, too.
    /// fn join_drives(endpoint: &mut Endpoint) -> Result<(), ApiError> {
    ///     endpoint.join("drives")
    /// }
    /// ```
    pub fn join(&mut self, name: &str) -> Result<(), ApiError> {
        at_once(self.set_member(group_named(name)?, true))
    }

    /// Leaves the group called `name`.
    ///
    /// # Errors
    /// The node did not answer.
    pub fn leave(&mut self, name: &str) -> Result<(), ApiError> {
        at_once(self.set_member(AppAddress::group(name), false))
    }

    /// The TID that has `name` now, on any node; `None` if nobody has it.
    ///
    /// # Errors
    /// The node did not answer `within` this time.
    ///
    /// # Examples
    ///
    /// ```
    /// use std::time::Duration;
    ///
    /// use sinew::{Endpoint, Tid, client::ApiError};
    ///
    /// fn find_knee(endpoint: &mut Endpoint) -> Result<Option<Tid>, ApiError> {
    ///     endpoint.resolve("knee.drive", Duration::from_millis(100))
    /// }
    /// ```
    pub fn resolve(&mut self, name: &str, within: Duration) -> Result<Option<Tid>, ApiError> {
        at_once(self.look_up(name, within))
    }

    pub(super) async fn look_up(&mut self, name: &str, within: Duration) -> Result<Option<Tid>, ApiError> {
        let asked = Resolve { name: name.to_owned(), nearest: false };
        self.ask_for_name(&asked, within).await.map(|(tid, _)| tid)
    }

    /// The TID of a name for a send. Where nobody has it the error has names that are similar, once in [`NEAREST_AGAIN`]: to find them takes the
    /// node's time, and a loop may send to a name that is away.
    pub(super) async fn find_named(&mut self, name: &str, within: Duration) -> Result<Tid, ApiError> {
        let now = Time::now();
        let nearest = self.nearest_asked.is_none_or(|asked| now.since(asked) >= NEAREST_AGAIN);
        let asked = Resolve { name: name.to_owned(), nearest };
        let (tid, nearest) = self.ask_for_name(&asked, within).await?;
        if tid.is_none() && asked.nearest {
            self.nearest_asked = Some(now);
        }
        tid.ok_or(ApiError::UnknownName { name: asked.name, nearest })
    }

    async fn ask_for_name(
        &mut self,
        asked: &Resolve,
        within: Duration,
    ) -> Result<(Option<Tid>, Vec<String>), ApiError> {
        let message = payload::frame(Kind::LNCL_RESOLVE, self.tid, LNCL, asked);
        match self.request(message.into(), Awaited::Resolved, Flags::NONE, within).await? {
            Some(Answer::Resolved(tid, nearest)) => Ok((tid, nearest)),
            Some(Answer::Outcome(_) | Answer::Members(_) | Answer::Reply(_)) | None => {
                Err(ApiError::NoAnswer(within))
            }
        }
    }

    /// Gives the address back and waits until the node has taken it, 2 s at most: the name is free when this returns.
    ///
    /// # Errors
    /// The node did not answer, or a message is lent ([`ApiError::LoanActive`]). The address is given back in any case.
    pub fn unregister(mut self) -> Result<(), ApiError> {
        at_once(self.take_leave())
    }

    pub(super) async fn take_leave(&mut self) -> Result<(), ApiError> {
        self.inbox.close();
        let deadline = Time::now() + PROMPT;
        self.part(self.home.options.stall_timeout.min(PROMPT)).await;
        if self.ended.is_some() {
            // The connection has taken the address with it.
            return Ok(());
        }
        self.lender.be_free()?;
        // It may go on just now.
        self.stalled = None;
        let goodbye = Message::new(Header::new(Kind::LNCL_UNREGISTER, self.tid, LNCL), bytes::Bytes::new());
        let limit = self.stall_timeout().and_in_all(deadline.since(Time::now()));
        self.write(goodbye.into(), limit).await?;
        while self.ended.is_none() {
            self.take_in(None, WhenFull::Refuse, Time::now())?;
            self.inbox.close();
            if self.ended.is_some() {
                break;
            }
            if Time::now() >= deadline {
                return Err(ApiError::NoAnswer(PROMPT));
            }
            self.wait(deadline, Time::now()).await;
        }
        Ok(())
    }

    pub(super) async fn set_member(&mut self, group: AppAddress, member: bool) -> Result<(), ApiError> {
        let message = payload::frame(Kind::LNCL_GROUP, self.tid, LNCL, &Group { group, member });
        match self.request(message.into(), Awaited::Outcome, Flags::CONFIRM, PROMPT).await? {
            Some(Answer::Outcome(Outcome::Delivered)) => {
                if member {
                    self.home.groups.insert(group);
                } else {
                    self.home.groups.remove(&group);
                }
                Ok(())
            }
            Some(Answer::Outcome(Outcome::Rejected(Rejection::QueueFull))) => Err(ApiError::TooManyGroups),
            Some(Answer::Outcome(outcome)) => Err(ApiError::Ended(outcome)),
            Some(Answer::Members(_) | Answer::Reply(_) | Answer::Resolved(..)) | None => {
                Err(ApiError::NoAnswer(PROMPT))
            }
        }
    }
}

impl Drop for Endpoint {
    fn drop(&mut self) {
        // What has come and was not looked at is refused, too. An error ends the connection, as this does.
        let _ = self.take_in(None, WhenFull::Refuse, Time::now());
        self.inbox.close();
        if matches!(self.form, Form::Thread) {
            at_once(self.part(PARTING));
        }
        self.direct.flush();
        self.direct.tell_unsent();
        // A message that is still in some thread's hand ends as `Failed`.
        self.writer.close();
    }
}
/// The address of the group of this name.
///
/// # Errors
/// The name breaks the grammar of names.
pub(super) fn group_named(name: &str) -> Result<AppAddress, ApiError> {
    let beginning = || name.chars().take(NAME_BYTES_MAX).collect();
    check_name(name).map_err(|why| ApiError::BadName { name: beginning(), why })?;
    Ok(AppAddress::group(name))
}
