//! What has come and was not received yet. Pure.

use std::sync::Arc;

use sinew_runtime::{
    mailbox::{Bounds, ClassQueue},
    outcome::{MemberReport, Outcome, Receipt, ReceiptSink, Rejection, Ticket},
    tid::Tid,
    time::Time,
    wire::{Flags, Kind, Message},
};

use crate::lncl::payload::{self, Refusal, Resolved};

/// What an endpoint waits for: one thing at a time, since its calls block.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Awaited {
    /// The outcome of a confirmed message.
    Outcome,
    /// The reply to a request, or an outcome which says that there will be none.
    Reply,
    /// The outcomes of a message to many, one for each member.
    Members,
    /// The TID of a name.
    Resolved,
}

/// What came for the one who waits.
#[derive(Debug)]
pub(super) enum Answer {
    Outcome(Outcome),
    /// A part of what is awaited: further reports follow, or the outcome of the message as a whole.
    Members(Vec<MemberReport>),
    Reply(Message),
    /// The TID of the name, and names that are similar to one that nobody has.
    Resolved(Option<Tid>, Vec<String>),
}

/// What a frame was.
#[derive(Debug)]
pub(super) enum Sorted {
    /// A message; it waits to be received.
    Message,
    /// The answer that was awaited.
    Answer(Answer),
    /// The node ends the connection, for this reason.
    Refusal(Refusal),
    /// Messages of this endpoint's that nobody has taken.
    Undelivered(payload::Undelivered),
    /// Nobody waits for it any more, or this version does not know it.
    Nothing,
}

/// Bytes of their payloads from which on nothing more is taken, but by one who waits for an answer. That one refuses what would
/// make one class longer than this and one message.
const BYTES_ENOUGH: usize = 4 << 20;
/// Messages of each class that are kept at most while an answer is waited for, which may be behind them; or the capacity, if
/// that is more.
const AWAITING_MAX: usize = 16_384;

/// Messages that wait to be received, and the rule by which frames become messages or answers.
pub(super) struct Inbox {
    queue: ClassQueue,
    capacity: usize,
    /// The address that it receives at.
    own: Tid,
    /// Confirmations of what was received go out here.
    sink: Arc<dyn ReceiptSink>,
    /// Messages that were refused and whose senders were told nothing.
    untold: u64,
}

impl Inbox {
    /// For messages to `own` with payloads of so many bytes at most.
    pub(super) fn new(own: Tid, capacity: usize, payload_max: usize, sink: Arc<dyn ReceiptSink>) -> Self {
        // Whoever leaves messages in the socket while there is no room is refused none.
        let bounds =
            Bounds { messages: capacity.max(AWAITING_MAX), bytes: BYTES_ENOUGH.saturating_add(payload_max) };
        Self { queue: ClassQueue::new(bounds), capacity, own, sink, untold: 0 }
    }

    /// How many unconfirmed messages it has refused since the last time that somebody asked.
    pub(super) fn take_untold(&mut self) -> u64 {
        std::mem::take(&mut self.untold)
    }

    /// Confirms what comes from now on, to `own`, over another connection.
    pub(super) fn set_sink(&mut self, own: Tid, sink: Arc<dyn ReceiptSink>) {
        (self.own, self.sink) = (own, sink);
    }

    /// Whether every class has room for one more.
    pub(super) fn has_room(&self) -> bool {
        self.queue.len() < self.capacity && self.queue.bytes() < BYTES_ENOUGH
    }

    /// How many wait.
    pub(super) fn len(&self) -> usize {
        self.queue.len()
    }

    /// Sorts a frame of the node in. One that finds its class full is refused, and its sender told so if it asked.
    pub(super) fn sort(&mut self, message: Message, awaited: Option<(u64, Awaited)>) -> Sorted {
        let sink = self.sink.clone();
        self.sort_from(&sink, message, awaited)
    }

    /// As [`sort`](Self::sort), for a frame that came where `sink` goes back.
    pub(super) fn sort_from(
        &mut self,
        sink: &Arc<dyn ReceiptSink>,
        message: Message,
        awaited: Option<(u64, Awaited)>,
    ) -> Sorted {
        let header = &message.header;
        let awaited = awaited.filter(|(number, _)| *number == header.correlation).map(|(_, what)| what);
        if header.kind.is_user() {
            return if header.flags.has(Flags::REPLY) {
                sort_reply(self.with_receipt(sink, message), awaited)
            } else {
                self.push(self.with_receipt(sink, message));
                Sorted::Message
            };
        }
        match header.kind {
            Kind::OUTCOME => sort_outcome(&message, awaited),
            Kind::MEMBERS => sort_members(&message, awaited),
            Kind::LNCL_RESOLVED => sort_resolved(&message, awaited),
            Kind::LNCL_REFUSAL => Sorted::Refusal(
                payload::read(&message.payload)
                    .unwrap_or_else(|error| Refusal { sentence: error.to_string(), again: false }),
            ),
            Kind::LNCL_UNDELIVERED => {
                payload::read(&message.payload).map_or(Sorted::Nothing, Sorted::Undelivered)
            }
            // A node of a later version may say more than we know.
            _ => Sorted::Nothing,
        }
    }

    /// Refuses a message of the node for which there is no room elsewhere.
    pub(super) fn refuse(&mut self, message: Message) {
        let message = self.with_receipt(&self.sink, message);
        self.reject(message, Rejection::QueueFull);
    }

    /// The next message, most urgent class first. What is too old is not handed out.
    pub(super) fn pop(&mut self, now: Time) -> Option<Message> {
        loop {
            let mut message = self.queue.pop()?;
            if !message.header.is_expired(now) {
                return Some(message);
            }
            message.settle(Outcome::Expired);
        }
    }

    /// Refuses all that waits.
    pub(super) fn close(&mut self) {
        for message in self.queue.drain_all() {
            message.reject(Rejection::Closed);
        }
    }

    /// What becomes of it is said as from this endpoint, also where it was sent to many.
    fn with_receipt(&self, sink: &Arc<dyn ReceiptSink>, mut message: Message) -> Message {
        if message.header.flags.has(Flags::CONFIRM) {
            let Ticket { source, destination, correlation } = message.ticket();
            let destination = if destination.is_single() { destination } else { self.own };
            message.receipt = Some(Receipt::new(sink.clone(), Ticket { source, destination, correlation }));
        }
        message
    }

    fn push(&mut self, message: Message) {
        match self.queue.push(message) {
            // Of a Stream the newest value wins; Stream messages have no receipts.
            Ok(_) => {}
            Err(refused) => self.reject(refused.message, refused.why),
        }
    }

    fn reject(&mut self, message: Message, why: Rejection) {
        if !message.header.flags.has(Flags::CONFIRM) {
            self.untold += 1;
        }
        message.reject(why);
    }
}

fn sort_reply(mut message: Message, awaited: Option<Awaited>) -> Sorted {
    let is_awaited = awaited == Some(Awaited::Reply);
    message.settle(if is_awaited { Outcome::Delivered } else { Outcome::Expired });
    if is_awaited { Sorted::Answer(Answer::Reply(message)) } else { Sorted::Nothing }
}

fn sort_outcome(message: &Message, awaited: Option<Awaited>) -> Sorted {
    let outcome = message.payload.first().and_then(|code| Outcome::from_code(*code));
    match (awaited, outcome) {
        // The reply follows.
        (Some(Awaited::Reply), Some(Outcome::Delivered)) => Sorted::Nothing,
        (Some(Awaited::Outcome | Awaited::Members | Awaited::Reply), Some(outcome)) => {
            Sorted::Answer(Answer::Outcome(outcome))
        }
        (None | Some(Awaited::Resolved), _) | (_, None) => Sorted::Nothing,
    }
}

fn sort_members(message: &Message, awaited: Option<Awaited>) -> Sorted {
    match MemberReport::decode(&message.payload) {
        Some(reports) if awaited == Some(Awaited::Members) => Sorted::Answer(Answer::Members(reports)),
        // What they would say is unknown at the deadline.
        Some(_) | None => Sorted::Nothing,
    }
}

fn sort_resolved(message: &Message, awaited: Option<Awaited>) -> Sorted {
    match payload::read::<Resolved>(&message.payload) {
        Ok(resolved) if awaited == Some(Awaited::Resolved) => {
            Sorted::Answer(Answer::Resolved(resolved.tid.map(Tid::from_bits), resolved.nearest))
        }
        // The wait ends at its deadline.
        Ok(_) | Err(_) => Sorted::Nothing,
    }
}

#[cfg(test)]
mod tests {
    use std::{sync::Mutex, time::Duration};

    use bytes::Bytes;
    use proptest::prelude::*;
    use sinew_runtime::wire::{Class, Header};

    use super::*;

    const OWN: Tid = Tid::from_bits(2);

    #[derive(Default)]
    struct Ledger(Mutex<Vec<(u64, Outcome)>>);

    impl ReceiptSink for Ledger {
        fn settle(&self, ticket: Ticket, outcome: Outcome) {
            self.0.lock().unwrap().push((ticket.correlation, outcome));
        }
    }

    fn confirmed(correlation: u64) -> Message {
        let mut header = Header::new(Kind::named("x"), Tid::from_bits(1), Tid::from_bits(2));
        header.flags = Flags::CONFIRM;
        header.correlation = correlation;
        Message::new(header, Bytes::new())
    }

    fn outcome(correlation: u64, outcome: Outcome) -> Message {
        let mut header = Header::new(Kind::OUTCOME, Tid::from_bits(2), Tid::from_bits(1));
        header.flags = Flags::OUTCOME;
        header.correlation = correlation;
        Message::new(header, Bytes::copy_from_slice(&[outcome.code()]))
    }

    #[test]
    fn a_message_that_finds_no_room_is_refused_and_its_sender_told() {
        let ledger = Arc::new(Ledger::default());
        let mut inbox = Inbox::new(OWN, 1, 1 << 20, ledger.clone());
        inbox.sort(confirmed(1), None);
        assert!(!inbox.has_room());
        for number in 2..=AWAITING_MAX as u64 + 1 {
            inbox.sort(confirmed(number), None);
        }
        let last = AWAITING_MAX as u64 + 1;
        assert_eq!(*ledger.0.lock().unwrap(), [(last, Outcome::Rejected(Rejection::QueueFull))]);
        assert_eq!(inbox.take_untold(), 0, "its sender was told");
    }

    #[test]
    fn each_class_is_bounded_in_bytes_and_what_is_refused_untold_is_counted() {
        const LENGTH: usize = 64 << 10;
        for class in [Class::Control, Class::Stream, Class::Bulk] {
            let mut inbox = Inbox::new(OWN, 4, LENGTH, Arc::new(Ledger::default()));
            let payload = Bytes::from(vec![0; LENGTH]);
            let kept = BYTES_ENOUGH / LENGTH + 1;
            for number in 0..kept + 3 {
                // Of as many kinds, so that none takes the place of another.
                let kind = Kind::named(&number.to_string());
                let mut header = Header::new(kind, Tid::from_bits(1), Tid::from_bits(2));
                header.class = class;
                inbox.sort(Message::new(header, payload.clone()), None);
            }
            assert_eq!((inbox.take_untold(), inbox.take_untold()), (3, 0), "{class:?}");
            assert_eq!(std::iter::from_fn(|| inbox.pop(Time::ZERO)).count(), kept);
        }
    }

    #[test]
    fn whoever_leaves_messages_where_they_are_while_there_is_no_room_is_refused_none() {
        const LONG: usize = 3 << 20;
        let mut inbox = Inbox::new(OWN, 100, LONG, Arc::new(Ledger::default()));
        let mut taken = 0;
        while inbox.has_room() {
            let header = Header::new(Kind::named("x"), Tid::from_bits(1), Tid::from_bits(2));
            inbox.sort(Message::new(header, Bytes::from(vec![0; LONG])), None);
            taken += 1;
        }
        assert_eq!((taken, inbox.take_untold()), (2, 0));
    }

    #[test]
    fn a_message_that_became_too_old_is_not_handed_out() {
        let ledger = Arc::new(Ledger::default());
        let mut inbox = Inbox::new(OWN, 4, 1 << 20, ledger.clone());
        let mut message = confirmed(1);
        message.header.time_to_live_us = 10;
        inbox.sort(message, None);
        assert!(inbox.pop(Time::ZERO + Duration::from_micros(11)).is_none());
        assert_eq!(*ledger.0.lock().unwrap(), [(1, Outcome::Expired)]);
    }

    #[test]
    fn the_newest_value_of_a_stream_is_the_one_that_is_received() {
        let mut inbox = Inbox::new(OWN, 4, 1 << 20, Arc::new(Ledger::default()));
        for value in [1, 2, 3] {
            let mut header = Header::new(Kind::named("angle"), Tid::from_bits(1), Tid::from_bits(2));
            header.class = Class::Stream;
            inbox.sort(Message::new(header, Bytes::copy_from_slice(&[value])), None);
        }
        assert_eq!(inbox.pop(Time::ZERO).unwrap().payload[..], [3]);
        assert!(inbox.pop(Time::ZERO).is_none());
    }

    #[test]
    fn an_outcome_reaches_the_one_who_waits_for_it_and_nobody_else() {
        let mut inbox = Inbox::new(OWN, 4, 1 << 20, Arc::new(Ledger::default()));
        let awaited = Some((7, Awaited::Outcome));
        assert!(matches!(inbox.sort(outcome(6, Outcome::Failed), awaited), Sorted::Nothing));
        let sorted = inbox.sort(outcome(7, Outcome::Failed), awaited);
        assert!(matches!(sorted, Sorted::Answer(Answer::Outcome(Outcome::Failed))));
    }

    #[test]
    fn a_request_that_was_delivered_still_waits_for_its_reply() {
        let mut inbox = Inbox::new(OWN, 4, 1 << 20, Arc::new(Ledger::default()));
        let awaited = Some((7, Awaited::Reply));
        assert!(matches!(inbox.sort(outcome(7, Outcome::Delivered), awaited), Sorted::Nothing));
        let mut reply = confirmed(7);
        reply.header.flags = Flags::REPLY;
        assert!(matches!(inbox.sort(reply, awaited), Sorted::Answer(Answer::Reply(_))));
    }

    proptest! {
        #[test]
        fn anything_that_a_node_may_say_is_sorted(kind: u32, layer in 0u32..0x50, payload: Vec<u8>) {
            let mut inbox = Inbox::new(OWN, 4, 1 << 20, Arc::new(Ledger::default()));
            for kind in [kind, layer] {
                let header = Header::new(Kind::from_bits(kind), Tid::from_bits(1), Tid::from_bits(2));
                for awaited in [Awaited::Outcome, Awaited::Members, Awaited::Reply, Awaited::Resolved] {
                    let message = Message::new(header, Bytes::copy_from_slice(&payload));
                    inbox.sort(message, Some((0, awaited)));
                }
            }
        }
    }
}
