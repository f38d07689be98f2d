//! Which messages a child has, and what becomes of them. Pure.
//!
//! The node keeps every message that it has handed over until the child says what became of it. The child says which
//! message it takes into its hand before it handles it. So when it dies, whatever the instant, the node knows: the one
//! in its hand may have been handled, and is not handed over again; the others were not, and go to the next instance.

use std::collections::VecDeque;

use sinew_runtime::{mailbox::About, wire::Message};

use super::words::{EVENTS_MAX, Fate, Turn, WINDOW};

/// Bytes of the payloads that a child has, from which on it gets no further message.
const BYTES_ENOUGH: usize = 1 << 20;
const WINDOW_AND_EVENTS: usize = WINDOW + EVENTS_MAX;
/// Events about nodes that it has, from which on it gets only such as are about none: in a pause those about a node may wait there behind
/// messages of it, as long as the pause lasts.
const ABOUT_NODES_ENOUGH: usize = EVENTS_MAX / 2;

/// A message that the child has.
struct Lent {
    number: u64,
    message: Message,
}

/// The messages that one child has, oldest first.
#[derive(Default)]
pub(super) struct Window {
    lent: VecDeque<Lent>,
    /// Bytes of their payloads.
    bytes: usize,
    /// Those that are events about nodes.
    about_nodes: usize,
    last: u64,
    in_hand: Option<u64>,
}

/// What a child may be handed over.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Room {
    Any,
    /// The layers' events.
    Events,
    /// Those of them that are about no node: what ends a pause is one.
    EventsAboutNobody,
    Nothing,
}

/// What the child said does not agree with what it was given.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the process speaks of a message {0} that it does not have")]
pub(super) struct NoSuchMessage(u64);

/// What is left of a child that has died.
#[derive(Debug, Default)]
pub(super) struct Left {
    /// The message in its hand.
    pub(super) in_hand: Option<Message>,
    /// Those that it never touched, oldest first.
    pub(super) untouched: Vec<Message>,
}

impl Window {
    /// What there is room for.
    pub(super) fn room(&self) -> Room {
        match self.lent.len() {
            0..WINDOW if self.bytes < BYTES_ENOUGH => Room::Any,
            WINDOW_AND_EVENTS.. => Room::Nothing,
            _ if self.about_nodes < ABOUT_NODES_ENOUGH => Room::Events,
            _ => Room::EventsAboutNobody,
        }
    }

    /// Remembers a message that goes to the child now; messages are numbered from 1 in this order.
    pub(super) fn lend(&mut self, message: Message) {
        self.last += 1;
        self.bytes += message.payload.len();
        self.about_nodes += usize::from(is_about_a_node(&message));
        self.lent.push_back(Lent { number: self.last, message });
    }

    /// The child has made a step. Returns the message that has ended, and how.
    pub(super) fn turn(&mut self, turn: Turn) -> Result<Option<(Message, Fate)>, NoSuchMessage> {
        let ended = match turn.done {
            Some((number, fate)) => {
                let at = self.find(number)?;
                if self.in_hand == Some(number) {
                    self.in_hand = None;
                }
                let Some(Lent { message, .. }) = self.lent.remove(at) else {
                    return Err(NoSuchMessage(number));
                };
                self.bytes -= message.payload.len();
                self.about_nodes -= usize::from(is_about_a_node(&message));
                Some((message, fate))
            }
            None => None,
        };
        if let Some(number) = turn.taken {
            self.find(number)?;
            self.in_hand = Some(number);
        }
        Ok(ended)
    }

    /// The child is dead.
    pub(super) fn end(&mut self) -> Left {
        let Self { lent, in_hand, .. } = std::mem::take(self);
        let mut left = Left::default();
        for Lent { number, message } in lent {
            if in_hand == Some(number) {
                left.in_hand = Some(message);
            } else {
                left.untouched.push(message);
            }
        }
        left
    }

    fn find(&self, number: u64) -> Result<usize, NoSuchMessage> {
        self.lent.iter().position(|lent| lent.number == number).ok_or(NoSuchMessage(number))
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

    const DELIVERED: Fate = Fate::Ended(Outcome::Delivered);

    #[test]
    fn the_one_in_hand_is_not_handed_over_again_and_the_others_are_in_order() {
        let mut window = Window::default();
        (1..=4).for_each(|number| window.lend(message(number)));
        window.turn(Turn { done: None, taken: Some(1) }).unwrap();
        let step = Turn { done: Some((1, DELIVERED)), taken: Some(2) };
        let (ended, fate) = window.turn(step).unwrap().unwrap();
        assert_eq!((ended.header.sequence, fate), (1, DELIVERED));
        let left = window.end();
        assert_eq!(left.in_hand.unwrap().header.sequence, 2);
        let untouched: Vec<_> = left.untouched.iter().map(|message| message.header.sequence).collect();
        assert_eq!(untouched, [3, 4]);
    }

    #[test]
    fn nobody_speaks_of_a_message_that_he_does_not_have() {
        let mut window = Window::default();
        window.lend(message(1));
        let done = Turn { done: Some((1, DELIVERED)), taken: None };
        assert!(window.turn(done).is_ok());
        assert_eq!(window.turn(done).err(), Some(NoSuchMessage(1)));
        assert_eq!(window.turn(Turn { done: None, taken: Some(2) }).err(), Some(NoSuchMessage(2)));
    }

    proptest! {
        #[test]
        fn every_message_ends_or_is_left_exactly_once(steps in proptest::collection::vec(0u8..3, 0..200)) {
            let (mut window, mut lent, mut seen, mut hand) = (Window::default(), 0, Vec::new(), None);
            for step in steps {
                match step {
                    0 => {
                        lent += 1;
                        window.lend(message(lent));
                    }
                    1 if hand.is_none() && seen.len() < lent as usize => {
                        hand = Some(seen.len() as u64 + 1);
                        window.turn(Turn { done: None, taken: hand }).unwrap();
                    }
                    _ => {
                        let Some(number) = hand.take() else { continue };
                        let turn = Turn { done: Some((number, DELIVERED)), taken: None };
                        seen.push(window.turn(turn).unwrap().unwrap().0.header.sequence);
                    }
                }
            }
            let left = window.end();
            prop_assert_eq!(left.in_hand.as_ref().map(|message| message.header.sequence), hand);
            seen.extend(left.in_hand.iter().map(|message| message.header.sequence));
            seen.extend(left.untouched.iter().map(|message| message.header.sequence));
            prop_assert_eq!(seen, (1..=lent).collect::<Vec<_>>());
        }
    }
}
