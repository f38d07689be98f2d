//! The messages that a child holds, and their outcomes. Pure.
//!
//! The node keeps each handed-over message until the child reports its outcome. The child reports a message
//! before it handles it. So at any instant of its death the node knows each message's state. The current
//! message may have been handled, and is not handed over again. The others were not handled, and go to the
//! next instance.

use std::collections::VecDeque;

use sinew_runtime::{mailbox::About, wire::Message};

use super::protocol::{Disposition, EVENTS_MAX, Progress, WINDOW};

/// Payload bytes at the child from which on it gets only events.
const BYTES_MAX: usize = 1 << 20;
const WINDOW_AND_EVENTS: usize = WINDOW + EVENTS_MAX;
/// Events on nodes at the child from which on it gets only events that concern no node. During a pause,
/// events on a node may wait at the child behind messages of that node, as long as the pause lasts.
const NODE_EVENTS_MAX: usize = EVENTS_MAX / 2;

/// A message that the child holds.
struct HandedOver {
    number: u64,
    message: Message,
}

/// The messages that one child holds, oldest first.
#[derive(Default)]
pub(super) struct Window {
    messages: VecDeque<HandedOver>,
    /// Payload bytes of these messages.
    bytes: usize,
    /// Number of these messages that are events on nodes.
    about_nodes: usize,
    last: u64,
    current: Option<u64>,
}

/// The kind of message that may be handed over to a child.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Room {
    Any,
    /// Only the layers' events.
    Events,
    /// Only events that concern no node: the event that ends a pause is one.
    EventsWithoutNode,
    Nothing,
}

/// The child's report does not match the messages that it holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the process reported on message {0}, which it does not hold")]
pub(super) struct UnknownMessageError(u64);

/// The remaining messages of a dead child.
#[derive(Debug, Default)]
pub(super) struct Remaining {
    /// The message that it was handling.
    pub(super) current: Option<Message>,
    /// The messages that it did not take, oldest first.
    pub(super) untouched: Vec<Message>,
}

impl Window {
    /// Returns the kind of message that there is room for.
    pub(super) fn room(&self) -> Room {
        match self.messages.len() {
            0..WINDOW if self.bytes < BYTES_MAX => Room::Any,
            WINDOW_AND_EVENTS.. => Room::Nothing,
            _ if self.about_nodes < NODE_EVENTS_MAX => Room::Events,
            _ => Room::EventsWithoutNode,
        }
    }

    /// Stores a message that is handed over now. Messages are numbered from 1 in this order.
    pub(super) fn push(&mut self, message: Message) {
        self.last += 1;
        self.bytes += message.payload.len();
        self.about_nodes += usize::from(is_about_a_node(&message));
        self.messages.push_back(HandedOver { number: self.last, message });
    }

    /// Applies the child's progress. Returns the message that has ended, and its disposition.
    pub(super) fn apply(
        &mut self,
        progress: Progress,
    ) -> Result<Option<(Message, Disposition)>, UnknownMessageError> {
        let ended = match progress.done {
            Some((number, disposition)) => {
                let at = self.find(number)?;
                if self.current == Some(number) {
                    self.current = None;
                }
                let Some(HandedOver { message, .. }) = self.messages.remove(at) else {
                    return Err(UnknownMessageError(number));
                };
                self.bytes -= message.payload.len();
                self.about_nodes -= usize::from(is_about_a_node(&message));
                Some((message, disposition))
            }
            None => None,
        };
        if let Some(number) = progress.taken {
            self.find(number)?;
            self.current = Some(number);
        }
        Ok(ended)
    }

    /// Ends the window of a dead child.
    pub(super) fn end(&mut self) -> Remaining {
        let Self { messages, current, .. } = std::mem::take(self);
        let mut left = Remaining::default();
        for HandedOver { number, message } in messages {
            if current == Some(number) {
                left.current = Some(message);
            } else {
                left.untouched.push(message);
            }
        }
        left
    }

    fn find(&self, number: u64) -> Result<usize, UnknownMessageError> {
        self.messages.iter().position(|held| held.number == number).ok_or(UnknownMessageError(number))
    }
}

fn is_about_a_node(message: &Message) -> bool {
    About::of(&message.header).is_some()
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;
    use proptest::prelude::*;
    use sinew_runtime::{
        outcome::Outcome,
        tid::Tid,
        wire::{Header, Kind},
    };

    use super::*;

    fn message(sequence: u64) -> Message {
        let mut header = Header::new(Kind::named("test"), Tid::NONE, Tid::NONE);
        header.sequence = sequence;
        Message::new(header, Bytes::new())
    }

    const DELIVERED: Disposition = Disposition::Ended(Outcome::Delivered);

    #[test]
    fn current_message_is_not_redelivered() {
        let mut window = Window::default();
        (1..=4).for_each(|number| window.push(message(number)));
        window.apply(Progress { done: None, taken: Some(1) }).unwrap();
        let step = Progress { done: Some((1, DELIVERED)), taken: Some(2) };
        let (ended, disposition) = window.apply(step).unwrap().unwrap();
        assert_eq!((ended.header.sequence, disposition), (1, DELIVERED));
        let left = window.end();
        assert_eq!(left.current.unwrap().header.sequence, 2);
        let untouched: Vec<_> = left.untouched.iter().map(|message| message.header.sequence).collect();
        assert_eq!(untouched, [3, 4]);
    }

    #[test]
    fn report_about_missing_message_is_an_error() {
        let mut window = Window::default();
        window.push(message(1));
        let done = Progress { done: Some((1, DELIVERED)), taken: None };
        assert!(window.apply(done).is_ok());
        assert_eq!(window.apply(done).err(), Some(UnknownMessageError(1)));
        assert_eq!(window.apply(Progress { done: None, taken: Some(2) }).err(), Some(UnknownMessageError(2)));
    }

    proptest! {
        #[test]
        fn every_message_ends_or_is_left_exactly_once(steps in proptest::collection::vec(0u8..3, 0..200)) {
            let (mut window, mut lent, mut seen, mut hand) = (Window::default(), 0, Vec::new(), None);
            for step in steps {
                match step {
                    0 => {
                        lent += 1;
                        window.push(message(lent));
                    }
                    1 if hand.is_none() && seen.len() < lent as usize => {
                        hand = Some(seen.len() as u64 + 1);
                        window.apply(Progress { done: None, taken: hand }).unwrap();
                    }
                    _ => {
                        let Some(number) = hand.take() else { continue };
                        let progress = Progress { done: Some((number, DELIVERED)), taken: None };
                        seen.push(window.apply(progress).unwrap().unwrap().0.header.sequence);
                    }
                }
            }
            let left = window.end();
            prop_assert_eq!(left.current.as_ref().map(|message| message.header.sequence), hand);
            seen.extend(left.current.iter().map(|message| message.header.sequence));
            seen.extend(left.untouched.iter().map(|message| message.header.sequence));
            prop_assert_eq!(seen, (1..=lent).collect::<Vec<_>>());
        }
    }
}
