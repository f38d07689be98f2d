//! Outcomes that come to their sender as messages: one handler for all, instead of a future for each.

use std::time::Duration;

use actix::{Actor, ActorFutureExt, AsyncContext, Handler, Message, fut};

use super::AppContext;
use crate::{
    outcome::Outcome,
    sender::{Confirmation, Content, MessageBuilder, SendError, Sender, Via},
};

/// What became of a message that was sent with [`MessageBuilder::with_tag`].
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
    /// No queue and no socket took it, or it is of class Stream.
    pub fn confirmed(self, within: Duration) -> Result<Confirmation, SendError> {
        self.confirm(within).map(|(_, confirmation)| confirmation)
    }

    /// Has its outcome come to this actor as a [`SendOutcome`] with `tag`, instead of as a future.
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
    /// No queue and no socket took it, or it is of class Stream; no `SendOutcome` comes.
    pub fn confirmed(self, within: Duration) -> Result<(), SendError> {
        let (Tagged { context, tag }, confirmation) = self.confirm(within)?;
        let handled = fut::wrap_future::<_, A>(confirmation)
            .map(move |outcome, actor, context| actor.handle(SendOutcome { tag, outcome }, context));
        context.spawn(handled);
        Ok(())
    }
}
