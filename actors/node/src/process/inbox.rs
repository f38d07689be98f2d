//! The messages of a hosted application that the node has handed over and the actor has not taken.

use std::{
    collections::VecDeque,
    sync::Arc,
    task::{Context, Poll, Waker},
};

use sinew_runtime::{
    mailbox::{ClassQueue, is_event},
    outcome::{Outcome, Receipt, ReceiptSink, Ticket},
    wire::Message,
};

use super::protocol::{Disposition, Progress, WINDOW};

/// The waiting messages, and the pending reports to the node. It does no I/O itself.
#[derive(Debug)]
pub(super) struct Inbox {
    queue: ClassQueue,
    /// Events of the node's layers, ahead of all other messages. An event on a node's end may stay in
    /// `queue`, behind that node's messages. The node's window bounds them.
    events: VecDeque<Message>,
    /// Number of the last message that arrived.
    last: u64,
    current: Option<u64>,
    /// Number of messages that the actor has taken so far.
    taken: u64,
    /// The actor takes only the layers' events.
    paused: bool,
    done: Option<(u64, Disposition)>,
    /// Handed to the actor once the node is notified.
    claimed: Option<Message>,
    reader: Option<Waker>,
    reporter: Option<Waker>,
    no_report: Arc<NoReport>,
}

impl Inbox {
    pub(super) fn new() -> Self {
        Self {
            queue: ClassQueue::new(WINDOW),
            events: VecDeque::new(),
            last: 0,
            current: None,
            taken: 0,
            paused: false,
            done: None,
            claimed: None,
            reader: None,
            reporter: None,
            no_report: Arc::new(NoReport),
        }
    }

    /// Adds a message that has arrived. Returns the report for the node, and the waker of the reader.
    pub(super) fn push(&mut self, mut message: Message) -> (Option<Progress>, Option<Waker>) {
        self.last += 1;
        let Message { header, .. } = &message;
        // The message carries its number as a receipt that reports to no one.
        let ticket =
            Ticket { source: header.source, destination: header.destination, correlation: self.last };
        let is_event = is_event(header);
        message.receipt = Some(Receipt::new(self.no_report.clone(), ticket));
        if is_event {
            if let Some(event) = self.queue.queue_behind(message) {
                self.events.push_back(event);
            }
            return (None, self.reader.take());
        }
        let ended = match self.queue.push(message) {
            Ok(superseded) => {
                superseded.as_ref().and_then(number_of).map(|number| (number, Disposition::Superseded))
            }
            // The node hands over only as many messages as fit. An overflow is a fault of the node, and the
            // message is rejected.
            Err(refused) => number_of(&refused.message)
                .map(|number| (number, Disposition::Ended(Outcome::Rejected(refused.why)))),
        };
        (ended.map(|done| Progress { done: Some(done), taken: None }), self.reader.take())
    }

    /// Claims the next message, if one waits and none is claimed. Returns the report that the node must get
    /// before the message is handled.
    pub(super) fn claim(&mut self) -> Option<Progress> {
        self.paused = false;
        if self.claimed.is_some() {
            return None;
        }
        self.claimed = self.events.pop_front().or_else(|| self.queue.pop());
        self.report_claim()
    }

    /// Same as [`Self::claim`], for the layers' events only.
    pub(super) fn claim_event(&mut self) -> Option<Progress> {
        self.paused = true;
        // An actor that takes only events started that with an event as its current message, so no other
        // message is claimed.
        if self.claimed.is_some() {
            return None;
        }
        self.claimed = self.events.pop_front();
        self.report_claim()
    }

    fn report_claim(&mut self) -> Option<Progress> {
        let taken = self.claimed.as_ref().and_then(number_of);
        let done = self.done.take();
        (done.is_some() || taken.is_some()).then_some(Progress { done, taken })
    }

    /// Hands the claimed message to the actor if the node was notified, as `reported` states. Otherwise
    /// stores the reader's waker.
    pub(super) fn poll_claimed(&mut self, reported: bool, cx: &Context<'_>) -> Poll<Message> {
        match self.claimed.take_if(|_| reported) {
            Some(mut message) => {
                self.current = number_of(&message);
                self.taken += 1;
                message.receipt = None;
                Poll::Ready(message)
            }
            None => {
                self.reader = Some(cx.waker().clone());
                Poll::Pending
            }
        }
    }

    /// Returns the number of waiting messages, and the number of those taken so far.
    pub(super) fn backlog(&self) -> (usize, u64) {
        let queued = if self.paused { 0 } else { self.queue.len() };
        // A claimed message waits for the node, not for the actor.
        (self.events.len() + queued, self.taken)
    }

    /// Finishes the current message with this outcome. Returns the waker of the reporter, which runs if no
    /// next message is requested.
    pub(super) fn finish(&mut self, outcome: Outcome) -> Option<Waker> {
        self.done = self.current.take().map(|number| (number, Disposition::Ended(outcome)));
        self.reporter.take()
    }

    /// Returns the pending report if no next message was requested, and stores the reporter's waker.
    pub(super) fn poll_unreported(&mut self, cx: &Context<'_>) -> Option<Progress> {
        self.reporter = Some(cx.waker().clone());
        self.take_unreported()
    }

    /// Returns the pending report to the node.
    pub(super) fn take_unreported(&mut self) -> Option<Progress> {
        self.done.take().map(|done| Progress { done: Some(done), taken: None })
    }

    /// Returns the waker of the reader once the node was notified of the claimed message.
    pub(super) fn progress_was_reported(&mut self) -> Option<Waker> {
        self.reader.take_if(|_| self.claimed.is_some())
    }
}

fn number_of(message: &Message) -> Option<u64> {
    message.receipt.as_ref().map(|receipt| receipt.ticket().correlation)
}

/// A receipt sink that reports to no one: the node knows the messages that it has handed over.
#[derive(Debug)]
struct NoReport;

impl ReceiptSink for NoReport {
    fn settle(&self, _: Ticket, _: Outcome) {
        // `Inbox::finish` has reported it, or the process ends.
    }
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;
    use futures_util::task::noop_waker;
    use sinew_runtime::{
        mailbox::About,
        tid::{AppAddress, NodeAddress, Tid},
        wire::{Class, Header, Kind},
    };

    use super::*;

    fn message(class: Class, sequence: u64) -> Message {
        let mut header = Header::new(Kind::named("test"), Tid::NONE, Tid::NONE);
        (header.class, header.sequence) = (class, sequence);
        Message::new(header, Bytes::new())
    }

    #[test]
    fn message_is_claimed_only_after_notice_to_node() {
        let mut inbox = Inbox::new();
        let waker = noop_waker();
        let cx = Context::from_waker(&waker);
        inbox.push(message(Class::Bulk, 1));
        inbox.push(message(Class::Control, 2));
        assert_eq!(inbox.claim(), Some(Progress { done: None, taken: Some(2) }), "the most urgent one");
        assert!(inbox.poll_claimed(false, &cx).is_pending());
        assert_eq!(inbox.claim(), None, "it is claimed once");
        assert!(inbox.progress_was_reported().is_some(), "the reader waits for that");
        assert!(inbox.poll_claimed(true, &cx).is_ready());
        inbox.finish(Outcome::Delivered);
        let done = Some((2, Disposition::Ended(Outcome::Delivered)));
        assert_eq!(inbox.claim(), Some(Progress { done, taken: Some(1) }));
    }

    #[test]
    fn node_end_event_is_claimed_after_its_messages() {
        let (here, gone) = (NodeAddress::new(1), NodeAddress::new(2));
        let app = AppAddress::new(0x1000);
        let of = |source: Tid, sequence: u64| {
            let mut message = message(Class::Bulk, sequence);
            (message.header.source, message.header.destination) = (source, Tid::new(here, app));
            message
        };
        let event = |about: About, sequence: u64| {
            let mut event = of(Tid::new(here, AppAddress::NDL), sequence);
            about.write(&mut event.header);
            event
        };
        let mut inbox = Inbox::new();
        inbox.push(of(Tid::new(gone, app), 1));
        inbox.push(event(About::End(gone), 2));
        inbox.push(event(About::End(here), 3));
        let (waker, mut order) = (noop_waker(), Vec::new());
        while inbox.claim().is_some() {
            let Poll::Ready(message) = inbox.poll_claimed(true, &Context::from_waker(&waker)) else { break };
            order.push(message.header.sequence);
        }
        assert_eq!(order, [3, 1, 2]);
    }

    #[test]
    fn end_is_reported_once_without_a_next_message() {
        let mut inbox = Inbox::new();
        inbox.push(message(Class::Bulk, 1));
        inbox.claim();
        assert!(inbox.poll_claimed(true, &Context::from_waker(&noop_waker())).is_ready());
        inbox.finish(Outcome::Failed);
        assert_eq!(
            inbox.take_unreported(),
            Some(Progress { done: Some((1, Disposition::Ended(Outcome::Failed))), taken: None })
        );
        assert_eq!((inbox.take_unreported(), inbox.claim()), (None, None));
    }

    #[test]
    fn node_is_notified_of_replaced_value() {
        let mut inbox = Inbox::new();
        inbox.push(message(Class::Stream, 1));
        let (report, _) = inbox.push(message(Class::Stream, 2));
        assert_eq!(report, Some(Progress { done: Some((1, Disposition::Superseded)), taken: None }));
        assert_eq!(inbox.claim(), Some(Progress { done: None, taken: Some(2) }));
    }
}
