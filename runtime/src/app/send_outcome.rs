//! Outcomes that come to their sender as messages: one handler for all, instead of a future for each.

use std::time::Duration;

use actix::{Actor, ActorFutureExt, AsyncContext, Handler, Message, fut};

use super::AppContext;
use crate::{
    outcome::Outcome,
    sender::{Destination, SendError},
    wire::Payload,
};

/// What became of a message that was sent with [`AppContext::send_with_tag`].
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

impl<A: Actor<Context = Self>> AppContext<A> {
    /// Sends a value; what becomes of it comes to this actor as a [`SendOutcome`] with `tag`, once, in a turn of its own. Else as
    /// [`send_confirmed`](Self::send_confirmed), its longest `within` included. The next life of the application is not told.
    ///
    /// # Errors
    /// Nobody took it; no `SendOutcome` comes.
    pub fn send_with_tag<'a, P: Payload>(
        &mut self,
        to: impl Into<Destination<'a>>,
        value: &P,
        within: Duration,
        tag: u64,
    ) -> Result<(), SendError>
    where
        A: Handler<SendOutcome, Result = ()>,
    {
        let confirmation = self.send_confirmed(to, value, within)?;
        let told = fut::wrap_future::<_, A>(confirmation)
            .map(move |outcome, actor, context| actor.handle(SendOutcome { tag, outcome }, context));
        self.spawn(told);
        Ok(())
    }
}
