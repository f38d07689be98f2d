//! Every order of events on a session of few messages: connections that end and live on as ghosts, sides that
//! notice it late, a side that gives the other up. Faults are planted to see that they are found.

use std::collections::{BTreeMap, VecDeque};

use stateright::{Checker, Model, Property};

use super::{Ack, AckEffect, Arrival, Receiving, Sending, Window};

const WINDOW: Window = Window { messages: 2, bytes: 1_000 };

#[derive(Clone, Debug, PartialEq, Eq, Hash)]
enum Frame {
    Ack(Ack),
    Message { number: u16, value: u8 },
}

/// One of the two nodes.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
struct Side {
    sending: Sending<u8>,
    receiving: Receiving,
    link: u64,
    queue: VecDeque<u8>,
    taken: Vec<u8>,
    lost: Vec<u8>,
    memories: u64,
    /// An epoch has begun and is not announced yet: another thread may write first.
    awaits_announcement: bool,
}

#[derive(Clone, Debug, PartialEq, Eq, Hash)]
struct State {
    sides: [Side; 2],
    /// The present connection, and former ones with bytes still in flight; each has its frames per direction.
    wires: BTreeMap<u64, [VecDeque<Frame>; 2]>,
    link: u64,
    cuts_left: u8,
    forgets_left: u8,
    broken: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Action {
    /// The connection ends, and the next one begins.
    Cut,
    /// A side turns to the present connection.
    Attach(usize),
    Write(usize),
    /// A side announces its epoch.
    Announce(usize),
    Read {
        side: usize,
        link: u64,
    },
    /// A side gives the other up, and meets it again on the next connection.
    Forget(usize),
}

/// A planted fault of the session.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Planted {
    Nothing,
    /// A former connection counts as the present one.
    NoFence,
    /// The receiver forgets the accepted messages at the end of a connection.
    ReceiverForgets,
    /// The sender forgets the sent messages at the end of a connection.
    SenderForgets,
    /// All memories have the same identifier.
    NamelessMemory,
    /// The sender ignores the peer's next expected number.
    DeafSender,
    /// A side does not report its kept messages when it gives the other up.
    SilentLoss,
    /// Messages of a new epoch do not wait for its announcement to the peer.
    Hasty,
}

struct Pair {
    planted: Planted,
    /// Values that each side sends.
    values: [u8; 2],
    cuts: u8,
    forgets: u8,
}

impl Side {
    fn new(values: std::ops::Range<u8>) -> Self {
        Self {
            sending: Sending::new(1, WINDOW),
            receiving: Receiving::new(1),
            link: 0,
            queue: values.collect(),
            taken: Vec::new(),
            lost: Vec::new(),
            memories: 1,
            awaits_announcement: false,
        }
    }

    fn ack(&mut self, planted: Planted) -> Frame {
        let mut ack = self.receiving.ack(self.sending.epoch(), None);
        if planted == Planted::NamelessMemory {
            ack.receiver_id = 0;
        }
        self.sending.epoch_announced(ack.epoch);
        self.awaits_announcement = false;
        Frame::Ack(ack)
    }

    fn attach(&mut self, link: u64, planted: Planted) -> Frame {
        self.link = link;
        self.sending.link_ended();
        match planted {
            Planted::ReceiverForgets => self.receiving = Receiving::new(self.memories),
            Planted::SenderForgets => drop(self.sending.drain()),
            Planted::Nothing
            | Planted::NoFence
            | Planted::NamelessMemory
            | Planted::DeafSender
            | Planted::SilentLoss
            | Planted::Hasty => {}
        }
        self.receiving.attach(link);
        self.ack(planted)
    }

    fn forget(&mut self, planted: Planted) {
        self.memories += 1;
        let kept = self.sending.drain();
        if planted != Planted::SilentLoss {
            self.lost.extend(kept);
        }
        // A reset in flight may already have reached the next epoch.
        self.sending = Sending::new(self.memories * 100, WINDOW);
        self.receiving = Receiving::new(self.memories);
        (self.link, self.awaits_announcement) = (0, false);
    }

    fn write(&mut self) -> Option<Frame> {
        if let Some((number, value)) = self.sending.again() {
            return Some(Frame::Message {
                number: number as u16,
                value: *value.expect("nothing is void here"),
            });
        }
        if !self.sending.has_room() {
            return None;
        }
        let value = self.queue.pop_front()?;
        Some(Frame::Message { number: self.sending.keep(value, 1) as u16, value })
    }

    /// Returns its answer; `Err` if the peer is out of step.
    fn read(&mut self, link: u64, frame: Frame, planted: Planted) -> Result<Option<Frame>, ()> {
        let link = if planted == Planted::NoFence { self.link } else { link };
        match frame {
            Frame::Ack(ack) => {
                if !self.receiving.on_epoch(link, ack.epoch) {
                    return Ok(None);
                }
                let ack = if planted == Planted::DeafSender { Ack { next: 1, ..ack } } else { ack };
                match self.sending.on_ack(&ack) {
                    AckEffect::Known | AckEffect::Resumed => Ok(None),
                    AckEffect::Reset(lost) => {
                        self.lost.extend(lost);
                        self.awaits_announcement = true;
                        if planted == Planted::Hasty {
                            self.sending.epoch_announced(self.sending.epoch());
                        }
                        Ok(None)
                    }
                }
            }
            Frame::Message { number, value } => match self.receiving.arrive(link, number, 1) {
                Arrival::Take { .. } => {
                    self.taken.push(value);
                    Ok(Some(self.ack(planted)))
                }
                Arrival::Fenced => Ok(None),
                Arrival::OutOfStep { .. } => Err(()),
            },
        }
    }
}

impl State {
    fn next_link(&mut self) {
        self.link += 1;
        self.wires.insert(self.link, Default::default());
        // One former connection is enough of a ghost.
        while self.wires.len() > 2 {
            self.wires.pop_first();
        }
    }

    fn put(&mut self, side: usize, link: u64, frame: Frame) {
        if let Some(wire) = self.wires.get_mut(&link) {
            wire[side].push_back(frame);
        }
    }

    /// Whether a value from `side` is in a permitted place.
    fn is_known(&self, side: usize, value: u8) -> bool {
        let (sender, receiver) = (&self.sides[side], &self.sides[1 - side]);
        let mut kept = sender.sending.clone();
        sender.queue.contains(&value)
            || kept.drain().contains(&value)
            || sender.lost.contains(&value)
            || receiver.taken.contains(&value)
    }
}

impl Model for Pair {
    type State = State;
    type Action = Action;

    fn init_states(&self) -> Vec<State> {
        let [there, back] = self.values;
        let mut state = State {
            sides: [Side::new(0..there), Side::new(100..100 + back)],
            wires: BTreeMap::new(),
            link: 0,
            cuts_left: self.cuts,
            forgets_left: self.forgets,
            broken: false,
        };
        state.next_link();
        vec![state]
    }

    fn actions(&self, state: &State, actions: &mut Vec<Action>) {
        if state.cuts_left > 0 {
            actions.push(Action::Cut);
        }
        for side in 0..2 {
            if state.sides[side].link < state.link {
                actions.push(Action::Attach(side));
            }
            if state.forgets_left > 0 {
                actions.push(Action::Forget(side));
            }
            actions.push(Action::Write(side));
            if state.sides[side].awaits_announcement {
                actions.push(Action::Announce(side));
            }
            let readable = state
                .wires
                .iter()
                .filter(|(link, wire)| !wire[1 - side].is_empty() && **link <= state.sides[side].link);
            actions.extend(readable.map(|(link, _)| Action::Read { side, link: *link }));
        }
    }

    fn next_state(&self, last: &State, action: Action) -> Option<State> {
        let mut state = last.clone();
        match action {
            Action::Cut => {
                state.cuts_left -= 1;
                state.next_link();
            }
            Action::Attach(side) => {
                let link = state.link;
                let ack = state.sides[side].attach(link, self.planted);
                state.put(side, link, ack);
            }
            Action::Write(side) => {
                let frame = state.sides[side].write()?;
                let link = state.sides[side].link;
                state.put(side, link, frame);
            }
            Action::Announce(side) => {
                let ack = state.sides[side].ack(self.planted);
                let link = state.sides[side].link;
                state.put(side, link, ack);
            }
            Action::Read { side, link } => {
                let frame = state.wires.get_mut(&link)?[1 - side].pop_front()?;
                let present = state.sides[side].link;
                match state.sides[side].read(link, frame, self.planted) {
                    Ok(Some(answer)) => state.put(side, present, answer),
                    Ok(None) => {}
                    Err(()) => state.broken = true,
                }
            }
            Action::Forget(side) => {
                state.forgets_left -= 1;
                state.sides[side].forget(self.planted);
                state.next_link();
            }
        }
        Some(state)
    }

    fn properties(&self) -> Vec<Property<Self>> {
        vec![
            Property::always("once and in order", |_, state: &State| {
                state.sides.iter().all(|side| side.taken.is_sorted_by(|a, b| a < b))
            }),
            Property::always("nothing is lost in silence", |model: &Self, state: &State| {
                let [there, back] = model.values;
                (0..there).all(|value| state.is_known(0, value))
                    && (100..100 + back).all(|value| state.is_known(1, value))
            }),
            Property::always("nobody is out of step", |_, state: &State| !state.broken),
            Property::always("who is not given up loses nothing", |model: &Self, state: &State| {
                model.forgets > 0 || state.sides.iter().all(|side| side.lost.is_empty())
            }),
            Property::sometimes("all arrives after all faults", |model: &Self, state: &State| {
                let arrived =
                    |side: usize| state.sides[1 - side].taken.len() == usize::from(model.values[side]);
                state.cuts_left == 0 && state.forgets_left == 0 && arrived(0) && arrived(1)
            }),
        ]
    }
}

fn check(pair: Pair) -> impl Checker<Pair> {
    pair.checker().threads(2).spawn_bfs().join()
}

#[test]
fn all_orders_of_two_cuts_keep_the_properties() {
    let checker = check(Pair { planted: Planted::Nothing, values: [3, 1], cuts: 2, forgets: 0 });
    println!("{} states", checker.unique_state_count());
    checker.assert_properties();
}

#[test]
fn all_orders_of_cut_and_forget_keep_the_properties() {
    let checker = check(Pair { planted: Planted::Nothing, values: [2, 1], cuts: 1, forgets: 1 });
    println!("{} states", checker.unique_state_count());
    checker.assert_properties();
}

#[test]
fn each_planted_fault_is_found() {
    for planted in [
        Planted::NoFence,
        Planted::ReceiverForgets,
        Planted::SenderForgets,
        Planted::NamelessMemory,
        Planted::DeafSender,
        Planted::SilentLoss,
        Planted::Hasty,
    ] {
        let checker = check(Pair { planted, values: [2, 0], cuts: 1, forgets: 1 });
        let broken =
            checker.discoveries().into_keys().filter(|name| !name.starts_with("all arrives")).count();
        assert!(broken > 0, "{planted:?} breaks no promise");
    }
}
