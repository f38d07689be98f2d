//! Where a hosted application's messages come from: those that the node has handed over and the actor has not taken.

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

use super::words::{Fate, Turn, WINDOW};

/// The messages that wait, and what the node has to be told. It does nothing itself.
#[derive(Debug)]
pub(super) struct Inbox {
    queue: ClassQueue,
    /// What the node's layers say: ahead of everything else, but for what is said of a node's end. The node's window bounds them.
    events: VecDeque<Message>,
    /// Number of the last message that came.
    last: u64,
    in_hand: Option<u64>,
    /// Messages that went into the hand so far.
    taken: u64,
    /// The actor takes nothing but the layers' events.
    paused: bool,
    done: Option<(u64, Fate)>,
    /// Goes into the hand when the node has been told so.
    claimed: Option<Message>,
    reader: Option<Waker>,
    teller: Option<Waker>,
    mute: Arc<Mute>,
}

impl Inbox {
    pub(super) fn new() -> Self {
        Self {
            queue: ClassQueue::new(WINDOW),
            events: VecDeque::new(),
            last: 0,
            in_hand: None,
            taken: 0,
            paused: false,
            done: None,
            claimed: None,
            reader: None,
            teller: None,
            mute: Arc::new(Mute),
        }
    }

    /// Takes a message that has come. Returns what to tell the node, and whom to wake.
    pub(super) fn push(&mut self, mut message: Message) -> (Option<Turn>, Option<Waker>) {
        self.last += 1;
        let Message { header, .. } = &message;
        // The number goes with the message as a receipt that tells nobody.
        let ticket =
            Ticket { source: header.source, destination: header.destination, correlation: self.last };
        let is_event = is_event(header);
        message.receipt = Some(Receipt::new(self.mute.clone(), ticket));
        if is_event {
            if let Some(event) = self.queue.keep_behind(message) {
                self.events.push_back(event);
            }
            return (None, self.reader.take());
        }
        let gone = match self.queue.push(message) {
            Ok(superseded) => {
                superseded.as_ref().and_then(number_of).map(|number| (number, Fate::Superseded))
            }
            // The node hands over less than there is room for: it would be its fault, and the message is refused.
            Err(refused) => number_of(&refused.message)
                .map(|number| (number, Fate::Ended(Outcome::Rejected(refused.why)))),
        };
        (gone.map(|done| Turn { done: Some(done), taken: None }), self.reader.take())
    }

    /// Claims the next message, if one waits and none is claimed. Returns what to tell the node before it is handled.
    pub(super) fn claim(&mut self) -> Option<Turn> {
        self.paused = false;
        if self.claimed.is_some() {
            return None;
        }
        self.claimed = self.events.pop_front().or_else(|| self.queue.pop());
        self.tell_claim()
    }

    /// The same for the layers' events alone.
    pub(super) fn claim_event(&mut self) -> Option<Turn> {
        self.paused = true;
        // Who takes events alone began so with an event in his hand: nothing else is claimed.
        if self.claimed.is_some() {
            return None;
        }
        self.claimed = self.events.pop_front();
        self.tell_claim()
    }

    fn tell_claim(&mut self) -> Option<Turn> {
        let taken = self.claimed.as_ref().and_then(number_of);
        let done = self.done.take();
        (done.is_some() || taken.is_some()).then_some(Turn { done, taken })
    }

    /// Takes the claimed message into the hand, if the node has been `told`; else wakes the reader later.
    pub(super) fn poll_claimed(&mut self, told: bool, cx: &Context<'_>) -> Poll<Message> {
        match self.claimed.take_if(|_| told) {
            Some(mut message) => {
                self.in_hand = number_of(&message);
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

    /// Messages that wait to be taken, and how many were taken so far.
    pub(super) fn backlog(&self) -> (usize, u64) {
        let queued = if self.paused { 0 } else { self.queue.len() };
        // One that is claimed waits for the node, and not for the actor.
        (self.events.len() + queued, self.taken)
    }

    /// The message in hand has ended so. Returns whom to wake, if nobody asks for the next message.
    pub(super) fn finish(&mut self, outcome: Outcome) -> Option<Waker> {
        self.done = self.in_hand.take().map(|number| (number, Fate::Ended(outcome)));
        self.teller.take()
    }

    /// What is to be told, although no next message was asked for.
    pub(super) fn poll_untold(&mut self, cx: &Context<'_>) -> Option<Turn> {
        self.teller = Some(cx.waker().clone());
        self.untold()
    }

    /// What the node has not been told yet.
    pub(super) fn untold(&mut self) -> Option<Turn> {
        self.done.take().map(|done| Turn { done: Some(done), taken: None })
    }

    /// Whom to wake when the node has been told of the claimed message.
    pub(super) fn told(&mut self) -> Option<Waker> {
        self.reader.take_if(|_| self.claimed.is_some())
    }
}

fn number_of(message: &Message) -> Option<u64> {
    message.receipt.as_ref().map(|receipt| receipt.ticket().correlation)
}

/// A receipt's sink that tells nobody: the node knows what it has handed over.
#[derive(Debug)]
struct Mute;

impl ReceiptSink for Mute {
    fn settle(&self, _: Ticket, _: Outcome) {
        // Inbox::finish has said it, or the process ends.
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
    fn a_message_is_in_hand_only_when_the_node_has_been_told() {
        let mut inbox = Inbox::new();
        let waker = noop_waker();
        let cx = Context::from_waker(&waker);
        inbox.push(message(Class::Bulk, 1));
        inbox.push(message(Class::Control, 2));
        assert_eq!(inbox.claim(), Some(Turn { done: None, taken: Some(2) }), "the most urgent one");
        assert!(inbox.poll_claimed(false, &cx).is_pending());
        assert_eq!(inbox.claim(), None, "it is claimed once");
        assert!(inbox.told().is_some(), "the reader waits for that");
        assert!(inbox.poll_claimed(true, &cx).is_ready());
        inbox.finish(Outcome::Delivered);
        let done = Some((2, Fate::Ended(Outcome::Delivered)));
        assert_eq!(inbox.claim(), Some(Turn { done, taken: Some(1) }));
    }

    #[test]
    fn what_is_said_of_a_nodes_end_is_claimed_behind_what_came_of_it_and_other_events_before() {
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
    fn an_end_is_told_although_nothing_follows_and_only_once() {
        let mut inbox = Inbox::new();
        inbox.push(message(Class::Bulk, 1));
        inbox.claim();
        assert!(inbox.poll_claimed(true, &Context::from_waker(&noop_waker())).is_ready());
        inbox.finish(Outcome::Failed);
        assert_eq!(inbox.untold(), Some(Turn { done: Some((1, Fate::Ended(Outcome::Failed))), taken: None }));
        assert_eq!((inbox.untold(), inbox.claim()), (None, None));
    }

    #[test]
    fn the_node_is_told_of_a_value_that_a_newer_one_replaced() {
        let mut inbox = Inbox::new();
        inbox.push(message(Class::Stream, 1));
        let (told, _) = inbox.push(message(Class::Stream, 2));
        assert_eq!(told, Some(Turn { done: Some((1, Fate::Superseded)), taken: None }));
        assert_eq!(inbox.claim(), Some(Turn { done: None, taken: Some(2) }));
    }
}
