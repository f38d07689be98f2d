//! Messages of one batch for one application, which are handed over together, in their order.
//!
//! They share one look at the routing table, one lock of the mailbox and one of the session's counters.

use std::{collections::VecDeque, thread};

use sinew_runtime::{outcome::Rejection, router::SubmitError, wire::Message};
use sinew_session::outlet::destination_of;

use super::{Behind, Inbound};
use crate::{peer_session::PeerSession, receive_counters::Disposition};

/// Maximum number of messages that are handed over together. With more, each would hardly cost less. An application that
/// runs on another CPU would get its first one later.
const RUN_MAX: usize = 32;

/// Messages for one application that are counted as in process, and are not handed over yet.
#[derive(Default)]
pub(super) struct Run {
    /// The queue of their destination.
    queue: u64,
    /// At most [`RUN_MAX`].
    messages: VecDeque<Message>,
}

impl Inbound {
    /// Whether a message is [collected](Self::collect): not one that arrived alone, which goes its way at once.
    pub(super) fn must_collect(&self) -> bool {
        self.collected.behind.get() == Behind::More || !self.collected.run.borrow().messages.is_empty()
    }

    /// Keeps a message until it is [handed over](Self::hand_over) with others for the same application.
    pub(super) fn collect(&self, session: &PeerSession, queue: u64, message: Message) {
        let must_go = {
            let Run { queue: present, messages } = &*self.collected.run.borrow();
            !messages.is_empty() && (*present != queue || messages.len() >= RUN_MAX)
        };
        if must_go {
            self.hand_over(session);
        }
        let run = &mut *self.collected.run.borrow_mut();
        run.queue = queue;
        run.messages.push_back(message);
    }

    /// Hands over the collected messages. The notified code finds nothing borrowed here.
    pub(super) fn hand_over(&self, session: &PeerSession) {
        if self.collected.run.borrow().messages.is_empty() {
            return;
        }
        let mut handover = Handover { inbound: self, session, run: self.collected.run.take(), offered: 0 };
        handover.run_all();
        // Its memory is used again.
        self.collected.run.replace(std::mem::take(&mut handover.run));
    }
}

/// A run while it is handed over.
struct Handover<'a> {
    inbound: &'a Inbound,
    session: &'a PeerSession,
    run: Run,
    /// The number of messages before the present offer; 0: none is offered now.
    offered: usize,
}

impl Handover<'_> {
    fn run_all(&mut self) {
        let store = &self.inbound.state.store;
        let mut is_held = store.has_earlier_messages(&self.inbound.peer, self.run.queue)
            // While a panic is handled no code runs that may panic again.
            || thread::panicking();
        while !self.run.messages.is_empty() {
            if is_held {
                self.enqueue_next();
                continue;
            }
            let Some(SubmitError { message, why }) = self.offer() else { break };
            if why == Rejection::QueueFull {
                // The messages behind it must not pass it.
                is_held = self.enqueue(message);
            } else {
                self.inbound.state.ctx.router.refuse_arrived(SubmitError::new(message, why));
                self.session.finish_all(Disposition::Refused, 1);
            }
        }
    }

    /// Offers the messages, and counts those that were accepted. Returns the first one that was rejected.
    fn offer(&mut self) -> Option<SubmitError> {
        self.offered = self.run.messages.len();
        let application = destination_of(self.run.queue);
        let offered = self.inbound.state.ctx.router.offer_run(application, &mut self.run.messages);
        let refused = offered.err();
        let gone = std::mem::take(&mut self.offered) - self.run.messages.len();
        match gone.saturating_sub(usize::from(refused.is_some())) {
            0 => {}
            accepted => self.session.finish_all(Disposition::Forwarded, accepted),
        }
        refused
    }

    fn enqueue_next(&mut self) {
        if let Some(message) = self.run.messages.pop_front() {
            self.enqueue(message);
        }
    }

    /// Puts a message into the queue of its destination. Returns whether it waits there.
    fn enqueue(&self, message: Message) -> bool {
        let ended = self.inbound.enqueue(self.session, self.run.queue, message);
        if let Some(disposition) = ended {
            self.session.finish_all(disposition, 1);
        }
        ended.is_none()
    }
}

impl Drop for Handover<'_> {
    /// After a panic in an offer, the last message that was taken out has failed. The messages behind it wait in their
    /// queue: they are counted as received, and do not arrive again.
    fn drop(&mut self) {
        let gone = self.offered.saturating_sub(self.run.messages.len());
        if gone > 0 {
            self.session.finish_all(Disposition::Forwarded, gone - 1);
            self.session.finish_all(Disposition::Failed, 1);
        }
        while !self.run.messages.is_empty() {
            self.enqueue_next();
        }
    }
}
