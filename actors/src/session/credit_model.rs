//! Every order of events between a sender and a receiver one of whose two applications is slow: words that overtake each other, a
//! connection that ends, an application that takes when it likes or never. Faults are planted to see that they are found.

use std::collections::{BTreeMap, VecDeque};

use stateright::{Checker, Model, Property};

use super::{Ack, Arrival, Heard, Held, Receiving, Sending, Shelf, ShelfLimits, Turn, Waits, Window};

const WINDOW: Window = Window { messages: 2, bytes: 1_000 };
const LIMITS: ShelfLimits =
    ShelfLimits { lines: 2, line_messages: 9, line_bytes: 1_000, messages: 9, bytes: 1_000 };
/// So few that a window finds no room: what the receiver says of it is all that keeps the sender from being refused. In messages, and in bytes,
/// of which each message has one.
const FEW_MESSAGES: ShelfLimits = ShelfLimits { messages: 2, ..LIMITS };
const FEW_BYTES: ShelfLimits = ShelfLimits { bytes: 2, ..LIMITS };
/// The application that takes when it likes, one message at a time.
const SLOW: u64 = 1;
/// The one that takes at once.
const QUICK: u64 = 2;

/// A message: its destination, and its number there.
type Value = (u64, u8);

/// None loses its use.
impl Waits for Value {}

#[derive(Clone, Debug, PartialEq, Eq, Hash)]
struct Sender {
    sending: Sending<Value>,
    held: Held<u64, Value>,
    link: u64,
    queue: VecDeque<Value>,
}

#[derive(Clone, Debug, PartialEq, Eq, Hash)]
struct Receiver {
    receiving: Receiving,
    shelf: Shelf<u64, Value>,
    link: u64,
    /// What waits in the slow application's mailbox, which has room for one.
    mailbox: Option<u8>,
    /// What the applications were handed, in this order.
    handed: BTreeMap<u64, Vec<u8>>,
    refused: Vec<Value>,
}

/// One connection: messages there, words back.
#[derive(Clone, Debug, Default, PartialEq, Eq, Hash)]
struct Wire {
    there: VecDeque<(u16, Value)>,
    back: VecDeque<Ack>,
}

#[derive(Clone, Debug, PartialEq, Eq, Hash)]
struct State {
    sender: Sender,
    receiver: Receiver,
    wires: BTreeMap<u64, Wire>,
    link: u64,
    cuts_left: u8,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Action {
    Cut,
    AttachSender,
    AttachReceiver,
    Write,
    Read,
    /// The sender reads the first word that lies there, or the second: two threads of the receiver may say one each.
    Hear(usize),
    /// What waits in lines is offered again.
    Offer,
    /// The slow application takes a message.
    Take,
}

/// What is wrong.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Planted {
    Nothing,
    /// The words do not say who is held.
    Unsaid,
    /// It is not said when somebody is held no more.
    NoRelease,
    /// Of two words the one that comes last counts.
    LastWordCounts,
    /// What comes for one that is held goes to its mailbox if that has room.
    Overtaking,
    /// While one is held, nobody is sent to.
    AllWait,
    /// What waits for one when it becomes held stays where it is.
    NotMoved,
    /// It is not said how many messages may come.
    MessagesUnsaid,
    /// Nor how many bytes of them.
    BytesUnsaid,
}

struct Pair {
    planted: Planted,
    limits: ShelfLimits,
    slow: u8,
    quick: u8,
    cuts: u8,
}

impl Pair {
    fn say(&self, receiver: &mut Receiver) -> Ack {
        let ack = receiver.receiving.ack(1, Some(self.room(receiver)));
        let (held, change) = (receiver.shelf.held(), receiver.shelf.change());
        if self.planted == Planted::Unsaid { ack } else { Ack { change, held, ..ack } }
    }

    fn room(&self, receiver: &Receiver) -> Window {
        let room = receiver.shelf.room(WINDOW, 1);
        match self.planted {
            Planted::MessagesUnsaid => Window { messages: WINDOW.messages, ..room },
            Planted::BytesUnsaid => Window { bytes: WINDOW.bytes, ..room },
            Planted::Nothing
            | Planted::Unsaid
            | Planted::NoRelease
            | Planted::LastWordCounts
            | Planted::Overtaking
            | Planted::AllWait
            | Planted::NotMoved => room,
        }
    }

    fn write(&self, sender: &mut Sender) -> Option<(u16, Value)> {
        if let Some((number, value)) = sender.sending.again() {
            return Some((number as u16, *value.expect("nothing is void here")));
        }
        let all_wait = self.planted == Planted::AllWait && sender.held.holds(SLOW);
        if !sender.sending.has_room() || all_wait {
            return None;
        }
        let value = sender.queue.pop_front()?;
        Some((sender.sending.keep(value, 1) as u16, value))
    }

    fn hear(&self, sender: &mut Sender, ack: &Ack) {
        let heard = sender.sending.heard(ack);
        assert!(!matches!(heard, Heard::Reset(_)), "nobody forgets here");
        if self.planted == Planted::LastWordCounts {
            sender.held.link_ended();
        }
        let Turn { holds_more, released } = sender.held.heard(ack.change, ack.held.iter().copied());
        for value in released.into_iter().rev() {
            sender.queue.push_front(value);
        }
        if holds_more && self.planted != Planted::NotMoved {
            for value in std::mem::take(&mut sender.queue) {
                if sender.held.holds(value.0) {
                    sender.held.put_beyond(value.0, value, 1);
                } else {
                    sender.queue.push_back(value);
                }
            }
        }
    }

    /// A message has come; returns whether a word is due at once.
    fn hand_on(&self, receiver: &mut Receiver, value: Value) -> bool {
        let (key, number) = value;
        let waits = receiver.shelf.holds(key) && self.planted != Planted::Overtaking;
        if key == QUICK || !waits && receiver.mailbox.is_none() {
            receiver.hand(key, number);
            return false;
        }
        let change = receiver.shelf.change();
        receiver.refused.extend(receiver.shelf.put(key, value, 1).err());
        receiver.shelf.change() != change
    }

    /// Offers what waits; returns whether a word is due.
    fn offer(&self, receiver: &mut Receiver) -> Option<bool> {
        let ((key, number), bytes) = receiver.shelf.offer(SLOW)?;
        if receiver.mailbox.is_some() {
            receiver.shelf.put_back(SLOW, (key, number), bytes);
            return None;
        }
        receiver.hand(key, number);
        Some(receiver.shelf.taken(SLOW) && self.planted != Planted::NoRelease)
    }
}

impl Receiver {
    fn hand(&mut self, key: u64, number: u8) {
        self.handed.entry(key).or_default().push(number);
        if key == SLOW {
            self.mailbox = Some(number);
        }
    }

    fn was_handed(&self, key: u64) -> usize {
        self.handed.get(&key).map_or(0, Vec::len)
    }
}

impl State {
    fn reply(&mut self, word: Ack) {
        if let Some(wire) = self.wires.get_mut(&self.receiver.link) {
            wire.back.push_back(word);
        }
    }

    /// Whether nothing can happen any more but a cut, and that the slow application takes.
    fn is_at_rest(&self, pair: &Pair) -> bool {
        let can = |action| pair.next_state(self, action).is_some();
        let all = [
            Action::AttachSender,
            Action::AttachReceiver,
            Action::Write,
            Action::Read,
            Action::Hear(0),
            Action::Offer,
        ];
        !all.into_iter().any(can)
    }
}

impl Model for Pair {
    type State = State;
    type Action = Action;

    fn init_states(&self) -> Vec<State> {
        let slow = (0..self.slow).map(|number| (SLOW, number));
        let quick = (0..self.quick).map(|number| (QUICK, number));
        vec![State {
            sender: Sender {
                sending: Sending::new(1, WINDOW),
                held: Held::new(LIMITS),
                link: 0,
                queue: slow.chain(quick).collect(),
            },
            receiver: Receiver {
                receiving: Receiving::new(1),
                shelf: Shelf::new(self.limits),
                link: 0,
                mailbox: None,
                handed: BTreeMap::new(),
                refused: Vec::new(),
            },
            wires: BTreeMap::from([(1, Wire::default())]),
            link: 1,
            cuts_left: self.cuts,
        }]
    }

    fn actions(&self, _: &State, actions: &mut Vec<Action>) {
        actions.extend([
            Action::Cut,
            Action::AttachSender,
            Action::AttachReceiver,
            Action::Write,
            Action::Read,
            Action::Hear(0),
            Action::Hear(1),
            Action::Offer,
            Action::Take,
        ]);
    }

    fn next_state(&self, last: &State, action: Action) -> Option<State> {
        let mut state = last.clone();
        match action {
            Action::Cut => {
                state.cuts_left = state.cuts_left.checked_sub(1)?;
                state.link += 1;
                // What was on the former one is gone with it: the session's own model has ghosts.
                state.wires = BTreeMap::from([(state.link, Wire::default())]);
            }
            Action::AttachSender => {
                (state.sender.link < state.link).then_some(())?;
                state.sender.link = state.link;
                state.sender.sending.link_ended();
                state.sender.held.link_ended();
            }
            Action::AttachReceiver => {
                (state.receiver.link < state.link).then_some(())?;
                state.receiver.link = state.link;
                state.receiver.receiving.attach(state.link);
                // The sender's own first word says which epoch it counts in.
                state.receiver.receiving.heard(state.link, 1);
                let word = self.say(&mut state.receiver);
                state.reply(word);
            }
            Action::Write => {
                state.wires.get(&state.sender.link)?;
                let frame = self.write(&mut state.sender)?;
                state.wires.get_mut(&state.sender.link)?.there.push_back(frame);
            }
            Action::Read => {
                let link = state.receiver.link;
                let (number, value) = state.wires.get_mut(&link)?.there.pop_front()?;
                let arrival = state.receiver.receiving.arrive(link, number, 1);
                assert!(matches!(arrival, Arrival::Take { .. }), "the session's own model knows others");
                // It is acknowledged before it is known that its mailbox is full: the worst order.
                let word = self.say(&mut state.receiver);
                state.reply(word);
                if self.hand_on(&mut state.receiver, value) {
                    let word = self.say(&mut state.receiver);
                    state.reply(word);
                }
            }
            Action::Hear(nth) => {
                let word = state.wires.get_mut(&state.sender.link)?.back.remove(nth)?;
                self.hear(&mut state.sender, &word);
            }
            Action::Offer => {
                if self.offer(&mut state.receiver)? {
                    let word = self.say(&mut state.receiver);
                    state.reply(word);
                }
            }
            Action::Take => {
                state.receiver.mailbox.take()?;
            }
        }
        Some(state)
    }

    fn properties(&self) -> Vec<Property<Self>> {
        vec![
            Property::always("once and in order", |_, state: &State| {
                state.receiver.handed.values().all(|numbers| numbers.is_sorted_by(|a, b| a < b))
            }),
            Property::always("a line is never longer than a window and one", |_, state: &State| {
                state.receiver.shelf.messages() <= WINDOW.messages + 1
            }),
            Property::always("nothing is refused", |_, state: &State| state.receiver.refused.is_empty()),
            Property::always("others pass", |pair: &Self, state: &State| {
                state.receiver.was_handed(QUICK) == usize::from(pair.quick) || !state.is_at_rest(pair)
            }),
            Property::always("nobody waits for ever", |pair: &Self, state: &State| {
                let takes = state.receiver.mailbox.is_some();
                let is_done = state.receiver.was_handed(SLOW) == usize::from(pair.slow);
                takes || is_done || !state.is_at_rest(pair)
            }),
            Property::sometimes("somebody is held", |_, state: &State| state.sender.held.holds(SLOW)),
            Property::sometimes("all arrives after all faults", |pair: &Self, state: &State| {
                let all = usize::from(pair.slow) + usize::from(pair.quick);
                let handed: usize = state.receiver.handed.values().map(Vec::len).sum();
                state.cuts_left == 0 && handed == all
            }),
        ]
    }
}

fn check(pair: Pair) -> impl Checker<Pair> {
    pair.checker().threads(2).spawn_bfs().join()
}

#[test]
fn every_order_of_a_slow_application_and_a_cut_keeps_every_promise() {
    for limits in [LIMITS, FEW_MESSAGES, FEW_BYTES] {
        let checker = check(Pair { planted: Planted::Nothing, limits, slow: 5, quick: 1, cuts: 1 });
        println!("{limits:?}: {} states", checker.unique_state_count());
        checker.assert_properties();
    }
}

#[test]
fn each_planted_fault_of_the_credit_is_found() {
    for (planted, limits) in [
        (Planted::Unsaid, LIMITS),
        (Planted::NoRelease, LIMITS),
        (Planted::LastWordCounts, LIMITS),
        (Planted::Overtaking, LIMITS),
        (Planted::AllWait, LIMITS),
        (Planted::NotMoved, LIMITS),
        (Planted::MessagesUnsaid, FEW_MESSAGES),
        (Planted::BytesUnsaid, FEW_BYTES),
    ] {
        let checker = check(Pair { planted, limits, slow: 5, quick: 1, cuts: 0 });
        let is_promise = |name: &&str| !matches!(*name, "somebody is held" | "all arrives after all faults");
        let broken: Vec<_> = checker.discoveries().into_keys().filter(is_promise).collect();
        println!("{planted:?} breaks: {broken:?}");
        assert!(!broken.is_empty(), "{planted:?} breaks no promise");
    }
}
