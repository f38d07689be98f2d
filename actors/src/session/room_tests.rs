//! A sender that heeds what it is told, and many destinations that take nothing: none of its messages is refused while there is room,
//! others pass in any case, and all that is not refused arrives in the end. spec: CREDIT-5

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use proptest::prelude::*;

use super::{Ack, Arrival, Held, Receiving, Sending, Shelf, ShelfLimits, Waits, Window};

const WINDOW: Window = Window { messages: 8, bytes: 200 };
const LONGEST: usize = 60;
const LINES: usize = 12;
/// As GNCL sets them: four windows, and a place for each line.
const LIMITS: ShelfLimits = ShelfLimits {
    lines: LINES,
    line_messages: WINDOW.messages + 1,
    line_bytes: WINDOW.bytes + LONGEST,
    messages: 4 * (WINDOW.messages + 1) + LINES,
    bytes: 4 * (WINDOW.bytes + LONGEST),
};

/// For whom, which one of its, how many bytes.
type Value = (u64, u32, usize);

/// None loses its use.
impl Waits for Value {}

struct World {
    sending: Sending<Value>,
    held: Held<u64, Value>,
    queue: VecDeque<Value>,
    there: VecDeque<(u16, Value)>,
    back: VecDeque<Ack>,
    receiving: Receiving,
    shelf: Shelf<u64, Value>,
    link: u64,
    /// Who takes nothing.
    full: BTreeSet<u64>,
    sent: BTreeMap<u64, u32>,
    came: BTreeMap<u64, Vec<u32>>,
    /// What there was no room for.
    refused: BTreeSet<(u64, u32)>,
}

impl World {
    fn new() -> Self {
        let lines = ShelfLimits {
            line_messages: 1_000,
            line_bytes: 100_000,
            messages: 1_000,
            bytes: 100_000,
            ..LIMITS
        };
        let mut world = Self {
            // It would keep more than the receiver has room for.
            sending: Sending::new(1, Window { messages: 20, bytes: 500 }),
            held: Held::new(lines),
            queue: VecDeque::new(),
            there: VecDeque::new(),
            back: VecDeque::new(),
            receiving: Receiving::new(1),
            shelf: Shelf::new(LIMITS),
            link: 0,
            full: BTreeSet::new(),
            sent: BTreeMap::new(),
            came: BTreeMap::new(),
            refused: BTreeSet::new(),
        };
        world.connect();
        world
    }

    /// The next connection: what was on the way is gone.
    fn connect(&mut self) {
        self.there.clear();
        self.back.clear();
        self.sending.link_ended();
        self.held.link_ended();
        self.link += 1;
        self.receiving.attach(self.link);
        self.receiving.heard(self.link, 1);
        self.say();
    }

    fn say(&mut self) {
        let room = self.shelf.room(WINDOW, LONGEST);
        let (held, change) = (self.shelf.held(), self.shelf.change());
        self.back.push_back(Ack { change, held, ..self.receiving.ack(1, Some(room)) });
    }

    fn send(&mut self, key: u64, bytes: usize) {
        let number = self.sent.entry(key).or_default();
        *number += 1;
        self.queue.push_back((key, *number, bytes));
    }

    /// Writes one message, if it may.
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
                self.held.put_beyond(value.0, value, value.2);
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
            self.say();
        }
        if !self.full.contains(&value.0) && !self.shelf.holds(value.0) {
            self.came.entry(value.0).or_default().push(value.1);
            return true;
        }
        let change = self.shelf.change();
        let has_bytes = self.shelf.bytes() < LIMITS.bytes;
        if self.shelf.put(value.0, value, value.2).is_err() {
            assert!(!has_bytes, "an honest sender's is refused");
            self.refused.insert((value.0, value.1));
            self.say();
        }
        if self.shelf.change() != change {
            self.say();
        }
        true
    }

    fn hear(&mut self) -> bool {
        let Some(ack) = self.back.pop_front() else { return false };
        self.sending.heard(&ack);
        let turn = self.held.heard(ack.change, ack.held);
        turn.released.into_iter().rev().for_each(|value| self.queue.push_front(value));
        true
    }

    /// A destination takes all that waits for it, and what comes from now on.
    fn take(&mut self, key: u64) {
        self.full.remove(&key);
        while let Some((value, _)) = self.shelf.offer(key) {
            self.came.entry(key).or_default().push(value.1);
            if self.shelf.taken(key) {
                self.say();
            }
        }
        if self.receiving.owes_room(self.shelf.room(WINDOW, LONGEST)) {
            self.say();
        }
    }

    /// Until nothing can happen any more; each time all that may be sent is sent before any of it is read, and read before a word is heard.
    fn run(&mut self) {
        let mut happens = true;
        while happens {
            happens = false;
            while self.write() || self.read() {
                happens = true;
            }
            while self.hear() {
                happens = true;
            }
        }
    }

    fn came(&self, key: u64) -> usize {
        self.came.get(&key).map_or(0, Vec::len)
    }
}

#[derive(Clone, Debug)]
enum Step {
    Send(u64, usize),
    Fill(u64),
    /// So many messages of so many bytes for one that is full from then on, as far as they go.
    Burst(u64, usize, usize),
    Take(u64),
    Write,
    Read,
    Hear,
    Connect,
}

fn any_step() -> impl Strategy<Value = Step> {
    let key = 0..LINES as u64;
    prop_oneof![
        12 => (key.clone(), 1..=LONGEST).prop_map(|(key, bytes)| Step::Send(key, bytes)),
        1 => key.clone().prop_map(Step::Fill),
        3 => (key.clone(), 1..30_usize, 1..=LONGEST).prop_map(|(key, count, bytes)| Step::Burst(key, count, bytes)),
        1 => key.prop_map(Step::Take),
        12 => Just(Step::Write),
        10 => Just(Step::Read),
        6 => Just(Step::Hear),
        1 => Just(Step::Connect),
    ]
}

proptest! {
    #[test]
    fn nobody_who_heeds_what_it_is_told_is_refused_and_all_arrives(steps in proptest::collection::vec(any_step(), 1..600)) {
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
                Step::Hear => drop(world.hear()),
                Step::Connect => world.connect(),
            }
        }
        world.run();
        for key in 0..LINES as u64 {
            world.take(key);
            world.run();
        }
        for (key, sent) in &world.sent {
            let came = world.came.get(key).cloned().unwrap_or_default();
            let taken = (1..=*sent).filter(|number| !world.refused.contains(&(*key, *number)));
            prop_assert_eq!(came, taken.collect::<Vec<_>>(), "for {}", key);
        }
    }
}

#[test]
fn however_many_take_nothing_the_others_pass() {
    // Short ones use the messages up, long ones the bytes.
    for bytes in [1, LONGEST] {
        let mut world = World::new();
        // Each of them has had more than a window before it was known that it is full.
        for full in 1..LINES as u64 {
            world.full.insert(full);
            (0..20).for_each(|_| world.send(full, bytes));
            world.run();
        }
        for number in 1..=100 {
            world.send(0, bytes);
            world.run();
            assert_eq!(world.came(0), number, "of {bytes} bytes");
        }
    }
}
