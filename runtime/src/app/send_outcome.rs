//! Outcomes that come to their sender as messages: one handler for all, instead of a future for each.

use std::time::Duration;

use actix::{Actor, ActorFutureExt, AsyncContext, Handler, Message, fut};

use super::AppContext;
use crate::{
    outcome::{MemberOutcome, Outcome},
    sender::{Confirmation, Content, GroupConfirmation, MessageBuilder, SendError, Sender, Via},
};

/// What became of a message that was sent with [`MessageBuilder::with_tag`].
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
    /// The number that its sender gave it.
    pub tag: u64,
    /// Its fate.
    pub outcome: Outcome,
}

impl Message for SendOutcome {
    type Result = ();
}

/// What became of a message to many that was sent with [`MessageBuilder::with_tag`], at each of its members.
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
    /// The number that its sender gave it.
    pub tag: u64,
    /// One for each member, in the order of their TIDs.
    pub members: Vec<MemberOutcome>,
}

impl Message for GroupOutcome {
    type Result = ();
}

/// A context that is to get outcomes as messages.
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
    /// Sends it, and asks what becomes of it: see [`Confirmation`] and [`Sender::message`].
    ///
    /// # Errors
    /// No queue and no socket took it, it is of class Stream, or it is for more than one application ([`SendError::ToMany`]).
    pub fn confirmed(self, within: Duration) -> Result<Confirmation, SendError> {
        self.confirm(within).map(|(_, confirmation)| confirmation)
    }

    /// Sends it to many, and asks what becomes of it at each member: see [`MessageBuilder::confirmed_by_each`] of a [`Sender`], which this is
    /// for an actor.
    ///
    /// # Errors
    /// It is of class Stream, its node is not known, or it has too many members.
    pub fn confirmed_by_each(self, within: Duration) -> Result<GroupConfirmation, SendError> {
        self.confirm_by_each(within).map(|(_, confirmation)| confirmation)
    }

    /// Has its outcome come to this actor as a [`SendOutcome`] with `tag`, or as a [`GroupOutcome`], instead of as a future.
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

impl<A, C: Content> MessageBuilder<Tagged<'_, A>, C>
where
    A: Actor<Context = AppContext<A>> + Handler<SendOutcome, Result = ()>,
{
    /// Sends it; what becomes of it comes to this actor as a [`SendOutcome`], once, in a turn of its own. The next life of the
    /// application does not get it.
    ///
    /// # Errors
    /// No queue and no socket took it, it is of class Stream, or it is for more than one application; no `SendOutcome` comes.
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
    /// Sends it to many; what becomes of it at each member comes to this actor as a [`GroupOutcome`], once, in a turn of its own: when the last
    /// member is settled, and at the latest `within` this time. The next life of the application does not get it.
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
    /// It is of class Stream, its node is not known, or it has too many members; no `GroupOutcome` comes.
    pub fn confirmed_by_each(self, within: Duration) -> Result<(), SendError> {
        let (Tagged { context, tag }, confirmation) = self.confirm_by_each(within)?;
        let handled = fut::wrap_future::<_, A>(confirmation)
            .map(move |members, actor, context| actor.handle(GroupOutcome { tag, members }, context));
        context.spawn(handled);
        Ok(())
    }
}
