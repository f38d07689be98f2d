//! A sender that respects the stated room, and many destinations that accept nothing. None of its messages is
//! refused while there is room, messages to other destinations always pass, and all messages that are not
//! refused arrive in the end. spec: CREDIT-5

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use proptest::prelude::*;

use super::{Ack, Arrival, BacklogLimits, Expires, ReceiveBacklog, Receiving, SendBacklog, Sending, Window};

const WINDOW: Window = Window { messages: 8, bytes: 200 };
const LONGEST: usize = 60;
const DESTINATIONS: usize = 12;
/// As GNCL sets them: four windows, and a place for each line.
const LIMITS: BacklogLimits = BacklogLimits {
    queues: DESTINATIONS,
    queue_messages: WINDOW.messages + 1,
    queue_bytes: WINDOW.bytes + LONGEST,
    messages: 4 * (WINDOW.messages + 1) + DESTINATIONS,
    bytes: 4 * (WINDOW.bytes + LONGEST),
};

/// Destination, number at this destination, and bytes.
type Value = (u64, u32, usize);

/// None loses its use.
impl Expires for Value {}

struct World {
    sending: Sending<Value>,
    held: SendBacklog<u64, Value>,
    queue: VecDeque<Value>,
    there: VecDeque<(u16, Value)>,
    back: VecDeque<Ack>,
    receiving: Receiving,
    backlog: ReceiveBacklog<u64, Value>,
    link: u64,
    /// Destinations that accept nothing.
    full: BTreeSet<u64>,
    sent: BTreeMap<u64, u32>,
    arrived: BTreeMap<u64, Vec<u32>>,
    /// Refused messages.
    refused: BTreeSet<(u64, u32)>,
}

impl World {
    fn new() -> Self {
        let lines = BacklogLimits {
            queue_messages: 1_000,
            queue_bytes: 100_000,
            messages: 1_000,
            bytes: 100_000,
            ..LIMITS
        };
        let mut world = Self {
            // It would keep more than the receiver has room for.
            sending: Sending::new(1, Window { messages: 20, bytes: 500 }),
            held: SendBacklog::new(lines),
            queue: VecDeque::new(),
            there: VecDeque::new(),
            back: VecDeque::new(),
            receiving: Receiving::new(1),
            backlog: ReceiveBacklog::new(LIMITS),
            link: 0,
            full: BTreeSet::new(),
            sent: BTreeMap::new(),
            arrived: BTreeMap::new(),
            refused: BTreeSet::new(),
        };
        world.connect();
        world
    }

    /// The next connection: frames in flight are lost.
    fn connect(&mut self) {
        self.there.clear();
        self.back.clear();
        self.sending.link_ended();
        self.held.link_ended();
        self.link += 1;
        self.receiving.attach(self.link);
        self.receiving.on_epoch(self.link, 1);
        self.send_ack();
    }

    fn send_ack(&mut self) {
        let room = self.backlog.room(WINDOW, LONGEST);
        let (held, change) = (self.backlog.held(), self.backlog.change());
        self.back.push_back(Ack { change, held, ..self.receiving.ack(1, Some(room)) });
    }

    fn send(&mut self, key: u64, bytes: usize) {
        let number = self.sent.entry(key).or_default();
        *number += 1;
        self.queue.push_back((key, *number, bytes));
    }

    /// Writes one message, if possible.
    fn write(&mut self) -> bool {
        if let Some((number, value)) = self.sending.again() {
            let value = *value.expect("nothing is void here");
            self.there.push_back((number as u16, value));
            return true;
        }
        while self.sending.has_room()
            && let Some(value) = self.queue.pop_front()
        {
            if self.held.holds(value.0) {
                self.held.put_unbounded(value.0, value, value.2);
                continue;
            }
            let number = self.sending.keep(value, value.2);
            self.there.push_back((number as u16, value));
            return true;
        }
        false
    }

    fn read(&mut self) -> bool {
        let Some((number, value)) = self.there.pop_front() else { return false };
        let arrival = self.receiving.arrive(self.link, number, value.2);
        let Arrival::Take { ack_is_due } = arrival else { panic!("{arrival:?}") };
        if ack_is_due {
            // Before it is known that its destination is full: the worst order.
            self.send_ack();
        }
        if !self.full.contains(&value.0) && !self.backlog.holds(value.0) {
            self.arrived.entry(value.0).or_default().push(value.1);
            return true;
        }
        let change = self.backlog.change();
        let has_bytes = self.backlog.bytes() < LIMITS.bytes;
        if self.backlog.put(value.0, value, value.2).is_err() {
            assert!(!has_bytes, "a message of an honest sender is refused");
            self.refused.insert((value.0, value.1));
            self.send_ack();
        }
        if self.backlog.change() != change {
            self.send_ack();
        }
        true
    }

    fn read_ack(&mut self) -> bool {
        let Some(ack) = self.back.pop_front() else { return false };
        self.sending.on_ack(&ack);
        let turn = self.held.on_held(ack.change, ack.held);
        turn.released.into_iter().rev().for_each(|value| self.queue.push_front(value));
        true
    }

    /// A destination accepts all waiting messages, and further ones from now on.
    fn take(&mut self, key: u64) {
        self.full.remove(&key);
        while let Some((value, _)) = self.backlog.offer(key) {
            self.arrived.entry(key).or_default().push(value.1);
            if self.backlog.taken(key) {
                self.send_ack();
            }
        }
        if self.receiving.must_announce_room(self.backlog.room(WINDOW, LONGEST)) {
            self.send_ack();
        }
    }

    /// Runs until nothing can happen any more. Each round sends all messages that may be sent, then reads
    /// them, then reads the Acks.
    fn run(&mut self) {
        let mut happens = true;
        while happens {
            happens = false;
            while self.write() || self.read() {
                happens = true;
            }
            while self.read_ack() {
                happens = true;
            }
        }
    }

    fn arrived(&self, key: u64) -> usize {
        self.arrived.get(&key).map_or(0, Vec::len)
    }
}

#[derive(Clone, Debug)]
enum Step {
    Send(u64, usize),
    Fill(u64),
    /// A burst of messages of this size to a destination that is full from then on, until one is refused.
    Burst(u64, usize, usize),
    Take(u64),
    Write,
    Read,
    ReadAck,
    Connect,
}

fn any_step() -> impl Strategy<Value = Step> {
    let key = 0..DESTINATIONS as u64;
    prop_oneof![
        12 => (key.clone(), 1..=LONGEST).prop_map(|(key, bytes)| Step::Send(key, bytes)),
        1 => key.clone().prop_map(Step::Fill),
        3 => (key.clone(), 1..30_usize, 1..=LONGEST).prop_map(|(key, count, bytes)| Step::Burst(key, count, bytes)),
        1 => key.prop_map(Step::Take),
        12 => Just(Step::Write),
        10 => Just(Step::Read),
        6 => Just(Step::ReadAck),
        1 => Just(Step::Connect),
    ]
}

proptest! {
    #[test]
    fn sender_within_credit_is_never_refused(steps in proptest::collection::vec(any_step(), 1..600)) {
        let mut world = World::new();
        for step in steps {
            match step {
                Step::Send(key, bytes) => world.send(key, bytes),
                Step::Fill(key) => drop(world.full.insert(key)),
                Step::Burst(key, count, bytes) => {
                    world.full.insert(key);
                    (0..count).for_each(|_| world.send(key, bytes));
                    world.run();
                }
                Step::Take(key) => world.take(key),
                Step::Write => drop(world.write()),
                Step::Read => drop(world.read()),
                Step::ReadAck => drop(world.read_ack()),
                Step::Connect => world.connect(),
            }
        }
        world.run();
        for key in 0..DESTINATIONS as u64 {
            world.take(key);
            world.run();
        }
        for (key, sent) in &world.sent {
            let arrived = world.arrived.get(key).cloned().unwrap_or_default();
            let taken = (1..=*sent).filter(|number| !world.refused.contains(&(*key, *number)));
            prop_assert_eq!(arrived, taken.collect::<Vec<_>>(), "for {}", key);
        }
    }
}

#[test]
fn full_destinations_do_not_block_others() {
    // Short ones use the messages up, long ones the bytes.
    for bytes in [1, LONGEST] {
        let mut world = World::new();
        // Each of them has had more than a window before it was known that it is full.
        for full in 1..DESTINATIONS as u64 {
            world.full.insert(full);
            (0..20).for_each(|_| world.send(full, bytes));
            world.run();
        }
        for number in 1..=100 {
            world.send(0, bytes);
            world.run();
            assert_eq!(world.arrived(0), number, "of {bytes} bytes");
        }
    }
}
