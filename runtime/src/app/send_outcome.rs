//! Outcomes delivered to the sender as messages: one handler for all outcomes, instead of one future for each.

use std::time::Duration;

use actix::{Actor, ActorFutureExt, AsyncContext, Handler, Message, fut};

use super::AppContext;
use crate::{
    outcome::{MemberOutcome, Outcome},
    sender::{
        ConfirmWhenRoom, Confirmation, Content, GroupConfirmation, MessageBuilder, RoomBuilder, SendError,
        SendWhenRoom, Sender, Via,
    },
};

/// The outcome of a message that was sent with [`MessageBuilder::with_tag`].
///
/// # Examples
///
/// ```
/// use sinew::{message::SendError, prelude::*};
///
/// payload!("demo.calibrate" => struct Calibrate { zero_degrees: f32 });
///
/// struct Gait;
/// # impl Actor for Gait { type Context = AppContext<Self>; }
///
/// impl Handler<SendOutcome> for Gait {
///     type Result = ();
///     fn handle(&mut self, sent: SendOutcome, _: &mut Self::Context) {
///         println!("command {} ended as {:?}", sent.tag, sent.outcome);
///     }
/// }
///
/// fn calibrate(ctx: &mut AppContext<Gait>) -> Result<(), SendError> {
///     let command = Calibrate { zero_degrees: 0.5 };
///     ctx.message("knee.drive", &command).with_tag(17).confirmed(Duration::from_millis(100))
/// }
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SendOutcome {
    /// The tag that the sender gave to the message.
    pub tag: u64,
    /// The outcome of the message.
    pub outcome: Outcome,
}

impl Message for SendOutcome {
    type Result = ();
}

/// The outcomes of a message to many that was sent with [`MessageBuilder::with_tag`], one for each member.
///
/// # Examples
///
/// ```
/// use sinew::{app::GroupOutcome, prelude::*};
///
/// struct Gait { stopped: usize }
/// # impl Actor for Gait { type Context = AppContext<Self>; }
///
/// impl Handler<GroupOutcome> for Gait {
///     type Result = ();
///     fn handle(&mut self, sent: GroupOutcome, _: &mut Self::Context) {
///         let delivered = sent.members.iter().filter(|member| member.outcome == Outcome::Delivered);
///         self.stopped = delivered.count();
///     }
/// }
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct GroupOutcome {
    /// The tag that the sender gave to the message.
    pub tag: u64,
    /// The outcomes, one for each member, in the order of their TIDs.
    pub members: Vec<MemberOutcome>,
}

impl Message for GroupOutcome {
    type Result = ();
}

/// An application context that receives outcomes as messages.
pub struct Tagged<'a, A: Actor<Context = AppContext<A>>> {
    context: &'a mut AppContext<A>,
    tag: u64,
}

impl<A: Actor<Context = AppContext<A>>> Via for Tagged<'_, A> {
    fn sender(&self) -> &Sender {
        (&self.context).sender()
    }
}

impl<'a, A: Actor<Context = AppContext<A>>, C: Content> MessageBuilder<&'a mut AppContext<A>, C> {
    /// Sends the message and returns a future of its outcome: see [`Confirmation`] and [`Sender::message`].
    ///
    /// # Errors
    /// No queue and no socket accepted the message, it is of class Stream, or its destination is more than
    /// one application ([`SendError::ToMany`]).
    pub fn confirmed(self, within: Duration) -> Result<Confirmation, SendError> {
        self.confirm(within).map(|(_, confirmation)| confirmation)
    }

    /// Sends the message to many and returns a future of the outcome at each member. See
    /// [`MessageBuilder::confirmed_by_each`] of a [`Sender`]; this is the same method for an actor.
    ///
    /// # Errors
    /// The message is of class Stream, its node is unknown, or it has too many members.
    pub fn confirmed_by_each(self, within: Duration) -> Result<GroupConfirmation, SendError> {
        self.confirm_by_each(within).map(|(_, confirmation)| confirmation)
    }

    /// Delivers the outcome to this actor as a [`SendOutcome`] or a [`GroupOutcome`] with `tag`, instead of
    /// as a future.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{message::SendError, prelude::*};
    ///
    /// payload!("demo.home" => struct Home;);
    /// struct Gait;
    /// # impl Actor for Gait { type Context = AppContext<Self>; }
    /// impl Handler<SendOutcome> for Gait {
    ///     type Result = ();
    ///     fn handle(&mut self, sent: SendOutcome, _: &mut Self::Context) {
    ///         println!("drive {}: {:?}", sent.tag, sent.outcome);
    ///     }
    /// }
    ///
    /// fn home(drives: &[Tid], ctx: &mut AppContext<Gait>) -> Result<(), SendError> {
    ///     for (number, drive) in (0..).zip(drives) {
    ///         ctx.message(*drive, &Home).with_tag(number).confirmed(Duration::from_secs(1))?;
    ///     }
    ///     Ok(())
    /// }
    /// ```
    pub fn with_tag(self, tag: u64) -> MessageBuilder<Tagged<'a, A>, C> {
        let Self { via, content, terms } = self;
        MessageBuilder { via: Tagged { context: via, tag }, content, terms }
    }
}

impl<A: Actor<Context = AppContext<A>>, C: Content> RoomBuilder<&mut AppContext<A>, C> {
    /// Sends the message when there is room. See [`RoomBuilder::send`] of a [`Sender`]; the future of this one can be
    /// spawned.
    ///
    /// # Errors
    /// There was no room in time, or the message was refused.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::prelude::*;
    ///
    /// payload!("demo.image", Bulk => struct Image { pixels: Vec<u8> });
    /// struct Camera { is_sending: bool }
    /// # impl Actor for Camera { type Context = AppContext<Self>; }
    ///
    /// /// Sends an image, and takes the next one when this one has left: no queue of old images grows.
    /// fn send(camera: &mut Camera, image: &Image, ctx: &mut AppContext<Camera>) {
    ///     if std::mem::replace(&mut camera.is_sending, true) {
    ///         return;
    ///     }
    ///     let sent = ctx.message("vision", image).room_within(Duration::from_millis(200)).send();
    ///     ctx.spawn(sent.into_actor(camera).map(|sent, camera, _| {
    ///         camera.is_sending = false;
    ///         if let Err(error) = sent {
    ///             eprintln!("an image was skipped: {error}");
    ///         }
    ///     }));
    /// }
    /// ```
    pub fn send(self) -> SendWhenRoom<Sender> {
        self.send_by(|context| Via::sender(&context).clone())
    }

    /// Sends the message when there is room, and requests a confirmation. See [`RoomBuilder::confirmed`] of a
    /// [`Sender`]; the future of this one can be spawned.
    ///
    /// # Errors
    /// There was no room in time, the message was refused, or too many outcomes are awaited.
    pub fn confirmed(self, within: Duration) -> ConfirmWhenRoom<Sender> {
        self.confirm_by(within, |context| Via::sender(&context).clone())
    }
}

impl<A, C: Content> MessageBuilder<Tagged<'_, A>, C>
where
    A: Actor<Context = AppContext<A>> + Handler<SendOutcome, Result = ()>,
{
    /// Sends the message. Its outcome is delivered to this actor once, as a [`SendOutcome`], in a turn of its
    /// own. The next incarnation of the application does not receive it.
    ///
    /// # Errors
    /// No queue and no socket accepted the message, it is of class Stream, or its destination is more than
    /// one application. No `SendOutcome` is delivered then.
    pub fn confirmed(self, within: Duration) -> Result<(), SendError> {
        let (Tagged { context, tag }, confirmation) = self.confirm(within)?;
        let handled = fut::wrap_future::<_, A>(confirmation)
            .map(move |outcome, actor, context| actor.handle(SendOutcome { tag, outcome }, context));
        context.spawn(handled);
        Ok(())
    }
}

impl<A, C: Content> MessageBuilder<Tagged<'_, A>, C>
where
    A: Actor<Context = AppContext<A>> + Handler<GroupOutcome, Result = ()>,
{
    /// Sends the message to many. The outcomes of all members are delivered to this actor once, as one
    /// [`GroupOutcome`], in a turn of its own. It arrives when the last member is settled, and at the latest
    /// `within` this time. The next incarnation of the application does not receive it.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{app::GroupOutcome, message::SendError, prelude::*};
    ///
    /// struct Brain;
    ///
    /// impl Actor for Brain {
    ///     type Context = AppContext<Self>;
    /// }
    ///
    /// impl Handler<GroupOutcome> for Brain {
    ///     type Result = ();
    ///
    ///     fn handle(&mut self, told: GroupOutcome, _: &mut AppContext<Self>) {
    ///         for member in told.members.iter().filter(|member| member.outcome != Outcome::Delivered) {
    ///             println!("{} did not stop: {:?}", member.tid, member.outcome);
    ///         }
    ///     }
    /// }
    ///
    /// fn stop<P: Payload>(stop: &P, context: &mut AppContext<Brain>) -> Result<(), SendError> {
    ///     let drives = Tid::group("drives");
    ///     context.message(drives, stop).with_tag(1).confirmed_by_each(Duration::from_millis(50))
    /// }
    /// ```
    ///
    /// # Errors
    /// The message is of class Stream, its node is unknown, or it has too many members. No `GroupOutcome` is
    /// delivered then.
    pub fn confirmed_by_each(self, within: Duration) -> Result<(), SendError> {
        let (Tagged { context, tag }, confirmation) = self.confirm_by_each(within)?;
        let handled = fut::wrap_future::<_, A>(confirmation)
            .map(move |members, actor, context| actor.handle(GroupOutcome { tag, members }, context));
        context.spawn(handled);
        Ok(())
    }
}
