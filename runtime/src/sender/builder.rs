//! One builder for all messages that applications in a node's process send.

use std::{fmt, time::Duration};

use super::{
    Confirmation, Destination, GroupConfirmation, Reply, SendError, Sender,
    awaiting::{Deadline, Request},
};
use crate::{
    outcome::{Rejection, Ticket},
    pending::Awaited,
    tid::{AppAddress, Tid},
    wire::{Class, Flags, Message, MessageBuffer, Payload},
};

/// A message to send: made by [`Sender::message`], [`AppContext::message`](crate::app::AppContext::message)
/// or [`Sender::loaned`].
///
/// Terms that are not set have the defaults of the type. The message is sent only by [`send`](Self::send),
/// [`confirmed`](Self::confirmed), [`confirmed_by_each`](Self::confirmed_by_each) or [`ask`](Self::ask).
///
/// # Examples
///
/// ```
/// # use std::time::Duration;
/// # use sinew::{Payload, Tid, message::{SendError, Sender}};
/// # fn steer<P: Payload>(sender: &Sender, drive: Tid, setpoint: &P) -> Result<(), SendError> {
/// sender.message(drive, setpoint).expires_after(Duration::from_millis(20)).send()
/// # }
/// ```
#[must_use = "a message is sent by `send`, `confirmed`, `confirmed_by_each` or `ask`"]
pub struct MessageBuilder<V, C> {
    pub(crate) via: V,
    pub(crate) content: C,
    pub(crate) terms: Terms,
}

/// The terms of one message that differ from the defaults of its type.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Terms {
    class: Option<Class>,
    expires_after: Option<Duration>,
}

/// A value and its destination.
#[derive(Debug)]
pub struct Value<'a, P> {
    pub(crate) destination: Destination<'a>,
    pub(crate) value: &'a P,
}

/// The sender of a message: a [`Sender`], or the context of an application.
pub trait Via {
    /// Returns the sending side.
    fn sender(&self) -> &Sender;
}

impl Via for &Sender {
    fn sender(&self) -> &Sender {
        self
    }
}

/// The content of a message: a [`Value`], or a [`MessageBuffer`].
pub trait Content {
    /// Builds the message from `sender`.
    ///
    /// # Errors
    /// The destination is unknown, or the payload cannot be sealed.
    fn into_message(self, sender: &Sender) -> Result<Message, SendError>;
}

impl<P: Payload> Content for Value<'_, P> {
    fn into_message(self, sender: &Sender) -> Result<Message, SendError> {
        sender.typed(self.destination, self.value)
    }
}

impl Content for MessageBuffer {
    fn into_message(self, _: &Sender) -> Result<Message, SendError> {
        Ok(self.freeze())
    }
}

impl<V, C> fmt::Debug for MessageBuilder<V, C> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "MessageBuilder({:?})", self.terms)
    }
}

impl<V, C> MessageBuilder<V, C> {
    pub(crate) const fn new(via: V, content: C) -> Self {
        Self { via, content, terms: Terms { class: None, expires_after: None } }
    }

    /// Sets the class of the message, instead of its type's class. Has no effect on a
    /// [retained](Payload::RETAINED) type that is sent to a group.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{message::{SendError, Sender}, prelude::*};
    ///
    /// payload!("demo.setpoint", Stream => struct Setpoint { degrees: f32 });
    ///
    /// /// Sends the last setpoint of a motion as a command, which no later value replaces.
    /// fn finish(sender: &Sender, drive: Tid, setpoint: &Setpoint) -> Result<(), SendError> {
    ///     sender.message(drive, setpoint).class(Class::Control).send()
    /// }
    /// ```
    pub const fn class(mut self, class: Class) -> Self {
        self.terms.class = Some(class);
        self
    }

    /// Sets the age at which the message expires while it is queued, instead of its type's
    /// [`TIME_TO_LIVE`](Payload::TIME_TO_LIVE). At most [`TIME_TO_LIVE_MAX`](crate::wire::TIME_TO_LIVE_MAX),
    /// 71 minutes and 35 s: a longer time counts as that.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{message::{SendError, Sender}, prelude::*};
    ///
    /// payload!("demo.step" => struct Step { metres: f32 });
    ///
    /// /// A step that waits for longer than 50 ms comes too late to be taken.
    /// fn step(sender: &Sender, gait: Tid) -> Result<(), SendError> {
    ///     sender.message(gait, &Step { metres: 0.3 }).expires_after(Duration::from_millis(50)).send()
    /// }
    /// ```
    pub const fn expires_after(mut self, time: Duration) -> Self {
        self.terms.expires_after = Some(time);
        self
    }
}

impl Terms {
    fn apply(self, message: &mut Message) {
        if let Some(class) = self.class {
            message.header.override_class(class);
        }
        if let Some(time) = self.expires_after {
            // No wait depends on the time to live of an unconfirmed message.
            let _ = message.header.set_time_to_live(time);
        }
    }
}

impl<V: Via, C: Content> MessageBuilder<V, C> {
    pub(super) fn message(self) -> Result<(V, Message), SendError> {
        let Self { via, content, terms } = self;
        let mut message = content.into_message(via.sender())?;
        terms.apply(&mut message);
        Ok((via, message))
    }

    /// Sends the message without a confirmation. Returns when a queue or a socket has accepted it. A full queue refuses
    /// it; [`room_within`](Self::room_within) waits.
    ///
    /// # Errors
    /// No queue and no socket accepted the message.
    pub fn send(self) -> Result<(), SendError> {
        let (via, message) = self.message()?;
        via.sender().dispatch(message).map(drop)
    }

    pub(crate) fn confirm(self, within: Duration) -> Result<(V, Confirmation), SendError> {
        let (via, mut message) = self.confirmable()?;
        let sender = via.sender();
        let destination = sender.absolute(message.header.destination);
        if is_many(destination) {
            return Err(SendError::ToMany(destination));
        }
        let (wait, within) = sender.expect_answer(&mut message, Awaited::Outcome, within)?;
        let until = sender.dispatch(message)? + within;
        let deadline = Deadline::new(wait, sender.clock().sleep_until(until));
        Ok((via, Confirmation::new(deadline)))
    }

    pub(crate) fn confirm_by_each(self, within: Duration) -> Result<(V, GroupConfirmation), SendError> {
        let (via, mut message) = self.confirmable()?;
        let sender = via.sender();
        let (wait, within) = sender.expect_each(&mut message, within)?;
        let until = sender.dispatch(message)? + within;
        let deadline = Deadline::new(wait, sender.clock().sleep_until(until));
        Ok((via, GroupConfirmation::new(deadline)))
    }

    fn confirmable(self) -> Result<(V, Message), SendError> {
        let (via, message) = self.message()?;
        if message.header.class == Class::Stream {
            // Newer values replace older ones, so an older one has no outcome of its own.
            return Err(Rejection::Unsupported.into());
        }
        Ok((via, message))
    }

    /// Sends the message as a request, in class Control. The returned future ends with the reply, an error,
    /// or at the deadline. A longer `within` than [`TIME_TO_LIVE_MAX`](crate::wire::TIME_TO_LIVE_MAX), 71
    /// minutes and 35 s, counts as that.
    ///
    /// # Errors
    /// No queue and no socket accepted the message. The future's own errors are [`AskError`](super::AskError)s.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{message::SendError, prelude::*};
    ///
    /// payload!("demo.ask_angle" => struct AskAngle;);
    /// payload!("demo.angle" => struct Angle { degrees: f32 });
    ///
    /// struct Hip { knee_degrees: f32 }
    /// # impl Actor for Hip { type Context = AppContext<Self>; }
    ///
    /// fn ask(hip: &Hip, ctx: &mut AppContext<Hip>) -> Result<(), SendError> {
    ///     let reply = ctx.message("knee", &AskAngle).ask::<Angle>(Duration::from_millis(50))?;
    ///     ctx.spawn(reply.into_actor(hip).map(|reply, hip, _| match reply {
    ///         Ok(angle) => hip.knee_degrees = angle.degrees,
    ///         Err(error) => eprintln!("{error}"),
    ///     }));
    ///     Ok(())
    /// }
    /// ```
    pub fn ask<R: Payload>(self, within: Duration) -> Result<Reply<R>, SendError> {
        const { assert!(R::PROTECTION.is_none(), "a protected payload is sent, not asked for") };
        let (via, mut message) = self.message()?;
        let sender = via.sender();
        message.header.class = Class::Control;
        message.header.flags = Flags::ASK;
        let (wait, within) = sender.expect_answer(&mut message, Awaited::Reply, within)?;
        let destination = sender.absolute(message.header.destination);
        let ticket = Ticket { source: sender.tid(), destination, correlation: wait.correlation() };
        let until = sender.dispatch(message)? + within;
        let request = Request { router: sender.shared.router.clone(), ticket };
        Ok(Reply::new(Deadline::new(wait, sender.clock().sleep_until(until)), within, request))
    }
}

impl<C: Content> MessageBuilder<&Sender, C> {
    /// Sends the message and requests a confirmation. The returned future ends in exactly one
    /// [`Outcome`](crate::outcome::Outcome). A queued message expires when it is older than `within`. If no
    /// outcome has arrived by then, the future ends as
    /// [`Outcome::Unknown`](crate::outcome::Outcome::Unknown), independent of its first poll. No message
    /// lives longer than [`TIME_TO_LIVE_MAX`](crate::wire::TIME_TO_LIVE_MAX), 71 minutes and 35 s: a longer
    /// `within` counts as that.
    ///
    /// # Errors
    /// No queue and no socket accepted the message, it is of class Stream, or its destination is more than
    /// one application ([`SendError::ToMany`]).
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{message::{SendError, Sender}, prelude::*};
    ///
    /// payload!("demo.calibrate" => struct Calibrate { zero_degrees: f32 });
    ///
    /// async fn calibrate(sender: &Sender, drive: Tid) -> Result<Outcome, SendError> {
    ///     let command = Calibrate { zero_degrees: 0.5 };
    ///     Ok(sender.message(drive, &command).confirmed(Duration::from_millis(100))?.await)
    /// }
    /// ```
    pub fn confirmed(self, within: Duration) -> Result<Confirmation, SendError> {
        self.confirm(within).map(|(_, confirmation)| confirmation)
    }

    /// Sends the message and requests a confirmation from each member. The destination is a group, every
    /// application ([`Tid::BROADCAST`]) or one address on all nodes. The returned future ends with one
    /// [`MemberOutcome`](crate::outcome::MemberOutcome) for each member that is known when the message
    /// arrives at its node, without the sender. It ends when the last member is settled, and at the latest
    /// `within` this time. A member without an outcome by then has
    /// [`Outcome::Unknown`](crate::outcome::Outcome::Unknown), as do all members of a lost node. A node that
    /// has not listed its members has one entry for all of them. A group without members gives an empty list.
    ///
    /// At most 256 members of one node and 256 other nodes are reached. An application can have 64 such
    /// messages to other nodes in flight.
    ///
    /// # Examples
    ///
    /// ```
    /// use std::time::Duration;
    /// use sinew::{Outcome, Payload, Tid, message::{SendError, Sender}};
    ///
    /// /// Stops all drives; returns those that may still move.
    /// async fn stop<P: Payload>(sender: &Sender, stop: &P) -> Result<Vec<Tid>, SendError> {
    ///     let within = Duration::from_millis(50);
    ///     let drives = sender.message(Tid::group("drives"), stop).confirmed_by_each(within)?.await;
    ///     let failed = drives.into_iter().filter(|drive| drive.outcome != Outcome::Delivered);
    ///     Ok(failed.map(|drive| drive.tid).collect())
    /// }
    /// ```
    ///
    /// # Errors
    /// The message is of class Stream, its node is unknown, or it has too many members.
    pub fn confirmed_by_each(self, within: Duration) -> Result<GroupConfirmation, SendError> {
        self.confirm_by_each(within).map(|(_, confirmation)| confirmation)
    }
}

/// Returns whether a message to `destination` has several outcomes.
pub(super) fn is_many(destination: Tid) -> bool {
    !destination.is_single() && destination.app != AppAddress::NONE
}
