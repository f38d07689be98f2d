//! The outlet as a destination of messages.

use std::task::Waker;

use sinew_runtime::{
    outcome::Ticket,
    router::{MessageSink, SubmitError},
    wire::Message,
};

use super::{
    Socket, SocketWriter,
    deferred::DeferredActions,
    unsent::Bound,
    writer_state::{Step, WriterState},
};

impl<S: Socket> MessageSink for SocketWriter<S> {
    fn submit(&self, message: Message) -> Result<(), SubmitError> {
        self.submit_or(message, |_, _, _| {})
    }

    fn offer(&self, message: Message, room: Option<&Waker>) -> Result<(), SubmitError> {
        self.submit_or(message, |refused, state, deferred| state.undo_refusal(refused, room, deferred))
    }

    fn cancel(&self, ticket: Ticket) -> bool {
        self.with(|state, deferred| state.cancel(ticket, deferred))
    }
}

impl<S: Socket> SocketWriter<S> {
    /// Submits a message. Calls `or` if it is refused, under the same lock: room that is made after the refusal finds
    /// the sender registered.
    #[inline]
    fn submit_or(
        &self,
        message: Message,
        or: impl FnOnce(&SubmitError, &mut WriterState<S>, &mut DeferredActions),
    ) -> Result<(), SubmitError> {
        // Not by a closure, which would move the message twice more.
        let (mut state, mut deferred) = (self.lock(), DeferredActions::default());
        let submitted = state.submit(message, Bound::Kept, &mut deferred);
        if let Err(refused) = &submitted {
            or(refused, &mut state, &mut deferred);
        }
        self.end_step(state, deferred);
        let mut step = submitted?;
        while step == Step::More {
            step = self.with(|state, deferred| state.write_on(deferred));
        }
        Ok(())
    }
}
