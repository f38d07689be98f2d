//! A mailbox whose messages wait elsewhere: in the node, for the process that hosts an application.

use std::{
    fmt::Debug,
    task::{Context, Poll},
};

use crate::{outcome::Outcome, wire::Message};

/// Where a mailbox's reader takes its messages from, one at a time.
pub trait Source: Debug + Send + Sync {
    /// Takes the next message into the hand. `None` once there will be none.
    fn poll_take(&self, cx: &mut Context<'_>) -> Poll<Option<Message>>;

    /// The same for the layers' events alone; everything else is left where it is.
    fn poll_event(&self, cx: &mut Context<'_>) -> Poll<Option<Message>>;

    /// Messages that wait to be taken, and how many were taken so far; `None` if somebody is at it this very moment.
    fn backlog(&self) -> Option<(usize, u64)>;

    /// The message in hand has ended so.
    fn finish(&self, outcome: Outcome);
}
