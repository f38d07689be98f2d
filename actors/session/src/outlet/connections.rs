//! The begin and the end of an outlet's connections: unsent messages wait for the next one, or are settled.

use sinew_runtime::{
    outcome::{Outcome, Rejection},
    wire::Message,
};

use super::{
    LinkNumber, PeerReadHalf, Socket,
    deferred::DeferredActions,
    outstanding::SentMessage,
    partial::{FrameOrigin, Partial},
    writer_state::WriterState,
};

impl<S: Socket> WriterState<S> {
    pub(super) fn connect(
        &mut self,
        socket: S,
        payload_max: usize,
        preface: Option<Message>,
        deferred: &mut DeferredActions,
    ) -> LinkNumber {
        self.cut(deferred);
        if self.connection.open(socket) {
            self.link_frames.restart();
            self.payload_max = self.limits.payload_max.min(payload_max);
            self.connection.partial = preface.map(|message| self.link_frame(message));
        }
        self.connection.number()
    }

    pub(super) fn cut(&mut self, deferred: &mut DeferredActions) {
        self.disconnect(self.connection.number(), deferred);
    }

    pub(super) fn disconnect(&mut self, link: LinkNumber, deferred: &mut DeferredActions) -> bool {
        if !self.connection.is_present(link) || self.connection.why_closed().is_some() {
            return true;
        }
        let has_gathered = self.connection.gathered() > 0;
        self.link_frames.clear_urgent();
        self.connection.wake_drainer(deferred);
        let partial = self.connection.shut();
        let was_whole = !has_gathered && partial.as_ref().is_none_or(|partial| partial.written == 0);
        if self.numbering.has_session() {
            self.numbering.link_ended();
            self.unsent.link_ended();
            // The frame that was being written is kept, like all before it.
            if let Some(mut partial) = partial {
                self.sent(&mut partial);
            }
        } else {
            self.settle_unknown(deferred);
            self.interrupt(partial);
        }
        was_whole
    }

    /// Settles messages that were sent and not confirmed as unknown: the peer may have handled them or not.
    pub(super) fn settle_unknown(&mut self, deferred: &mut DeferredActions) {
        deferred.settle(self.receipts.take_all().map(|sent| (sent.receipt, Outcome::Unknown)));
        deferred.room.extend(self.receipts.awaited_no_more());
    }

    /// Keeps the frame that was being written for the next connection.
    fn interrupt(&mut self, partial: Option<Partial>) {
        // The connection's own frames do not belong to the next connection.
        if let Some(Partial { message, .. }) = partial.filter(|partial| partial.origin == FrameOrigin::Sender)
        {
            self.counters.counts.superseded += u64::from(self.unsent.interrupt(message));
        }
    }

    pub(super) fn close(&mut self, why: Rejection, deferred: &mut DeferredActions) {
        self.cut(deferred);
        self.settle_unknown(deferred);
        self.counters.lose_numbered(self.numbering.forget());
        self.connection.close(why);
        deferred.room.extend(self.unsent.awaited_no_more());
        self.lose_unsent(Outcome::PeerLost, deferred);
        self.receipts.clear_waiting();
    }

    /// Settles all messages that have not been sent.
    fn lose_unsent(&mut self, outcome: Outcome, deferred: &mut DeferredActions) {
        for message in self.unsent.take_all() {
            self.counters.counts.lost += 1;
            deferred.settle(message.receipt.map(|receipt| (receipt, outcome)));
        }
    }

    pub(super) fn end(&mut self, peer: PeerReadHalf, deferred: &mut DeferredActions) {
        let why = Rejection::Closed;
        let taken = self.connection.taken();
        deferred.settle(self.receipts.take_all().map(|SentMessage { receipt, written, .. }| {
            let outcome = match peer {
                PeerReadHalf::MayBeOpen => Outcome::Unknown,
                PeerReadHalf::Closed if written > taken => Outcome::Rejected(why),
                PeerReadHalf::Closed => Outcome::Failed,
            };
            (receipt, outcome)
        }));
        self.cut(deferred);
        // The rest of a started frame is never delivered.
        self.lose_unsent(Outcome::Rejected(why), deferred);
        self.close(why, deferred);
    }
}
