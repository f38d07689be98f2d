//! The builder for all messages that an endpoint sends, from a thread or a task.

use std::{fmt, pin::pin, time::Duration};

use sinew_runtime::{
    outcome::{MemberOutcome, Outcome},
    sender::Destination,
    tid::Tid,
    wire::{Class, Header, Message, Payload},
};

use super::{
    ApiError, AsyncEndpoint, Endpoint, LoanedMessage, Received, loan::Draft, outgoing::Request,
    stall_timeout::Limit, wait_mode::block_ready,
};

/// A message to send, created by `message` or `loaned` of an [`Endpoint`] or an [`AsyncEndpoint`].
///
/// Settings that the message does not override come from its type and its endpoint. [`send`](Self::send),
/// [`confirmed`](Self::confirmed), [`confirmed_by_each`](Self::confirmed_by_each), [`ask`](Self::ask) or
/// [`reply_to`](Self::reply_to) sends it; nothing is sent before that.
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

/// The settings of one call that override those of its type and its endpoint.
#[derive(Clone, Copy, Debug)]
pub(super) struct SendTerms {
    pub(super) room_within: Option<Duration>,
    pub(super) expires_after: Option<Duration>,
    pub(super) class: Option<Class>,
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

/// The content to send: a [`Value`], or a [`LoanedMessage`].
#[expect(private_interfaces, private_bounds, reason = "sealed: only this module implements or calls it")]
pub trait Content: Sized {
    /// Returns the message, or the content itself if its destination must be looked up.
    fn at_once(self, endpoint: &mut Endpoint, limit: Limit) -> Result<Result<Draft, ApiError>, Self>;

    /// Returns the message, once its destination is known.
    fn into_draft(
        self,
        endpoint: &mut Endpoint,
        limit: Limit,
    ) -> impl Future<Output = Result<Draft, ApiError>>;

    /// The same for a request or a reply, which are not sealed.
    fn into_unsealed(
        self,
        endpoint: &mut Endpoint,
        limit: Limit,
    ) -> impl Future<Output = Result<Draft, ApiError>>;
}

#[expect(private_interfaces, reason = "sealed: only this module implements or calls it")]
impl<P: Payload> Content for Value<'_, P> {
    fn at_once(self, endpoint: &mut Endpoint, limit: Limit) -> Result<Result<Draft, ApiError>, Self> {
        match self.destination {
            Destination::Tid(to) => Ok(endpoint.typed(to, self.value, limit).map(Draft::from)),
            Destination::Name(_) => Err(self),
        }
    }

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

#[expect(private_interfaces, reason = "sealed: only this module implements or calls it")]
impl Content for LoanedMessage {
    #[inline]
    fn at_once(self, _: &mut Endpoint, _: Limit) -> Result<Result<Draft, ApiError>, Self> {
        Ok(Ok(self.into()))
    }

    async fn into_draft(self, _: &mut Endpoint, _: Limit) -> Result<Draft, ApiError> {
        Ok(self.into())
    }

    async fn into_unsealed(self, _: &mut Endpoint, _: Limit) -> Result<Draft, ApiError> {
        Ok(self.into())
    }
}

impl SendTerms {
    /// No overrides.
    pub(super) const PLAIN: Self = Self { room_within: None, expires_after: None, class: None };

    /// Returns how long a send waits for room.
    pub(super) fn limit(&self, endpoint: &Endpoint) -> Limit {
        self.room_within.map_or_else(|| endpoint.stall_timeout(), Limit::in_all)
    }

    pub(super) fn apply(&self, header: &mut Header) {
        if let Some(class) = self.class {
            header.override_class(class);
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

    /// Returns the TID of a destination. A name is looked up for as long as the send may wait for room.
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

    /// Waits for room at most this long, instead of the endpoint's stall timeout. With [`Duration::ZERO`] it
    /// does not wait at all, and makes no system call that could block. For a periodic loop: a message
    /// without room is skipped.
    ///
    /// Returns [`ApiError::Stalled`] if there is no room in time, and the receiver gets nothing of the
    /// message. A message longer than half the ring is sent in pieces; if the last piece finds no room in
    /// time, the others are withdrawn. So a loop with a zero wait sends nothing longer than the ring.
    /// Exception: on a plain socket nothing can be withdrawn. There a message counts as sent with its first
    /// byte, and later calls send the rest ahead of all other messages.
    ///
    /// Such a send does not reconnect to a lost node, because a registration takes time. It returns
    /// [`ApiError::Disconnected`]; [`Endpoint::receive`], or a send without a time, reconnects the endpoint.
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

    /// Sets the age at which the message expires in a queue, instead of its type's
    /// [`TIME_TO_LIVE`](Payload::TIME_TO_LIVE). At most
    /// [`TIME_TO_LIVE_MAX`](sinew_runtime::wire::TIME_TO_LIVE_MAX), 71 minutes and 35 s; a longer time is
    /// reduced to that.
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

    /// Sets the class of the message, instead of its type's; requests and replies are always Control.
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
    /// Sends the message without a confirmation. Returns when the ring, or the socket to the node, has
    /// accepted it. [`take_undelivered`](Endpoint::take_undelivered) reports it if no application takes it
    /// after that.
    ///
    /// # Errors
    /// The message was not sent, and loaned memory is returned. [`ApiError::Stalled`]: there was no room in
    /// time.
    pub fn send(self) -> Result<(), ApiError> {
        self.endpoint.send_blocking(self.content, self.terms)
    }

    /// Sends the message and waits for its outcome: [`Outcome::Unknown`] if none arrives `within` this time.
    /// The message expires in a queue at that age. A `within` longer than
    /// [`TIME_TO_LIVE_MAX`](sinew_runtime::wire::TIME_TO_LIVE_MAX), 71 minutes and 35 s, is reduced to that.
    /// Messages that arrive meanwhile wait to be [received](Endpoint::receive), even beyond the inbox's
    /// capacity: 16,384 of each class, 4 MiB of payloads and one message. Messages beyond that are refused:
    /// the senders of confirmed ones get that outcome, the others are [counted](Endpoint::take_undelivered).
    /// The same holds for all calls that wait for an answer: [`ask`](Self::ask),
    /// [`resolve`](Endpoint::resolve), [`join`](Endpoint::join), [`leave`](Endpoint::leave).
    ///
    /// With less than 20 ms the call does not reconnect to a lost node; [`receive`](Endpoint::receive) does.
    ///
    /// # Errors
    /// The message was not sent. A group or a broadcast has no outcome of its own ([`ApiError::ToMany`]). If
    /// the connection ends before the outcome is known, the result is [`Outcome::Unknown`], not an error.
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
        block_ready(pin!(self.endpoint.confirm_as(self.content, self.terms, within)))
    }

    /// Sends the message to a group, to every application ([`Tid::BROADCAST`]) or to an address on all nodes,
    /// and waits for the outcome at each member. Returns one [`MemberOutcome`] for each member that is known
    /// when the message arrives at its node, except this endpoint. Returns as soon as the last one is
    /// settled, at the latest `within` this time. A member without an outcome by then has
    /// [`Outcome::Unknown`]. So do all members of a lost node, and those of all nodes if the connection ends.
    /// A node that has not reported its members has one entry for them. A group without members gives an
    /// empty list.
    ///
    /// Reaches at most 256 members of one node and 256 other nodes. The message's expiry, and messages that
    /// arrive meanwhile, are handled as with [`confirmed`](Self::confirmed).
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
    /// No member has a copy: the message was not sent, is of class Stream, its node is not known, or it has
    /// too many members.
    pub fn confirmed_by_each(self, within: Duration) -> Result<Vec<MemberOutcome>, ApiError> {
        block_ready(pin!(self.endpoint.confirm_by_each_as(self.content, self.terms, within)))
    }

    /// Sends the message as a request, in class Control, and waits for the reply. A `within` longer than
    /// [`TIME_TO_LIVE_MAX`](sinew_runtime::wire::TIME_TO_LIVE_MAX), 71 minutes and 35 s, is reduced to that.
    /// With less than 20 ms the call does not reconnect to a lost node; [`receive`](Endpoint::receive) does.
    ///
    /// # Errors
    /// The message was not sent or not handled, no reply arrived `within` this time, or the reply is not an
    /// `R`.
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

    /// Same as [`ask`](Self::ask), for a reply without a Rust type.
    ///
    /// # Errors
    /// The message was not sent or not handled, or no reply arrived `within` this time.
    pub fn ask_raw(self, within: Duration) -> Result<Received, ApiError> {
        block_ready(pin!(self.endpoint.ask_as(self.content, self.terms, within)))
    }

    /// Sends the message as the reply to `request`. Its destination is the sender of `request`, regardless of
    /// the destination it was created with.
    ///
    /// # Errors
    /// The request does not ask for a reply, or the reply was not sent.
    pub fn reply_to(self, request: &Received) -> Result<(), ApiError> {
        block_ready(pin!(self.endpoint.reply_as(request, self.content, self.terms)))
    }
}

impl<C: Content> MessageBuilder<'_, AsyncEndpoint, C> {
    /// Sends the message like [`Endpoint`]'s builder. Unlike a timeout around it,
    /// [`room_within`](Self::room_within) reports whether the message was sent.
    ///
    /// # Errors
    /// The message was not sent, and loaned memory is returned. [`ApiError::Stalled`]: there was no room in
    /// time.
    pub async fn send(self) -> Result<(), ApiError> {
        self.endpoint.endpoint.send_as(self.content, self.terms).await
    }

    /// Sends the message and waits for its outcome, like [`Endpoint`]'s builder.
    ///
    /// # Errors
    /// The message was not sent. A group or a broadcast has no outcome of its own ([`ApiError::ToMany`]). If
    /// the connection ends before the outcome is known, the result is [`Outcome::Unknown`], not an error.
    pub async fn confirmed(self, within: Duration) -> Result<Outcome, ApiError> {
        self.endpoint.endpoint.confirm_as(self.content, self.terms, within).await
    }

    /// Sends the message to many and waits for the outcome at each member, like [`Endpoint`]'s builder.
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
    /// No member has a copy: the message was not sent, is of class Stream, its node is not known, or it has
    /// too many members.
    pub async fn confirmed_by_each(self, within: Duration) -> Result<Vec<MemberOutcome>, ApiError> {
        self.endpoint.endpoint.confirm_by_each_as(self.content, self.terms, within).await
    }

    /// Sends the message as a request and waits for the reply, like [`Endpoint`]'s builder.
    ///
    /// # Errors
    /// The message was not sent or not handled, no reply arrived `within` this time, or the reply is not an
    /// `R`.
    pub async fn ask<R: Payload>(self, within: Duration) -> Result<R, ApiError> {
        const { assert!(R::PROTECTION.is_none(), "a protected payload is sent, not asked for") };
        Ok(self.ask_raw(within).await?.decode()?)
    }

    /// Same as [`ask`](Self::ask), for a reply without a Rust type.
    ///
    /// # Errors
    /// The message was not sent or not handled, or no reply arrived `within` this time.
    pub async fn ask_raw(self, within: Duration) -> Result<Received, ApiError> {
        self.endpoint.endpoint.ask_as(self.content, self.terms, within).await
    }

    /// Sends the message as the reply to `request`, like [`Endpoint`]'s builder.
    ///
    /// # Errors
    /// The request does not ask for a reply, or the reply was not sent.
    pub async fn reply_to(self, request: &Received) -> Result<(), ApiError> {
        self.endpoint.endpoint.reply_as(request, self.content, self.terms).await
    }
}
