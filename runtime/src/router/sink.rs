//! A destination of messages, and the rejection of a message by it.

use std::task::Waker;

use crate::{
    outcome::{Rejection, Ticket},
    wire::Message,
};

/// A destination of messages: a mailbox, a client's socket, the connection to a node.
pub trait MessageSink: Send + Sync {
    /// Accepts the message, or returns it with the reason. Never blocks.
    ///
    /// # Errors
    /// The message, unchanged, and the reason of the rejection.
    fn submit(&self, message: Message) -> Result<(), SubmitError>;

    /// Same as [`submit`](Self::submit), for a caller that keeps a message after a full queue and offers it
    /// again: this does not count as a rejection. `room` is woken, once, when a full queue has room again. All
    /// waiting callers are woken together. A sink that cannot detect room wakes none.
    ///
    /// # Errors
    /// Those of `submit`.
    fn offer(&self, message: Message, room: Option<&Waker>) -> Result<(), SubmitError> {
        let _ = room;
        self.submit(message)
    }

    /// Cancels the request of `ticket`; its reply is no longer awaited. If the request is queued here, it is
    /// removed and ends as [`Outcome::Expired`](crate::outcome::Outcome::Expired), as at its deadline.
    /// Returns whether it was removed, or its present holder was notified.
    fn cancel(&self, ticket: Ticket) -> bool {
        let _ = ticket;
        false
    }
}

/// A message that a [`MessageSink`] rejected.
#[derive(Debug)]
pub struct SubmitError {
    /// The message, untouched.
    pub message: Message,
    /// The reason of the rejection.
    pub why: Rejection,
}

impl SubmitError {
    /// Creates the rejection of `message` for `why`.
    #[must_use]
    pub const fn new(message: Message, why: Rejection) -> Self {
        Self { message, why }
    }
}
