//! Every order of events between a sender and a receiver with a slow application and a quick one: Acks that
//! overtake each other, a connection that ends, and an application that receives at any time or never. The
//! model also plants faults and checks that each is found.

use std::collections::{BTreeMap, VecDeque};

use stateright::{Checker, Model, Property};

use super::{
    Ack, AckEffect, Arrival, BacklogLimits, Expires, HeldChange, ReceiveBacklog, Receiving, SendBacklog,
    Sending, Window,
};

const WINDOW: Window = Window { messages: 2, bytes: 1_000 };
const LIMITS: BacklogLimits =
    BacklogLimits { queues: 2, queue_messages: 9, queue_bytes: 1_000, messages: 9, bytes: 1_000 };
/// So few that the window exceeds them: only the receiver's stated room keeps the sender from refusals. One
/// limit is in messages, the other in bytes; each message has one byte.
const FEW_MESSAGES: BacklogLimits = BacklogLimits { messages: 2, ..LIMITS };
const FEW_BYTES: BacklogLimits = BacklogLimits { bytes: 2, ..LIMITS };
/// The application that receives at any time, one message at a time.
const SLOW: u64 = 1;
/// The application that receives at once.
const QUICK: u64 = 2;

/// A message: its destination, and its number there.
type Value = (u64, u8);

/// None loses its use.
impl Expires for Value {}

#[derive(Clone, Debug, PartialEq, Eq, Hash)]
struct Sender {
    sending: Sending<Value>,
    held: SendBacklog<u64, Value>,
    link: u64,
    queue: VecDeque<Value>,
}

#[derive(Clone, Debug, PartialEq, Eq, Hash)]
struct Receiver {
    receiving: Receiving,
    backlog: ReceiveBacklog<u64, Value>,
    link: u64,
    /// The message in the slow application's mailbox, which has room for one.
    mailbox: Option<u8>,
    /// The messages of each application, in this order.
    delivered: BTreeMap<u64, Vec<u8>>,
    refused: Vec<Value>,
}

/// One connection: messages in one direction, Acks in the other.
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
    /// The sender reads the first Ack of the wire, or the second: two threads of the receiver may send one
    /// each.
    ReadAck(usize),
    /// Waiting messages of a queue are offered again.
    Offer,
    /// The slow application takes a message.
    Take,
}

/// A planted fault.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Planted {
    Nothing,
    /// Acks do not name held destinations.
    HeldNotAnnounced,
    /// The release of a destination is not announced.
    NoRelease,
    /// Of two Acks the later arrival counts.
    LastArrivalCounts,
    /// A message for a held destination goes to its mailbox if that has room.
    Overtaking,
    /// While one destination is held, nothing is sent to any.
    AllWait,
    /// Queued messages for a newly held destination stay in the queue.
    NotMoved,
    /// The room in messages is not announced.
    MessagesNotAnnounced,
    /// The room in bytes is not announced.
    BytesNotAnnounced,
}

struct Pair {
    planted: Planted,
    limits: BacklogLimits,
    slow: u8,
    quick: u8,
    cuts: u8,
}

impl Pair {
    fn make_ack(&self, receiver: &mut Receiver) -> Ack {
        let ack = receiver.receiving.ack(1, Some(self.room(receiver)));
        let (held, change) = (receiver.backlog.held(), receiver.backlog.change());
        if self.planted == Planted::HeldNotAnnounced { ack } else { Ack { change, held, ..ack } }
    }

    fn room(&self, receiver: &Receiver) -> Window {
        let room = receiver.backlog.room(WINDOW, 1);
        match self.planted {
            Planted::MessagesNotAnnounced => Window { messages: WINDOW.messages, ..room },
            Planted::BytesNotAnnounced => Window { bytes: WINDOW.bytes, ..room },
            Planted::Nothing
            | Planted::HeldNotAnnounced
            | Planted::NoRelease
            | Planted::LastArrivalCounts
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

    fn on_ack(&self, sender: &mut Sender, ack: &Ack) {
        let effect = sender.sending.on_ack(ack);
        assert!(!matches!(effect, AckEffect::Reset(_)), "no state is lost here");
        if self.planted == Planted::LastArrivalCounts {
            sender.held.link_ended();
        }
        let HeldChange { holds_more, released } = sender.held.on_held(ack.change, ack.held.iter().copied());
        for value in released.into_iter().rev() {
            sender.queue.push_front(value);
        }
        if holds_more && self.planted != Planted::NotMoved {
            for value in std::mem::take(&mut sender.queue) {
                if sender.held.holds(value.0) {
                    sender.held.put_unbounded(value.0, value, 1);
                } else {
                    sender.queue.push_back(value);
                }
            }
        }
    }

    /// Delivers a message; returns whether an Ack is due at once.
    fn deliver_or_hold(&self, receiver: &mut Receiver, value: Value) -> bool {
        let (key, number) = value;
        let waits = receiver.backlog.holds(key) && self.planted != Planted::Overtaking;
        if key == QUICK || !waits && receiver.mailbox.is_none() {
            receiver.deliver(key, number);
            return false;
        }
        let change = receiver.backlog.change();
        receiver.refused.extend(receiver.backlog.put(key, value, 1).err());
        receiver.backlog.change() != change
    }

    /// Offers the waiting message; returns whether an Ack is due.
    fn offer(&self, receiver: &mut Receiver) -> Option<bool> {
        let ((key, number), bytes) = receiver.backlog.offer(SLOW)?;
        if receiver.mailbox.is_some() {
            receiver.backlog.put_back(SLOW, (key, number), bytes);
            return None;
        }
        receiver.deliver(key, number);
        Some(receiver.backlog.taken(SLOW) && self.planted != Planted::NoRelease)
    }
}

impl Receiver {
    fn deliver(&mut self, key: u64, number: u8) {
        self.delivered.entry(key).or_default().push(number);
        if key == SLOW {
            self.mailbox = Some(number);
        }
    }

    fn delivered_to(&self, key: u64) -> usize {
        self.delivered.get(&key).map_or(0, Vec::len)
    }
}

impl State {
    fn reply(&mut self, ack: Ack) {
        if let Some(wire) = self.wires.get_mut(&self.receiver.link) {
            wire.back.push_back(ack);
        }
    }

    /// Whether only a cut, or a read of the slow application, is possible.
    fn is_at_rest(&self, pair: &Pair) -> bool {
        let can = |action| pair.next_state(self, action).is_some();
        let all = [
            Action::AttachSender,
            Action::AttachReceiver,
            Action::Write,
            Action::Read,
            Action::ReadAck(0),
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
                held: SendBacklog::new(LIMITS),
                link: 0,
                queue: slow.chain(quick).collect(),
            },
            receiver: Receiver {
                receiving: Receiving::new(1),
                backlog: ReceiveBacklog::new(self.limits),
                link: 0,
                mailbox: None,
                delivered: BTreeMap::new(),
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
            Action::ReadAck(0),
            Action::ReadAck(1),
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
                // Data on the former connection is lost with it: the session's own model has ghosts.
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
                // The first Ack of the sender states the epoch of its numbers.
                state.receiver.receiving.on_epoch(state.link, 1);
                let ack = self.make_ack(&mut state.receiver);
                state.reply(ack);
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
                let ack = self.make_ack(&mut state.receiver);
                state.reply(ack);
                if self.deliver_or_hold(&mut state.receiver, value) {
                    let ack = self.make_ack(&mut state.receiver);
                    state.reply(ack);
                }
            }
            Action::ReadAck(nth) => {
                let ack = state.wires.get_mut(&state.sender.link)?.back.remove(nth)?;
                self.on_ack(&mut state.sender, &ack);
            }
            Action::Offer => {
                if self.offer(&mut state.receiver)? {
                    let ack = self.make_ack(&mut state.receiver);
                    state.reply(ack);
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
                state.receiver.delivered.values().all(|numbers| numbers.is_sorted_by(|a, b| a < b))
            }),
            Property::always("a queue is never longer than a window and one", |_, state: &State| {
                state.receiver.backlog.messages() <= WINDOW.messages + 1
            }),
            Property::always("nothing is refused", |_, state: &State| state.receiver.refused.is_empty()),
            Property::always("others pass", |pair: &Self, state: &State| {
                state.receiver.delivered_to(QUICK) == usize::from(pair.quick) || !state.is_at_rest(pair)
            }),
            Property::always("no sender waits forever", |pair: &Self, state: &State| {
                let takes = state.receiver.mailbox.is_some();
                let is_done = state.receiver.delivered_to(SLOW) == usize::from(pair.slow);
                takes || is_done || !state.is_at_rest(pair)
            }),
            Property::sometimes("a destination is held", |_, state: &State| state.sender.held.holds(SLOW)),
            Property::sometimes("all arrives after all faults", |pair: &Self, state: &State| {
                let all = usize::from(pair.slow) + usize::from(pair.quick);
                let delivered: usize = state.receiver.delivered.values().map(Vec::len).sum();
                state.cuts_left == 0 && delivered == all
            }),
        ]
    }
}

fn check(pair: Pair) -> impl Checker<Pair> {
    pair.checker().threads(2).spawn_bfs().join()
}

#[test]
fn all_orders_with_slow_application_keep_the_properties() {
    for limits in [LIMITS, FEW_MESSAGES, FEW_BYTES] {
        let checker = check(Pair { planted: Planted::Nothing, limits, slow: 5, quick: 1, cuts: 1 });
        println!("{limits:?}: {} states", checker.unique_state_count());
        checker.assert_properties();
    }
}

#[test]
fn each_planted_credit_fault_is_found() {
    for (planted, limits) in [
        (Planted::HeldNotAnnounced, LIMITS),
        (Planted::NoRelease, LIMITS),
        (Planted::LastArrivalCounts, LIMITS),
        (Planted::Overtaking, LIMITS),
        (Planted::AllWait, LIMITS),
        (Planted::NotMoved, LIMITS),
        (Planted::MessagesNotAnnounced, FEW_MESSAGES),
        (Planted::BytesNotAnnounced, FEW_BYTES),
    ] {
        let checker = check(Pair { planted, limits, slow: 5, quick: 1, cuts: 0 });
        let is_safety =
            |name: &&str| !matches!(*name, "a destination is held" | "all arrives after all faults");
        let broken: Vec<_> = checker.discoveries().into_keys().filter(is_safety).collect();
        println!("{planted:?} breaks: {broken:?}");
        assert!(!broken.is_empty(), "{planted:?} breaks no property");
    }
}
