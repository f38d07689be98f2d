//! Messages that have arrived and were not received yet. Pure.

use std::sync::Arc;

use sinew_runtime::{
    mailbox::{Bounds, ClassQueue},
    outcome::{MemberReport, Outcome, Receipt, ReceiptSink, Rejection, Ticket},
    tid::Tid,
    time::Time,
    wire::{Flags, Kind, Message},
};

use sinew_protocol::payload::{self, Refusal, Resolved};

/// The kind of answer that an endpoint awaits: one at a time, because its calls block.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Awaited {
    /// The outcome of a confirmed message.
    Outcome,
    /// The reply to a request, or an outcome that excludes a reply.
    Reply,
    /// The outcomes of a message to many, one for each member.
    Members,
    /// The TID of a name.
    Resolved,
}

/// The answer to a waiting call.
#[derive(Debug)]
pub(super) enum Answer {
    Outcome(Outcome),
    /// A part of the awaited answer: further reports follow, or the outcome of the message as a whole.
    Members(Vec<MemberReport>),
    Reply(Message),
    /// The TID of the name, and similar names if no application has that name.
    Resolved(Option<Tid>, Vec<String>),
}

/// The meaning of a frame.
#[derive(Debug)]
pub(super) enum Sorted {
    /// A message that waits to be received.
    Message,
    /// The answer that was awaited.
    Answer(Answer),
    /// The node ends the connection, for this reason.
    Refusal(Refusal),
    /// Messages of this endpoint that no application has taken.
    Undelivered(payload::Undelivered),
    /// No call waits for it any more, or this version does not know it.
    Nothing,
}

/// Bytes of payloads beyond which only a call that awaits an answer reads further messages. Such a call
/// refuses messages that would exceed this size and one message in their class.
const BYTES_ENOUGH: usize = 4 << 20;
/// Maximum number of messages per class that are kept while an answer is awaited, which may be behind them;
/// the capacity if that is larger.
const AWAITING_MAX: usize = 16_384;

/// Messages that wait to be received, and the rule by which frames become messages or answers.
pub(super) struct Inbox {
    queue: ClassQueue,
    capacity: usize,
    /// The address at which it receives.
    own: Tid,
    /// The sink for confirmations of received messages.
    sink: Arc<dyn ReceiptSink>,
    /// Number of refused messages without a notification to their senders.
    unreported: u64,
}

impl Inbox {
    /// Returns an inbox for messages to `own` with payloads of at most this many bytes.
    pub(super) fn new(own: Tid, capacity: usize, payload_max: usize, sink: Arc<dyn ReceiptSink>) -> Self {
        // An endpoint that leaves messages in the socket while there is no room refuses none.
        let bounds =
            Bounds { messages: capacity.max(AWAITING_MAX), bytes: BYTES_ENOUGH.saturating_add(payload_max) };
        Self { queue: ClassQueue::new(bounds), capacity, own, sink, unreported: 0 }
    }

    /// Returns the number of unconfirmed messages refused since the last call.
    pub(super) fn take_unreported(&mut self) -> u64 {
        std::mem::take(&mut self.unreported)
    }

    /// Sends the confirmations of later messages, to `own`, over another connection.
    pub(super) fn set_sink(&mut self, own: Tid, sink: Arc<dyn ReceiptSink>) {
        (self.own, self.sink) = (own, sink);
    }

    /// Returns whether every class has room for one more.
    pub(super) fn has_room(&self) -> bool {
        self.queue.len() < self.capacity && self.queue.bytes() < BYTES_ENOUGH
    }

    /// Returns whether no message waits, and one more would leave room.
    pub(super) fn is_idle(&self) -> bool {
        self.queue.is_empty() && self.capacity > 1
    }

    /// Returns the number of waiting messages.
    pub(super) fn len(&self) -> usize {
        self.queue.len()
    }

    /// Sorts in a frame of the node. A message of a full class is refused, and its sender is notified if it
    /// requested that.
    pub(super) fn sort(&mut self, message: Message, awaited: Option<(u64, Awaited)>) -> Sorted {
        let sink = self.sink.clone();
        self.sort_from(&sink, message, awaited)
    }

    /// Like [`sort`](Self::sort), for a frame that is confirmed to `sink`.
    pub(super) fn sort_from(
        &mut self,
        sink: &Arc<dyn ReceiptSink>,
        mut message: Message,
        awaited: Option<(u64, Awaited)>,
    ) -> Sorted {
        let header = &message.header;
        let awaited = awaited.filter(|(number, _)| *number == header.correlation).map(|(_, what)| what);
        if header.kind.is_user() {
            self.add_receipt(sink, &mut message);
            return if message.header.flags.has(Flags::REPLY) {
                sort_reply(message, awaited)
            } else {
                self.push(message);
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
            // A node of a later version may send frames unknown to this version.
            _ => Sorted::Nothing,
        }
    }

    /// Returns a frame that nothing waits before and nothing has followed, if it is a message that can be received at
    /// once. Otherwise sorts it in as [`sort_from`](Self::sort_from) does while no answer is awaited.
    pub(super) fn pass(
        &mut self,
        sink: &Arc<dyn ReceiptSink>,
        mut message: Message,
        now: Time,
    ) -> Option<Message> {
        let header = &message.header;
        if !header.kind.is_user() || header.flags.has(Flags::REPLY) || header.is_expired(now) {
            self.sort_from(sink, message, None);
            return None;
        }
        self.add_receipt(sink, &mut message);
        Some(message)
    }

    /// Refuses a message of the node for which there is no room elsewhere.
    pub(super) fn refuse(&mut self, mut message: Message) {
        self.add_receipt(&self.sink, &mut message);
        self.reject(message, Rejection::QueueFull);
    }

    /// Returns the next message, most urgent class first. Expired messages are not returned.
    pub(super) fn pop(&mut self, now: Time) -> Option<Message> {
        loop {
            let mut message = self.queue.pop()?;
            if !message.header.is_expired(now) {
                return Some(message);
            }
            message.settle(Outcome::Expired);
        }
    }

    /// Refuses all waiting messages.
    pub(super) fn close(&mut self) {
        for message in self.queue.drain_all() {
            message.reject(Rejection::Closed);
        }
    }

    /// Attaches a receipt. The outcome is reported with this endpoint as its source, even for a message to many.
    fn add_receipt(&self, sink: &Arc<dyn ReceiptSink>, message: &mut Message) {
        if message.header.flags.has(Flags::CONFIRM) {
            let Ticket { source, destination, correlation } = message.ticket();
            let destination = if destination.is_single() { destination } else { self.own };
            message.receipt = Some(Receipt::new(sink.clone(), Ticket { source, destination, correlation }));
        }
    }

    fn push(&mut self, message: Message) {
        match self.queue.push(message) {
            // For a Stream the newest value supersedes the others; Stream messages have no receipts.
            Ok(_) => {}
            Err(refused) => self.reject(refused.message, refused.why),
        }
    }

    fn reject(&mut self, message: Message, why: Rejection) {
        if !message.header.flags.has(Flags::CONFIRM) {
            self.unreported += 1;
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
        // Their outcomes are unknown at the deadline.
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
    struct OutcomeLog(Mutex<Vec<(u64, Outcome)>>);

    impl ReceiptSink for OutcomeLog {
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
    fn message_without_room_is_refused_with_notice() {
        let outcome_log = Arc::new(OutcomeLog::default());
        let mut inbox = Inbox::new(OWN, 1, 1 << 20, outcome_log.clone());
        inbox.sort(confirmed(1), None);
        assert!(!inbox.has_room());
        for number in 2..=AWAITING_MAX as u64 + 1 {
            inbox.sort(confirmed(number), None);
        }
        let last = AWAITING_MAX as u64 + 1;
        assert_eq!(*outcome_log.0.lock().unwrap(), [(last, Outcome::Rejected(Rejection::QueueFull))]);
        assert_eq!(inbox.take_unreported(), 0, "its sender was notified");
    }

    #[test]
    fn silently_refused_messages_beyond_class_bound_are_counted() {
        const LENGTH: usize = 64 << 10;
        for class in [Class::Control, Class::Stream, Class::Bulk] {
            let mut inbox = Inbox::new(OWN, 4, LENGTH, Arc::new(OutcomeLog::default()));
            let payload = Bytes::from(vec![0; LENGTH]);
            let kept = BYTES_ENOUGH / LENGTH + 1;
            for number in 0..kept + 3 {
                // Each value is of another kind, so that none replaces another.
                let kind = Kind::named(&number.to_string());
                let mut header = Header::new(kind, Tid::from_bits(1), Tid::from_bits(2));
                header.class = class;
                inbox.sort(Message::new(header, payload.clone()), None);
            }
            assert_eq!((inbox.take_unreported(), inbox.take_unreported()), (3, 0), "{class:?}");
            assert_eq!(std::iter::from_fn(|| inbox.pop(Time::ZERO)).count(), kept);
        }
    }

    #[test]
    fn leaving_messages_in_place_refuses_none() {
        const LONG: usize = 3 << 20;
        let mut inbox = Inbox::new(OWN, 100, LONG, Arc::new(OutcomeLog::default()));
        let mut taken = 0;
        while inbox.has_room() {
            let header = Header::new(Kind::named("x"), Tid::from_bits(1), Tid::from_bits(2));
            inbox.sort(Message::new(header, Bytes::from(vec![0; LONG])), None);
            taken += 1;
        }
        assert_eq!((taken, inbox.take_unreported()), (2, 0));
    }

    #[test]
    fn expired_message_is_not_received() {
        let outcome_log = Arc::new(OutcomeLog::default());
        let mut inbox = Inbox::new(OWN, 4, 1 << 20, outcome_log.clone());
        let mut message = confirmed(1);
        message.header.time_to_live_us = 10;
        inbox.sort(message, None);
        assert!(inbox.pop(Time::ZERO + Duration::from_micros(11)).is_none());
        assert_eq!(*outcome_log.0.lock().unwrap(), [(1, Outcome::Expired)]);
    }

    #[test]
    fn newest_stream_value_is_received() {
        let mut inbox = Inbox::new(OWN, 4, 1 << 20, Arc::new(OutcomeLog::default()));
        for value in [1, 2, 3] {
            let mut header = Header::new(Kind::named("angle"), Tid::from_bits(1), Tid::from_bits(2));
            header.class = Class::Stream;
            inbox.sort(Message::new(header, Bytes::copy_from_slice(&[value])), None);
        }
        assert_eq!(inbox.pop(Time::ZERO).unwrap().payload[..], [3]);
        assert!(inbox.pop(Time::ZERO).is_none());
    }

    #[test]
    fn outcome_reaches_only_its_waiter() {
        let mut inbox = Inbox::new(OWN, 4, 1 << 20, Arc::new(OutcomeLog::default()));
        let awaited = Some((7, Awaited::Outcome));
        assert!(matches!(inbox.sort(outcome(6, Outcome::Failed), awaited), Sorted::Nothing));
        let sorted = inbox.sort(outcome(7, Outcome::Failed), awaited);
        assert!(matches!(sorted, Sorted::Answer(Answer::Outcome(Outcome::Failed))));
    }

    #[test]
    fn delivered_request_still_waits_for_reply() {
        let mut inbox = Inbox::new(OWN, 4, 1 << 20, Arc::new(OutcomeLog::default()));
        let awaited = Some((7, Awaited::Reply));
        assert!(matches!(inbox.sort(outcome(7, Outcome::Delivered), awaited), Sorted::Nothing));
        let mut reply = confirmed(7);
        reply.header.flags = Flags::REPLY;
        assert!(matches!(inbox.sort(reply, awaited), Sorted::Answer(Answer::Reply(_))));
    }

    proptest! {
        #[test]
        fn any_frame_of_node_is_sorted(kind: u32, layer in 0u32..0x50, payload: Vec<u8>) {
            let mut inbox = Inbox::new(OWN, 4, 1 << 20, Arc::new(OutcomeLog::default()));
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
