//! Outcomes of confirmed messages that a thread waits for while it sends others.

use std::{
    collections::VecDeque,
    pin::Pin,
    task::{Context, Poll, Waker},
};

use sinew::{Outcome, message::Confirmation};

/// Confirmed messages without an outcome yet, by their numbers.
#[derive(Debug, Default)]
pub struct PendingOutcomes(VecDeque<(u64, Confirmation)>);

impl PendingOutcomes {
    /// Adds a message.
    pub fn push(&mut self, number: u64, confirmation: Confirmation) {
        self.0.push_back((number, confirmation));
    }

    /// Number of messages without an outcome.
    #[must_use]
    pub fn len(&self) -> usize {
        self.0.len()
    }

    /// Returns whether each message has its outcome.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// The outcomes that have arrived since the last call. Needs a [reactor](crate::scripted::reactor) that
    /// this thread has entered.
    pub fn poll(&mut self) -> Vec<(u64, Outcome)> {
        let (mut context, mut arrived) = (Context::from_waker(Waker::noop()), Vec::new());
        self.0.retain_mut(|(number, confirmation)| match Pin::new(confirmation).poll(&mut context) {
            Poll::Ready(outcome) => {
                arrived.push((*number, outcome));
                false
            }
            Poll::Pending => true,
        });
        arrived
    }
}
