//! One builder for all messages that an endpoint sends, of a thread or of a task.

use std::{fmt, time::Duration};

use sinew_runtime::{
    outcome::{MemberOutcome, Outcome},
    sender::Destination,
    tid::Tid,
    wire::{Class, Header, Message, Payload},
};

use super::{
    ApiError, AsyncEndpoint, Endpoint, LoanedMessage, Received, form::at_once, loan::Draft,
    outgoing::Request, stall_timeout::Limit,
};

/// A message to be sent: made by `message` or `loaned` of an [`Endpoint`] or an [`AsyncEndpoint`].
///
/// What it does not say is as its type and its endpoint say. It is sent by [`send`](Self::send), [`confirmed`](Self::confirmed),
/// [`confirmed_by_each`](Self::confirmed_by_each), [`ask`](Self::ask) or [`reply_to`](Self::reply_to), and not before.
///
/// # Examples
///
/// ```no_run
/// # use std::time::Duration;
/// # use sinew::{Endpoint, Tid, client::ApiError};
/// # sinew::payload!("doc.setpoint", Stream => struct Setpoint { degrees: f32 });
/// # fn step(endpoint: &mut Endpoint, drive: Tid, setpoint: &Setpoint, skipped: &mut u32) -> Result<(), ApiError> {
/// match endpoint.message(drive, setpoint).room_within(Duration::from_micros(200)).send() {
///     Ok(()) => {}
///     Err(ApiError::Stalled(_)) => *skipped += 1,
///     Err(other) => return Err(other),
/// }
/// # Ok(())
/// # }
/// ```
#[must_use = "a message is sent by `send`, `confirmed`, `confirmed_by_each`, `ask` or `reply_to`"]
pub struct MessageBuilder<'a, E, C> {
    endpoint: &'a mut E,
    content: C,
    terms: SendTerms,
}

/// What one call says of its message, beside what its type and its endpoint say.
#[derive(Clone, Copy, Debug)]
pub(super) struct SendTerms {
    room_within: Option<Duration>,
    expires_after: Option<Duration>,
    class: Option<Class>,
}

/// A value and its destination.
#[derive(Debug)]
pub struct Value<'a, P> {
    destination: Destination<'a>,
    value: &'a P,
}

impl<'a, P> Value<'a, P> {
    pub(super) fn new(to: impl Into<Destination<'a>>, value: &'a P) -> Self {
        Self { destination: to.into(), value }
    }
}

/// What is sent: a [`Value`], or a [`LoanedMessage`].
#[expect(
    private_interfaces,
    private_bounds,
    reason = "sealed: nobody but this module implements or calls it"
)]
pub trait Content {
    /// The message, once its destination is known.
    fn into_draft(
        self,
        endpoint: &mut Endpoint,
        limit: Limit,
    ) -> impl Future<Output = Result<Draft, ApiError>>;

    /// The same for a request or a reply, of which nothing is sealed.
    fn into_unsealed(
        self,
        endpoint: &mut Endpoint,
        limit: Limit,
    ) -> impl Future<Output = Result<Draft, ApiError>>;
}

#[expect(private_interfaces, reason = "sealed: nobody but this module implements or calls it")]
impl<P: Payload> Content for Value<'_, P> {
    async fn into_draft(self, endpoint: &mut Endpoint, limit: Limit) -> Result<Draft, ApiError> {
        let to = endpoint.find(self.destination, limit).await?;
        Ok(endpoint.typed(to, self.value, limit)?.into())
    }

    async fn into_unsealed(self, endpoint: &mut Endpoint, limit: Limit) -> Result<Draft, ApiError> {
        const { assert!(P::PROTECTION.is_none(), "a protected payload is sent, not asked for or replied") };
        let to = endpoint.find(self.destination, limit).await?;
        Ok(Message::typed(endpoint.tid(), to, self.value).into())
    }
}

#[expect(private_interfaces, reason = "sealed: nobody but this module implements or calls it")]
impl Content for LoanedMessage {
    async fn into_draft(self, _: &mut Endpoint, _: Limit) -> Result<Draft, ApiError> {
        Ok(self.into())
    }

    async fn into_unsealed(self, _: &mut Endpoint, _: Limit) -> Result<Draft, ApiError> {
        Ok(self.into())
    }
}

impl SendTerms {
    /// Nothing is said.
    pub(super) const PLAIN: Self = Self { room_within: None, expires_after: None, class: None };

    /// How long a send waits for room.
    fn limit(&self, endpoint: &Endpoint) -> Limit {
        self.room_within.map_or_else(|| endpoint.stall_timeout(), Limit::in_all)
    }

    fn apply(&self, header: &mut Header) {
        if let Some(class) = self.class {
            header.class = class;
        }
        if let Some(time) = self.expires_after {
            // An unconfirmed message is not waited for.
            let _ = header.set_time_to_live(time);
        }
    }
}

impl Endpoint {
    pub(super) async fn send_as(&mut self, content: impl Content, terms: SendTerms) -> Result<(), ApiError> {
        let limit = terms.limit(self);
        let mut draft = content.into_draft(self, limit).await?;
        terms.apply(&mut draft.header);
        self.dispatch(draft, limit).await.map(drop)
    }

    pub(super) async fn reply_as(
        &mut self,
        request: &Received,
        content: impl Content,
        terms: SendTerms,
    ) -> Result<(), ApiError> {
        let limit = terms.limit(self);
        let request = Request::of(request, self.tid())?;
        let mut draft = content.into_unsealed(self, limit).await?;
        terms.apply(&mut draft.header);
        self.answer(request, draft, limit).await
    }

    async fn confirm_as(
        &mut self,
        content: impl Content,
        terms: SendTerms,
        within: Duration,
    ) -> Result<Outcome, ApiError> {
        let limit = terms.limit(self);
        let mut draft = content.into_draft(self, limit).await?;
        terms.apply(&mut draft.header);
        self.confirm(draft, limit, within).await
    }

    async fn confirm_by_each_as(
        &mut self,
        content: impl Content,
        terms: SendTerms,
        within: Duration,
    ) -> Result<Vec<MemberOutcome>, ApiError> {
        let limit = terms.limit(self);
        let mut draft = content.into_draft(self, limit).await?;
        terms.apply(&mut draft.header);
        self.confirm_by_each(draft, limit, within).await
    }

    async fn ask_as(
        &mut self,
        content: impl Content,
        terms: SendTerms,
        within: Duration,
    ) -> Result<Received, ApiError> {
        let limit = terms.limit(self);
        let mut draft = content.into_unsealed(self, limit).await?;
        terms.apply(&mut draft.header);
        self.await_reply(draft, limit, within).await.map(Received::new)
    }

    /// The TID of a destination: a name is looked up, for as long as the send may wait for room.
    async fn find(&mut self, destination: Destination<'_>, limit: Limit) -> Result<Tid, ApiError> {
        match destination {
            Destination::Tid(tid) => Ok(tid),
            Destination::Name(name) => self.find_named(name, limit.time()).await,
        }
    }
}

impl<E, C> fmt::Debug for MessageBuilder<'_, E, C> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "MessageBuilder({:?})", self.terms)
    }
}

impl<'a, E, C> MessageBuilder<'a, E, C> {
    pub(super) const fn new(endpoint: &'a mut E, content: C) -> Self {
        Self { endpoint, content, terms: SendTerms::PLAIN }
    }

    /// Waits for room so long at most, instead of the endpoint's stall timeout; with [`Duration::ZERO`] it does not wait at all, and makes no
    /// system call that could. For a loop with a period: a message that finds no room is skipped.
    ///
    /// Where there is no room in time that is [`ApiError::Stalled`], and nothing of the message is received. One that is longer than half
    /// the ring goes out in pieces; if the last one finds no room in time the others are taken back. So a loop without time sends nothing
    /// that is longer than the ring. Only from a plain socket nothing can be taken back: there a message is sent when its first byte is,
    /// and the rest follows with later calls, ahead of all that is sent then.
    ///
    /// Such a send does not look for a node that has gone, since to register takes time: it says [`ApiError::Disconnected`], and
    /// [`Endpoint::receive`], or a send without a time, brings the endpoint back.
    ///
    /// # Examples
    ///
    /// ```
    /// use std::time::Duration;
    ///
    /// use sinew::{Endpoint, Tid, client::ApiError, payload};
    ///
    /// payload!("demo.setpoint", Stream => struct Setpoint { degrees: f32 });
    ///
    /// /// Sends without a wait; returns whether there was room.
    /// fn try_send(endpoint: &mut Endpoint, drive: Tid, setpoint: &Setpoint) -> Result<bool, ApiError> {
    ///     match endpoint.message(drive, setpoint).room_within(Duration::ZERO).send() {
    ///         Ok(()) => Ok(true),
    ///         Err(ApiError::Stalled(_)) => Ok(false),
    ///         Err(other) => Err(other),
    ///     }
    /// }
    /// ```
    pub const fn room_within(mut self, time: Duration) -> Self {
        self.terms.room_within = Some(time);
        self
    }

    /// Has it expire where it waits when it is older than this, instead of its type's [`TIME_TO_LIVE`](Payload::TIME_TO_LIVE). At most
    /// [`TIME_TO_LIVE_MAX`](sinew_runtime::wire::TIME_TO_LIVE_MAX), 71 minutes and 35 s: a longer time counts as that.
    ///
    /// # Examples
    ///
    /// ```
    /// use std::time::Duration;
    ///
    /// use sinew::{Endpoint, Tid, client::ApiError, payload};
    ///
    /// payload!("demo.step" => struct Step { metres: f32 });
    ///
    /// fn step(endpoint: &mut Endpoint, gait: Tid) -> Result<(), ApiError> {
    ///     endpoint.message(gait, &Step { metres: 0.3 }).expires_after(Duration::from_millis(50)).send()
    /// }
    /// ```
    pub const fn expires_after(mut self, time: Duration) -> Self {
        self.terms.expires_after = Some(time);
        self
    }

    /// The class in which it travels, instead of its type's; a request and a reply are Control.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{Class, Endpoint, Tid, client::ApiError, payload};
    ///
    /// payload!("demo.sample", Stream => struct Sample { newtons: f32 });
    ///
    /// /// Sends each sample of a record: as Bulk none takes the place of another, and none delays commands.
    /// fn send_record(endpoint: &mut Endpoint, to: Tid, record: &[Sample]) -> Result<(), ApiError> {
    ///     record.iter().try_for_each(|sample| endpoint.message(to, sample).class(Class::Bulk).send())
    /// }
    /// ```
    pub const fn class(mut self, class: Class) -> Self {
        self.terms.class = Some(class);
        self
    }
}

impl<C: Content> MessageBuilder<'_, Endpoint, C> {
    /// Sends it, and does not ask what becomes of it. Returns when the ring, or the socket to the node, has it;
    /// [`take_undelivered`](Endpoint::take_undelivered) says if no application takes it then.
    ///
    /// # Errors
    /// It was not sent, and loaned memory is given back. [`ApiError::Stalled`]: there was no room in time.
    pub fn send(self) -> Result<(), ApiError> {
        at_once(self.endpoint.send_as(self.content, self.terms))
    }

    /// Sends it and waits for its outcome: [`Outcome::Unknown`] when none has come `within` this
    /// time. The message expires where it waits when it is older. A longer `within` than
    /// [`TIME_TO_LIVE_MAX`](sinew_runtime::wire::TIME_TO_LIVE_MAX), 71 minutes and 35 s, counts as that. Messages that come meanwhile wait to be
    /// [received](Endpoint::receive), beyond the inbox's capacity too: 16,384 of each class, 4 MiB of payloads and one message. What
    /// comes then is refused: the senders of confirmed ones get that outcome, the others are [counted](Endpoint::take_undelivered). The same
    /// holds for all calls that wait for an answer: [`ask`](Self::ask), [`resolve`](Endpoint::resolve), [`join`](Endpoint::join),
    /// [`leave`](Endpoint::leave).
    ///
    /// With less than 20 ms a node that has gone is not looked for: [`receive`](Endpoint::receive) does.
    ///
    /// # Errors
    /// It was not sent; a group or a broadcast has no outcome of its own ([`ApiError::ToMany`]). If the connection ends before the outcome is
    /// known that is [`Outcome::Unknown`].
    ///
    /// # Examples
    ///
    /// ```
    /// use std::time::Duration;
    ///
    /// use sinew::{Endpoint, Outcome, Tid, client::ApiError, payload};
    ///
    /// payload!("demo.home" => struct Home;);
    ///
    /// fn home(endpoint: &mut Endpoint, drive: Tid) -> Result<(), ApiError> {
    ///     match endpoint.message(drive, &Home).confirmed(Duration::from_secs(5))? {
    ///         Outcome::Delivered => println!("homed"),
    ///         outcome => println!("not homed: {outcome:?}"),
    ///     }
    ///     Ok(())
    /// }
    /// ```
    pub fn confirmed(self, within: Duration) -> Result<Outcome, ApiError> {
        at_once(self.endpoint.confirm_as(self.content, self.terms, within))
    }

    /// Sends it to a group, to every application ([`Tid::BROADCAST`]) or to an address on all nodes, and waits for what becomes of it at each
    /// member: one [`MemberOutcome`] for each that is known when the message arrives at its node, without this endpoint. Returns as soon as the
    /// last one is settled, and at the latest `within` this time. A member that has no outcome by then has [`Outcome::Unknown`], as have all
    /// members of a node that is lost, or of all nodes where the connection ends. A node that has not named its members has one entry for them.
    /// A group without members gives an empty list.
    ///
    /// At most 256 members of one node and 256 other nodes are reached. The message expires where it waits, and what comes meanwhile waits, as
    /// with [`confirmed`](Self::confirmed).
    ///
    /// # Examples
    ///
    /// ```no_run
    /// use std::time::Duration;
    ///
    /// use sinew::{Endpoint, Outcome, Tid, client::ApiError};
    ///
    /// sinew::payload!("doc.stop" => struct Stop;);
    ///
    /// /// Stops all drives; returns those that may still move.
    /// fn stop(endpoint: &mut Endpoint) -> Result<Vec<Tid>, ApiError> {
    ///     let drives = endpoint.message(Tid::group("drives"), &Stop).confirmed_by_each(Duration::from_millis(50))?;
    ///     let failed = drives.into_iter().filter(|drive| drive.outcome != Outcome::Delivered);
    ///     Ok(failed.map(|drive| drive.tid).collect())
    /// }
    /// ```
    ///
    /// # Errors
    /// No member has a copy: it was not sent, it is of class Stream, its node is not known, or it has too many members.
    pub fn confirmed_by_each(self, within: Duration) -> Result<Vec<MemberOutcome>, ApiError> {
        at_once(self.endpoint.confirm_by_each_as(self.content, self.terms, within))
    }

    /// Sends it as a request, in class Control, and waits for the reply. A longer `within` than
    /// [`TIME_TO_LIVE_MAX`](sinew_runtime::wire::TIME_TO_LIVE_MAX), 71 minutes and 35 s, counts as that. With less than 20 ms a node that
    /// has gone is not looked for: [`receive`](Endpoint::receive) does.
    ///
    /// # Errors
    /// It was not sent or not handled, no reply came `within` this time, or the reply is not an `R`.
    ///
    /// # Examples
    ///
    /// ```
    /// use std::time::Duration;
    ///
    /// use sinew::{Endpoint, Tid, client::ApiError, payload};
    ///
    /// payload!("demo.ask_angle" => struct AskAngle;);
    /// payload!("demo.angle" => struct Angle { degrees: f32 });
    ///
    /// fn knee_degrees(endpoint: &mut Endpoint, knee: Tid) -> Result<f32, ApiError> {
    ///     Ok(endpoint.message(knee, &AskAngle).ask::<Angle>(Duration::from_millis(50))?.degrees)
    /// }
    /// ```
    pub fn ask<R: Payload>(self, within: Duration) -> Result<R, ApiError> {
        const { assert!(R::PROTECTION.is_none(), "a protected payload is sent, not asked for") };
        Ok(self.ask_raw(within)?.decode()?)
    }

    /// The same, for a reply whose type Rust does not know.
    ///
    /// # Errors
    /// It was not sent or not handled, or no reply came `within` this time.
    pub fn ask_raw(self, within: Duration) -> Result<Received, ApiError> {
        at_once(self.endpoint.ask_as(self.content, self.terms, within))
    }

    /// Sends it as the reply to `request`. It goes to the sender of that, whatever destination it was created for.
    ///
    /// # Errors
    /// The message asks for no reply, or the reply was not sent.
    pub fn reply_to(self, request: &Received) -> Result<(), ApiError> {
        at_once(self.endpoint.reply_as(request, self.content, self.terms))
    }
}

impl<C: Content> MessageBuilder<'_, AsyncEndpoint, C> {
    /// Sends it, as of an [`Endpoint`]. Unlike a timeout around it, [`room_within`](Self::room_within) says whether the message was sent.
    ///
    /// # Errors
    /// It was not sent, and loaned memory is given back. [`ApiError::Stalled`]: there was no room in time.
    pub async fn send(self) -> Result<(), ApiError> {
        self.endpoint.endpoint.send_as(self.content, self.terms).await
    }

    /// Sends it and waits for its outcome, as of an [`Endpoint`].
    ///
    /// # Errors
    /// It was not sent; a group or a broadcast has no outcome of its own ([`ApiError::ToMany`]). If the connection ends before the outcome is
    /// known that is [`Outcome::Unknown`].
    pub async fn confirmed(self, within: Duration) -> Result<Outcome, ApiError> {
        self.endpoint.endpoint.confirm_as(self.content, self.terms, within).await
    }

    /// Sends it to many and waits for what becomes of it at each member, as of an [`Endpoint`].
    ///
    /// # Examples
    ///
    /// ```no_run
    /// use std::time::Duration;
    ///
    /// use sinew::{AsyncEndpoint, Outcome, Tid, client::ApiError};
    ///
    /// sinew::payload!("doc.stop" => struct Stop;);
    ///
    /// /// Stops all drives; returns those that may still move.
    /// async fn stop(endpoint: &mut AsyncEndpoint) -> Result<Vec<Tid>, ApiError> {
    ///     let within = Duration::from_millis(50);
    ///     let drives = endpoint.message(Tid::group("drives"), &Stop).confirmed_by_each(within).await?;
    ///     let failed = drives.into_iter().filter(|drive| drive.outcome != Outcome::Delivered);
    ///     Ok(failed.map(|drive| drive.tid).collect())
    /// }
    /// ```
    ///
    /// # Errors
    /// No member has a copy: it was not sent, it is of class Stream, its node is not known, or it has too many members.
    pub async fn confirmed_by_each(self, within: Duration) -> Result<Vec<MemberOutcome>, ApiError> {
        self.endpoint.endpoint.confirm_by_each_as(self.content, self.terms, within).await
    }

    /// Sends it as a request and waits for the reply, as of an [`Endpoint`].
    ///
    /// # Errors
    /// It was not sent or not handled, no reply came `within` this time, or the reply is not an `R`.
    pub async fn ask<R: Payload>(self, within: Duration) -> Result<R, ApiError> {
        const { assert!(R::PROTECTION.is_none(), "a protected payload is sent, not asked for") };
        Ok(self.ask_raw(within).await?.decode()?)
    }

    /// The same, for a reply whose type Rust does not know.
    ///
    /// # Errors
    /// It was not sent or not handled, or no reply came `within` this time.
    pub async fn ask_raw(self, within: Duration) -> Result<Received, ApiError> {
        self.endpoint.endpoint.ask_as(self.content, self.terms, within).await
    }

    /// Sends it as the reply to `request`, as of an [`Endpoint`].
    ///
    /// # Errors
    /// The message asks for no reply, or the reply was not sent.
    pub async fn reply_to(self, request: &Received) -> Result<(), ApiError> {
        self.endpoint.endpoint.reply_as(request, self.content, self.terms).await
    }
}
