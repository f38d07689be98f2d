//! The guard of a received message in process: the message is counted once, even if a handler panics.

use super::{
    super::receive_counters::{Disposition, ReceiveCounters},
    PeerSession,
};

/// The guard of a message in process. Without a recorded disposition the message counts as failed.
pub(crate) struct ProcessingGuard<'a>(Option<&'a PeerSession>);

impl<'a> ProcessingGuard<'a> {
    pub(super) const fn new(session: &'a PeerSession) -> Self {
        Self(Some(session))
    }

    /// Records the disposition of the message.
    pub(crate) fn finish(mut self, disposition: Disposition) {
        if let Some(session) = self.0.take() {
            session.finish(disposition);
        }
    }

    /// Leaves it to the caller to record the disposition of the message. It counts as in process until then.
    pub(crate) fn defer(mut self) {
        self.0 = None;
    }

    /// Uncounts a message that had arrived before.
    pub(crate) fn drop_duplicate(mut self) {
        if let Some(session) = self.0.take() {
            session.update_counters(ReceiveCounters::cancel_duplicate);
        }
    }

    /// Releases the guard, because the message waits in a queue.
    pub(crate) fn release(mut self) {
        self.0 = None;
    }
}

impl Drop for ProcessingGuard<'_> {
    fn drop(&mut self) {
        if let Some(session) = self.0 {
            session.finish(Disposition::Failed);
        }
    }
}
