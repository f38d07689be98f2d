//! Messages that arrived through the node but were sent after messages that are still in a link's ring. They
//! wait for their turn.

use super::*;
use crate::routes::NodeDelivery;

/// Maximum number of messages that wait for the rest of a ring which its sender no longer writes. A further
/// message is refused as `QueueFull`.
const REORDERED_MAX: usize = 4_096;
/// Maximum bytes of their payloads; one message is always accepted.
const REORDERED_BYTES_MAX: usize = 4 << 20;

/// Messages that arrived through the node from a sender that has ended its link, or from its next
/// incarnation.
pub(super) struct ReorderBuffer {
    /// The link that is read first.
    pub(super) after: LinkNumber,
    messages: VecDeque<Message>,
    /// Bytes of the payloads.
    bytes: usize,
}

impl ReorderBuffer {
    /// Returns an empty queue.
    pub(super) const fn after(after: LinkNumber) -> Self {
        Self { after, messages: VecDeque::new(), bytes: 0 }
    }

    fn push(&mut self, message: Message) {
        self.bytes += message.payload.len();
        self.messages.push_back(message);
    }

    fn pop(&mut self) -> Option<Message> {
        let message = self.messages.pop_front()?;
        self.bytes -= message.payload.len();
        Some(message)
    }
}

/// How to handle a message that arrived through the node.
pub(crate) enum ReorderDecision {
    /// Handle the message now.
    Deliver(Message),
    /// The message is kept until its turn.
    Kept,
    /// Refuse the message: too many are kept.
    Refuse(Message),
}

impl Direct {
    /// Keeps a message back if it was sent after messages that are still in its sender's ring.
    pub(crate) fn reorder(&mut self, message: Message) -> ReorderDecision {
        let header = &message.header;
        // A group is another destination and has its own order.
        if self.is_empty() || !header.kind.is_user() || header.destination != self.terms.own {
            return ReorderDecision::Deliver(message);
        }
        let (source, class) = (header.source, header.class);
        let after = match self.reordered.get(&source) {
            Some(buffer) => buffer.after,
            None => match self.routes.on_node_message(source, class, Time::now()) {
                NodeDelivery::Take => return ReorderDecision::Deliver(message),
                NodeDelivery::AfterLink(after) => after,
            },
        };
        let held = self.reordered.values().map(|buffer| (buffer.messages.len(), buffer.bytes));
        let (messages, bytes) = held.fold((0, 0), |all, one| (all.0 + one.0, all.1 + one.1));
        if messages >= REORDERED_MAX || bytes >= REORDERED_BYTES_MAX {
            return ReorderDecision::Refuse(message);
        }
        self.reordered.entry(source).or_insert_with(|| ReorderBuffer::after(after)).push(message);
        ReorderDecision::Kept
    }

    /// Returns the next kept message that is due.
    pub(crate) fn next_reordered(&mut self, now: Time) -> Option<Message> {
        if self.reordered.is_empty() {
            return None;
        }
        self.pop_reordered().or_else(|| {
            self.check_hang_ups(now);
            self.pop_reordered()
        })
    }

    fn pop_reordered(&mut self) -> Option<Message> {
        let routes = &self.routes;
        let is_due =
            |(source, buffer): &(&Tid, &mut ReorderBuffer)| routes.link(**source) != Some(buffer.after);
        let (source, buffer) = self.reordered.iter_mut().find(is_due)?;
        let (source, message) = (*source, buffer.pop());
        if buffer.messages.is_empty() {
            self.reordered.remove(&source);
        }
        message
    }
}

#[cfg(test)]
mod tests {
    use sinew_runtime::wire::{Header, Kind};

    use super::*;

    #[test]
    fn released_message_occupies_no_room() {
        let message = |length: usize| {
            let header = Header::new(Kind::named("early"), Tid::from_bits(1), Tid::from_bits(2));
            Message::new(header, vec![0; length].into())
        };
        let mut buffer = ReorderBuffer::after(LinkNumber(1));
        [100, 0, 7].into_iter().for_each(|length| buffer.push(message(length)));
        assert_eq!(buffer.bytes, 107);

        let lengths: Vec<usize> =
            std::iter::from_fn(|| buffer.pop()).map(|message| message.payload.len()).collect();

        assert_eq!((lengths, buffer.bytes), (vec![100, 0, 7], 0));
    }
}
