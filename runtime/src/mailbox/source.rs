//! A mailbox with messages that are queued elsewhere: in the node, for the process that hosts an application.

use std::{
    fmt::Debug,
    task::{Context, Poll},
};

use crate::{outcome::Outcome, wire::Message};

/// The source of messages for a mailbox's reader, one at a time.
pub trait Source: Debug + Send + Sync {
    /// Takes the next message. `None` once there will be no more.
    fn poll_take(&self, cx: &mut Context<'_>) -> Poll<Option<Message>>;

    /// Takes the next layer event; all other messages stay queued.
    fn poll_event(&self, cx: &mut Context<'_>) -> Poll<Option<Message>>;

    /// Returns the number of queued messages, and of those taken so far. Returns `None` if the source is locked.
    fn backlog(&self) -> Option<(usize, u64)>;

    /// Records the outcome of the current message.
    fn finish(&self, outcome: Outcome);
}
