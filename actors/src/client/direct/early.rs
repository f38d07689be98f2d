//! What came through the node and was sent after what a link's ring still holds: it waits for its turn.

use super::*;

/// Messages at most that wait for the rest of a ring of which the sender has said no more. One more is refused as `QueueFull`.
const EARLY_MAX: usize = 4_096;
/// Bytes of their payloads at most, and one message.
const EARLY_BYTES_MAX: usize = 4 << 20;

/// What one who has ended its link, or its next life, has sent through the node.
pub(super) struct Early {
    /// The link that is read first.
    pub(super) after: LinkNumber,
    messages: VecDeque<Message>,
    /// Of their payloads.
    bytes: usize,
}

impl Early {
    /// Nothing yet.
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

/// What is to be done with a message that came through the node.
pub(in crate::client) enum InTurn {
    /// To be sorted in.
    Now(Message),
    /// It is kept until its turn has come.
    Later,
    /// Too many are kept: to be refused.
    Never(Message),
}

impl Direct {
    /// Keeps back what was sent after what is left in its sender's ring.
    pub(in crate::client) fn keep_early(&mut self, message: Message) -> InTurn {
        let header = &message.header;
        // A group is another destination: its order is its own.
        if self.is_empty() || !header.kind.is_user() || header.destination != self.terms.own {
            return InTurn::Now(message);
        }
        let (source, class) = (header.source, header.class);
        let after = match self.early.get(&source) {
            Some(early) => early.after,
            None => match self.routes.passed(source, class, Time::now()) {
                Passed::Take => return InTurn::Now(message),
                Passed::AfterLink(after) => after,
            },
        };
        let held = self.early.values().map(|early| (early.messages.len(), early.bytes));
        let (messages, bytes) = held.fold((0, 0), |all, one| (all.0 + one.0, all.1 + one.1));
        if messages >= EARLY_MAX || bytes >= EARLY_BYTES_MAX {
            return InTurn::Never(message);
        }
        self.early.entry(source).or_insert_with(|| Early::after(after)).push(message);
        InTurn::Later
    }

    /// The next of those that were kept back whose turn has come.
    pub(in crate::client) fn next_early(&mut self, now: Time) -> Option<Message> {
        if self.early.is_empty() {
            return None;
        }
        self.pop_early().or_else(|| {
            self.see_ends(now);
            self.pop_early()
        })
    }

    fn pop_early(&mut self) -> Option<Message> {
        let routes = &self.routes;
        let is_due = |(source, early): &(&Tid, &mut Early)| routes.link(**source) != Some(early.after);
        let (source, early) = self.early.iter_mut().find(is_due)?;
        let (source, message) = (*source, early.pop());
        if early.messages.is_empty() {
            self.early.remove(&source);
        }
        message
    }
}

#[cfg(test)]
mod tests {
    use sinew_runtime::wire::{Header, Kind};

    use super::*;

    #[test]
    fn what_has_had_its_turn_takes_no_room_any_more() {
        let message = |length: usize| {
            let header = Header::new(Kind::named("early"), Tid::from_bits(1), Tid::from_bits(2));
            Message::new(header, vec![0; length].into())
        };
        let mut early = Early::after(LinkNumber(1));
        [100, 0, 7].into_iter().for_each(|length| early.push(message(length)));
        assert_eq!(early.bytes, 107);

        let lengths: Vec<usize> =
            std::iter::from_fn(|| early.pop()).map(|message| message.payload.len()).collect();

        assert_eq!((lengths, early.bytes), (vec![100, 0, 7], 0));
    }
}
