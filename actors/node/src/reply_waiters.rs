//! Callers that wait until all applications run.

use std::sync::{
    Arc, Weak,
    mpsc::{Receiver, SyncSender, sync_channel},
};

use super::StartError;

/// The answer of the root.
pub(super) type Answer = Result<(), StartError>;

/// The root's end of a request.
#[derive(Debug)]
pub(crate) struct ReplySender {
    sender: SyncSender<Answer>,
    waiter: Weak<()>,
}

/// The caller's end of a request. The caller has stopped waiting when it is dropped.
#[derive(Debug)]
pub(super) struct PendingReply {
    pub(super) receiver: Receiver<Answer>,
    _waiter: Arc<()>,
}

impl ReplySender {
    pub(super) fn new() -> (Self, PendingReply) {
        let ((sender, receiver), waiter) = (sync_channel(1), Arc::new(()));
        (Self { sender, waiter: Arc::downgrade(&waiter) }, PendingReply { receiver, _waiter: waiter })
    }

    /// Sends the answer; it is dropped if the caller has stopped waiting.
    pub(super) fn answer(self, answer: Answer) {
        let _ = self.sender.try_send(answer);
    }

    /// Adds this caller to the waiting ones and removes those that have stopped waiting. A caller that asks
    /// repeatedly is therefore in the list once.
    pub(super) fn join(self, others: &mut Vec<Self>) {
        others.retain(|other| other.waiter.strong_count() > 0);
        others.push(self);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn repeated_unawaited_requests_use_no_memory() {
        let mut all = Vec::new();
        let (patient, reply) = ReplySender::new();
        patient.join(&mut all);
        for _ in 0..1_000 {
            ReplySender::new().0.join(&mut all);
        }
        assert_eq!(all.len(), 2, "the patient one, and the last of the others");
        all.into_iter().for_each(|waiter| waiter.answer(Ok(())));
        assert!(matches!(reply.receiver.try_recv(), Ok(Ok(()))));
    }
}
