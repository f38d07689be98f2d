//! One transport address of this process, with a connection of its own.

mod groups;
mod names;
mod ready;
mod unregister;

use std::{path::Path, pin::pin, time::Duration};

use sinew_protocol::payload::{self, Registered};
use sinew_runtime::{
    protection::Ends,
    sender::Destination,
    tid::{NodeAddress, Tid},
    time::Time,
    wire::{Header, Kind, Payload},
};
use sinew_shm::{Bell, WaitSet};
use tokio::task::coop;

use super::{
    ApiError, MessageBuilder, Received, Registration, Transport,
    barrier::Leaves,
    builder::{SendTerms, Value},
    direct::{Direct, Terms},
    inbox::Inbox,
    incoming::WhenFull,
    link::Link,
    loan::{Lender, LoanedMessage},
    node_link::NodeLink,
    only_message::Only,
    reconnect::Reconnect,
    requests::Requests,
    undelivered::Refusals,
    wait_mode::{WaitMode, block_ready},
};
pub(super) use groups::group_named;

/// Time limit for requests that the node answers at once.
const PROMPT: Duration = Duration::from_secs(2);
pub(super) const LNCL: Tid = payload::lncl_of(NodeAddress::HERE);

/// A registered transport address: sends and receives, from one thread at a time.
///
/// Dropping it releases the address at once; [`unregister`](Self::unregister) waits for the node's
/// confirmation.
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
    /// The connection to the node.
    pub(super) node: NodeLink,
    /// Links to other processes that bypass the node.
    pub(super) direct: Direct,
    pub(super) inbox: Inbox,
    /// Messages that no application has taken, as reported by the node, and those that this endpoint has
    /// refused.
    pub(super) refusals: Refusals,
    pub(super) requests: Requests,
    pub(super) reconnect: Reconnect,
    pub(super) wait_mode: WaitMode,
    pub(super) lender: Lender,
    /// The state of sent and received protected payloads.
    pub(super) ends: Ends,
    /// Time of the last request for names similar to an unknown one.
    pub(super) nearest_asked: Option<Time>,
    pub(super) leaves: Leaves,
    /// Whether the node supervises this program, and waits for [`ready`](Self::ready).
    pub(super) awaits_ready: bool,
}

impl std::fmt::Debug for Endpoint {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Endpoint({})", self.tid)
    }
}
impl Endpoint {
    pub(super) fn register(path: &Path, mut registration: Registration) -> Result<Self, ApiError> {
        if registration.link.direct_links.accepts() {
            // Without it, each link has its own bell, and the wait covers all of them.
            registration.link.bell = WaitSet::create().map_or(registration.link.bell, Bell::Set);
        }
        let link = registration.register_at(path, registration.deadline, || true)?;
        Ok(Self::new(path, registration, link, WaitMode::Blocking))
    }

    /// Returns an endpoint that is registered.
    pub(super) fn new(path: &Path, registration: Registration, link: Link, wait_mode: WaitMode) -> Self {
        let Registration { mut register, deadline: _, inbox_capacity, link: options, returning } =
            registration;
        let Link { registered, writer, reader } = link;
        let terms = Terms::of(&registered, &options, &writer);
        let Registered { node: address, app, node_name, payload_max, ring: _, types: _, ready } = registered;
        let control = reader.control().filter(|_| options.direct_links.accepts());
        let inbox = Inbox::new(Tid::new(address, app), inbox_capacity, payload_max as usize, writer.clone());
        register.former = Some(app);
        sinew_runtime::log::here!(debug: tid = %Tid::new(address, app), node = node_name, "registered");
        Self {
            tid: Tid::new(address, app),
            node_name,
            payload_max: payload_max as usize,
            node: NodeLink::new(writer, reader),
            direct: Direct::new(terms, control),
            inbox,
            refusals: Refusals::default(),
            requests: Requests::new(),
            reconnect: Reconnect::new(path.to_owned(), register, options, returning),
            wait_mode,
            lender: Lender::default(),
            ends: Ends::new(Time::now()),
            nearest_asked: None,
            leaves: Leaves::default(),
            awaits_ready: ready,
        }
    }

    /// Returns the registered address.
    #[must_use]
    pub const fn tid(&self) -> Tid {
        self.tid
    }

    /// Returns the transport of the messages: the requested one, or the socket if the system or the node has
    /// no rings.
    #[must_use]
    pub fn transport(&self) -> Transport {
        self.node.writer.transport()
    }

    /// Returns the name of the node.
    #[must_use]
    pub fn node_name(&self) -> &str {
        &self.node_name
    }

    /// Returns the longest payload that the node accepts, in bytes.
    #[must_use]
    pub const fn payload_max(&self) -> usize {
        self.payload_max
    }

    /// Lends writable memory of `length` bytes, all zeros, for a raw payload of `kind` (the paper's
    /// CreateMessage), in the ring itself if possible. Never waits. One message is lent at a time, and
    /// nothing else is sent until it is sent or dropped: see [`LoanedMessage`].
    ///
    /// # Errors
    /// The payload is longer than the node accepts, `kind` is one of the layers' own, or another message is
    /// lent ([`ApiError::LoanActive`]).
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

    /// Sends a value with the settings of its type; in an envelope if its type is
    /// [protected](sinew_runtime::protection), see [`guard`](Self::guard). The receiver may already have sent
    /// a `sinew.echo` message. An endpoint that has not sent it a protected message yet receives that echo;
    /// ignore it. Returns when the transport to the node, or the ring of a direct link, has accepted the
    /// message. For other settings see [`message`](Self::message).
    ///
    /// Each call looks a name up at the node, which costs a round trip: in a loop, resolve it once and send
    /// to the TID.
    ///
    /// # Errors
    /// The message was not sent. [`ApiError::UnknownName`]: no application has the name now.
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
        self.send_blocking(Value::new(to, value), SendTerms::PLAIN)
    }

    /// Returns a builder for a value with other settings than those of its type: confirmed, as a request, or
    /// with a limit on the wait for room. See [`MessageBuilder`].
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

    /// The same for memory that [`create_message`](Self::create_message) lent (the paper's SendMessage):
    /// without a copy if it lies in the ring. The memory may come from another endpoint: then
    /// [`ApiError::LoanActive`] if this one has lent memory, too.
    pub const fn loaned(&mut self, message: LoanedMessage) -> MessageBuilder<'_, Self, LoanedMessage> {
        MessageBuilder::new(self, message)
    }

    /// Answers a request. With a limit on the wait for room: [`MessageBuilder::reply_to`].
    ///
    /// # Errors
    /// The request does not ask for a reply, or the reply was not sent.
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
        block_ready(pin!(self.reply_as(request, Value::new(request.source(), value), SendTerms::PLAIN)))
    }

    /// Waits for a message, at most `within` this time; `None` if none arrived (the paper's ReceiveMessage).
    /// Control messages are first, then Stream, of which only the newest value of each source and kind is
    /// kept, then Bulk.
    ///
    /// When the connection has ended through no fault of this endpoint, it registers again. The first call
    /// returns [`ApiError::Disconnected`]; each later one waits for the node's return as for a message.
    ///
    /// # Errors
    /// The connection has ended, and all earlier messages were received.
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
        let deadline = now + within;
        match self.receive_only(deadline, now) {
            Ok(received) => Ok(received),
            Err(now) => block_ready(pin!(self.receive_until(deadline, now))),
        }
    }

    /// The clock is read once per poll: it costs as much as a poll.
    pub(super) async fn receive_until(
        &mut self,
        deadline: Time,
        mut now: Time,
    ) -> Result<Option<Received>, ApiError> {
        // The deadline bounds the wait. Data that has arrived by the first poll is taken; else a caller that
        // never waits would always be late because of frames that are not for the program.
        let mut left = None;
        loop {
            if !matches!(self.wait_mode, WaitMode::Blocking) {
                let arrived = self.look(now);
                match self.take_only(arrived, now) {
                    Only::Received(received) => return Ok(Some(received)),
                    Only::Nothing if now < deadline => {
                        self.wait(deadline, now).await;
                        now = Time::now();
                        continue;
                    }
                    Only::Nothing | Only::Other => {}
                }
            }
            // The socket first: newly arrived messages may be more urgent or newer than the waiting ones.
            self.poll_incoming(None, WhenFull::Leave, now)?;
            if self.leaves.has_pending() {
                self.send_leaves();
            }
            let echo_due = if self.ends.is_guarding() { self.echo(now).await } else { Time::MAX };
            let left = left.get_or_insert(self.inbox.len());
            if let Some(message) = self.inbox.pop(now) {
                if let Some(received) = self.received(message) {
                    return Ok(Some(received));
                }
                // A flood of such frames delays the caller little beyond its deadline.
                *left = left.saturating_sub(1);
                now = Time::now();
                if *left > 0 || now < deadline {
                    if matches!(self.wait_mode, WaitMode::Async(_)) {
                        // It also does not keep other tasks of the thread from running.
                        coop::consume_budget().await;
                    }
                    continue;
                }
            }
            let ended = self.node.ended.clone();
            if let Some(ended) = &ended {
                self.reconnect.report_end(ended)?;
            }
            // Checked here, because a flood keeps the link readable forever.
            if now >= deadline {
                return Ok(None);
            }
            match ended {
                Some(_) => self.await_reconnect(deadline).await,
                None => self.wait(deadline.min(echo_due), now).await,
            }
            now = Time::now();
        }
    }

    /// Returns how often this endpoint has registered: 1, and one more for each reconnection. The address may
    /// have changed since then if another application has got the former one.
    #[must_use]
    pub const fn registrations(&self) -> u64 {
        self.reconnect.registrations
    }
}
