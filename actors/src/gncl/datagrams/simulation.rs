//! Two nodes on virtual time, and a network between them that loses, doubles, delays and blocks datagrams, as a seed decides; the layer is
//! restarted at either side meanwhile, the connection is full, and the receiver forgets the sender. Faults are planted to see that they are found.

use std::{
    collections::{BTreeMap, VecDeque},
    time::Duration,
};

use sinew_runtime::time::Time;

use crate::seeded::{Seed, number};

use super::{
    core::{Core, Order, stamp},
    incoming::{FLOWS_MAX, Incoming},
    lengths::{Report, SHORTEST},
    outgoing::{LIMITS, Offered, Outgoing},
    packet::{Acknowledgement, DATAGRAM_MAX},
};

/// The one seed that is to be replayed.
const SEED_VARIABLE: &str = "SINEW_GNCL_SEED";

/// What is wrong.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) enum Planted {
    #[default]
    Nothing,
    /// Each value is handed on, whatever its number.
    NumbersNotCompared,
    /// A value that counts as lost is not sent again.
    NotRepeated,
    /// A restart of the sender's layer begins its numbers anew.
    NumbersNotKept,
    /// A restart of the receiver's layer forgets what came.
    WhatCameNotKept,
    /// When datagrams do not get through, what is under way is not handed to the connection.
    NotHandedOver,
    /// Values by the connection are not compared.
    ConnectionNotCompared,
    /// What the connection has no room for is dropped.
    FullDrops,
    /// The last value that was taken is given up for a newer one before the connection has taken that.
    GivenUpFirst,
    /// What is under way when the peer says another key is dropped.
    AnewDrops,
    /// A probe that is answered is believed for every length.
    LengthsBelieved,
}

/// Of a flow, which of its values.
type Value = (u8, u64);

#[derive(Clone, Debug)]
enum Datagram {
    Probe(u32, u64),
    Value(u32, u64, Value),
    Acknowledgement(Box<Acknowledgement>),
}

#[derive(Clone, Copy, Debug)]
struct Network {
    lost: f64,
    doubled: f64,
    delay_us: u64,
    /// Added by chance, up to so much: what overtakes what.
    jitter_us: u64,
}

struct Dice(fastrand::Rng);

impl Dice {
    fn new(seed: u64) -> Self {
        Self(fastrand::Rng::with_seed(seed))
    }

    fn below(&mut self, bound: u64) -> u64 {
        self.0.u64(..bound.max(1))
    }

    fn happens(&mut self, chance: f64) -> bool {
        self.0.f64() < chance
    }
}

/// One direction of values, and what is said of them the other way.
struct World {
    dice: Dice,
    now: Time,
    planted: Planted,
    network: Network,
    /// No datagram gets through, as long as this is so.
    is_blocked: bool,
    /// The longest datagram that gets through to the receiver.
    longest: usize,
    /// What a flow's values make of a datagram.
    lengths: fn(u8) -> usize,
    /// The connection has no room for one more, as long as this is so.
    is_full: bool,
    /// When the sender hears that the receiver has forgotten it; what it sends before has the former key.
    another_key: Option<Time>,
    sender: Core<u8, Value>,
    receiver: Core<u8, Value>,
    /// Neither reads nor looks at the time before this: its layer is being restarted.
    sender_back: Time,
    receiver_back: Time,
    there: Vec<(Time, Datagram)>,
    back: Vec<(Time, Datagram)>,
    /// The connection: in order, some time.
    connection: VecDeque<(Time, u64, Value)>,
    sent: BTreeMap<u8, u64>,
    /// Each value that was handed on, and its age in microseconds.
    came: BTreeMap<u8, Vec<u64>>,
    ages_us: Vec<u64>,
    sent_at: BTreeMap<Value, Time>,
    by_datagram: u64,
    by_connection: u64,
    warnings: usize,
}

impl World {
    fn new(seed: u64, network: Network, planted: Planted) -> Self {
        let now = Time::ZERO + Duration::from_secs(5);
        let (mut sender, mut receiver) = (Core::new(now.as_nanos()), Core::new(now.as_nanos()));
        sender.announced(now);
        receiver.announced(now);
        sender.outgoing.planted = planted;
        sender.lengths.planted = planted;
        receiver.incoming.planted = planted;
        Self {
            dice: Dice::new(seed),
            now,
            planted,
            network,
            is_blocked: false,
            longest: DATAGRAM_MAX,
            lengths: |_| 200,
            is_full: false,
            another_key: None,
            sender,
            receiver,
            sender_back: now,
            receiver_back: now,
            there: Vec::new(),
            back: Vec::new(),
            connection: VecDeque::new(),
            sent: BTreeMap::new(),
            came: BTreeMap::new(),
            ages_us: Vec::new(),
            sent_at: BTreeMap::new(),
            by_datagram: 0,
            by_connection: 0,
            warnings: 0,
        }
    }

    fn send(&mut self, key: u8) {
        let count = self.sent.entry(key).or_default();
        *count += 1;
        let value = (key, *count);
        self.sent_at.insert(value, self.now);
        match self.sender.submit(key, value, (self.lengths)(key), Time::MAX) {
            Ok(()) => {
                self.by_datagram += 1;
                self.flush_sender();
            }
            Err(value) => {
                let number = self.sender.outgoing.given_elsewhere(key);
                if self.planted == Planted::GivenUpFirst {
                    self.sender.outgoing.taken_elsewhere(key, number);
                }
                if self.is_full {
                    // Its application is told, and tries again or not: it was not taken.
                    self.sender.outgoing.refused_elsewhere(key);
                    *self.sent.entry(key).or_default() -= 1;
                } else {
                    self.sender.outgoing.taken_elsewhere(key, number);
                    self.connect(number, value);
                }
            }
        }
    }

    fn hand_over(&mut self) {
        let (planted, is_full) = (self.planted, self.is_full);
        let mut taken = Vec::new();
        self.sender.outgoing.hand_over(self.now, |number, value| match (planted, is_full) {
            (Planted::NotHandedOver, _) => Offered::Taken,
            (Planted::FullDrops, true) => Offered::Refused,
            (_, true) => Offered::Full(value),
            (_, false) => {
                taken.push((number, value));
                Offered::Taken
            }
        });
        taken.into_iter().for_each(|(number, value)| self.connect(number, value));
    }

    fn connect(&mut self, number: u64, value: Value) {
        let delay = Duration::from_micros(200 + self.dice.below(200_000));
        let at = self.connection.back().map_or(self.now, |(last, ..)| *last).max(self.now + delay);
        self.connection.push_back((at, number, value));
        self.by_connection += 1;
    }

    fn flush_sender(&mut self) {
        let (now, stamp) = (self.now, stamp(self.now));
        while let Some(order) = self.sender.poll(now) {
            let (datagram, length) = match order {
                Order::Probe(number, length) => (Datagram::Probe(stamp, number), length),
                Order::Value(number, value) => {
                    (Datagram::Value(stamp, number, *value), (self.lengths)(value.0))
                }
                Order::Acknowledgement => {
                    let said = self.sender.incoming.take(now, 32).expect("it is due");
                    (Datagram::Acknowledgement(Box::new(said)), SHORTEST)
                }
            };
            let is_lost = self.another_key.is_some() || length > self.longest;
            let arrivals = if is_lost { Vec::new() } else { self.arrivals() };
            self.there.extend(arrivals.into_iter().map(|at| (at, datagram.clone())));
        }
    }

    fn flush_receiver(&mut self) {
        let (now, stamp) = (self.now, stamp(self.now));
        while let Some(order) = self.receiver.poll(now) {
            let datagram = match order {
                Order::Probe(number, _) => Datagram::Probe(stamp, number),
                Order::Value(..) => unreachable!("it sends none"),
                Order::Acknowledgement => {
                    // As one that has room for few ranges only.
                    Datagram::Acknowledgement(Box::new(
                        self.receiver.incoming.take(now, 2).expect("it is due"),
                    ))
                }
            };
            let arrivals = self.arrivals();
            self.back.extend(arrivals.into_iter().map(|at| (at, datagram.clone())));
        }
    }

    /// When a datagram that is sent now arrives: not at all, once or twice.
    fn arrivals(&mut self) -> Vec<Time> {
        let Network { lost, doubled, delay_us, jitter_us } = self.network;
        let copies = 1 + usize::from(self.dice.happens(doubled));
        let mut arrivals = Vec::new();
        for _ in 0..copies {
            if !self.dice.happens(lost) && !self.is_blocked {
                let delay = delay_us + self.dice.below(jitter_us + 1);
                arrivals.push(self.now + Duration::from_micros(delay));
            }
        }
        arrivals
    }

    fn hand_on(&mut self, (key, number): Value) {
        self.came.entry(key).or_default().push(number);
        let sent = self.sent_at[&(key, number)];
        self.ages_us.push(self.now.since(sent).as_micros() as u64);
    }

    fn read_there(&mut self) {
        for datagram in due(&mut self.there, self.now) {
            match datagram {
                Datagram::Probe(stamp, number) => self.receiver.asked(self.now, stamp, number),
                Datagram::Value(stamp, number, value) => {
                    if self.receiver.incoming.came(self.now, stamp, value.0, number) {
                        self.hand_on(value);
                    }
                }
                Datagram::Acknowledgement(said) => drop(self.receiver.acknowledged(self.now, &said)),
            }
        }
        while let Some((_, number, value)) = self.connection.pop_front_if(|(at, ..)| *at <= self.now) {
            let is_new = self.receiver.incoming.came_by_connection(value.0, number);
            if is_new || self.planted == Planted::ConnectionNotCompared {
                self.hand_on(value);
            }
        }
    }

    fn read_back(&mut self) {
        for datagram in due(&mut self.back, self.now) {
            match datagram {
                Datagram::Probe(stamp, number) => self.sender.asked(self.now, stamp, number),
                Datagram::Value(..) => unreachable!("nobody sends one"),
                Datagram::Acknowledgement(said) => drop(self.sender.acknowledged(self.now, &said)),
            }
        }
    }

    /// A tenth of a millisecond.
    fn step(&mut self) {
        self.now = self.now + Duration::from_micros(100);
        if self.receiver_back <= self.now {
            self.read_there();
            self.receiver.tick(self.now, self.now);
            self.flush_receiver();
        }
        if self.sender_back <= self.now {
            self.read_back();
            self.hear_of_another_key();
            self.warnings += usize::from(self.sender.tick(self.now, self.now));
            self.hand_over();
            self.flush_sender();
        }
    }

    fn steps(&mut self, millis: u64) {
        (0..millis * 10).for_each(|_| self.step());
    }

    fn restart_sender(&mut self) {
        self.sender_back = self.now + Duration::from_millis(1 + self.dice.below(60));
        if self.planted == Planted::NumbersNotKept {
            self.sender.outgoing = Outgoing::new(1, LIMITS);
        }
    }

    fn restart_receiver(&mut self) {
        self.receiver_back = self.now + Duration::from_millis(1 + self.dice.below(60));
        if self.planted == Planted::WhatCameNotKept {
            self.receiver.incoming = Incoming::new(FLOWS_MAX);
        }
    }

    /// The receiver has forgotten the sender but for the numbers that it has had; its key is another one from now on.
    fn forget_sender(&mut self) {
        let mut former = std::mem::replace(&mut self.receiver, Core::new(self.now.as_nanos()));
        former.incoming.begin_anew();
        self.receiver.incoming = former.incoming;
        self.receiver.announced(self.now);
        self.there.clear();
        self.another_key = Some(self.now + Duration::from_millis(1 + self.dice.below(300)));
    }

    fn hear_of_another_key(&mut self) {
        if self.another_key.take_if(|at| *at <= self.now).is_some() {
            self.sender.begin_anew();
            if self.planted == Planted::AnewDrops {
                self.sender.outgoing.end();
            }
            self.sender.announced(self.now);
        }
    }

    /// What is wrong, if anything is.
    fn verdict(&self) -> Result<(), String> {
        for (key, sent) in &self.sent {
            let came = self.came.get(key).cloned().unwrap_or_default();
            if !came.is_sorted_by(|a, b| a < b) {
                return Err(format!("flow {key}: not once and in order: {came:?}"));
            }
            if came.last() != Some(sent) {
                return Err(format!("flow {key}: the last value {sent} has not come, but {:?}", came.last()));
            }
        }
        let position = self.sender.position();
        let ends = [position.arrived, position.superseded(), position.expired(), position.unknown()];
        let here = position.waiting + position.unacknowledged + position.counts.lost;
        if position.taken() != ends.iter().sum::<u64>() + here {
            return Err(format!("messages are not explained: {position:?}"));
        }
        Ok(())
    }
}

fn due(on_the_way: &mut Vec<(Time, Datagram)>, now: Time) -> Vec<Datagram> {
    let (mut due, rest): (Vec<_>, Vec<_>) =
        std::mem::take(on_the_way).into_iter().partition(|(at, _)| *at <= now);
    *on_the_way = rest;
    due.sort_by_key(|(at, _)| *at);
    due.into_iter().map(|(_, datagram)| datagram).collect()
}

/// Two seconds of up to six flows with everything that a seed thinks of, then quiet.
fn play(seed: u64, planted: Planted) -> Result<World, String> {
    let mut dice = Dice::new(seed ^ 0x5eed);
    let network = Network {
        lost: [0.0, 0.01, 0.05, 0.3][dice.below(4) as usize],
        doubled: [0.0, 0.1][dice.below(2) as usize],
        delay_us: [100, 2_000, 20_000][dice.below(3) as usize],
        jitter_us: [0, 500, 30_000][dice.below(3) as usize],
    };
    let mut world = World::new(seed, network, planted);
    // From 100 to 1,175 bytes.
    world.lengths = |key| 100 + 215 * usize::from(key);
    let flows = 1 + dice.below(6);
    let (ends_cut_off, ends_forgotten) = (dice.below(3) == 0, dice.below(3) == 0);
    for millis in 0..2_000 {
        for key in 0..flows {
            // Some send at each millisecond, some seldom: what is superseded is not repeated, what is not must be.
            if dice.below(1 + 20 * key) == 0 {
                world.send(key as u8);
            }
        }
        match dice.below(1_000) {
            0..=2 => world.restart_sender(),
            3..=5 => world.restart_receiver(),
            6 => world.is_blocked = true,
            7..=9 => world.is_blocked = false,
            10 => world.sender.reconnected(world.now),
            11..=12 => world.is_full = true,
            13..=17 => world.is_full = false,
            18..=19 => world.forget_sender(),
            20 => world.longest = SHORTEST + dice.below(1_061) as usize,
            21 => world.longest = DATAGRAM_MAX,
            _ => {}
        }
        if ends_cut_off && millis > 1_200 {
            (world.is_blocked, world.is_full) = (true, true);
        }
        world.steps(1);
    }
    if ends_forgotten {
        world.forget_sender();
    }
    world.is_blocked = dice.below(4) == 0;
    world.is_full = false;
    world.network.lost = world.network.lost.min(0.05);
    world.steps(3_000);
    world.verdict().map_err(|what| format!("seed {seed}, {planted:?}: {what}"))?;
    Ok(world)
}

#[test]
fn whatever_the_network_does_values_come_once_in_order_and_the_last_one_comes() {
    let (mut datagrams, mut connection) = (0, 0);
    let only = number(SEED_VARIABLE);
    for number in only.map_or(0..60, |only| only..only + 1) {
        let test = "gncl::datagrams::simulation::whatever_the_network_does";
        let seed = Seed { number, variable: SEED_VARIABLE, package: "sinew", test };
        let played = seed.run(|| play(number, Planted::Nothing));
        let world = played.unwrap_or_else(|what| panic!("{what}\n{seed}"));
        datagrams += world.by_datagram;
        connection += world.by_connection;
    }
    assert!(
        only.is_some() || datagrams > 3 * connection && connection > 100,
        "{datagrams} by datagram, {connection} otherwise"
    );
}

#[test]
fn each_planted_fault_of_the_datagrams_is_found() {
    for planted in [
        Planted::NumbersNotCompared,
        Planted::NotRepeated,
        Planted::NumbersNotKept,
        Planted::WhatCameNotKept,
        Planted::NotHandedOver,
        Planted::ConnectionNotCompared,
        Planted::FullDrops,
        Planted::GivenUpFirst,
        Planted::AnewDrops,
    ] {
        let found = (0..60).filter_map(|seed| play(seed, planted).err()).next();
        println!("{planted:?}: {found:?}");
        assert!(found.is_some(), "{planted:?} was not found");
    }
}

#[test]
fn at_one_and_five_percent_of_loss_a_value_is_late_by_milliseconds() {
    for (lost, p99_max_us) in [(0.0, 1_000), (0.01, 6_000), (0.05, 14_000)] {
        let network = Network { lost, doubled: 0.0, delay_us: 300, jitter_us: 100 };
        let mut world = World::new(7, network, Planted::Nothing);
        world.steps(100);
        for _ in 0..2_000 {
            // One that nobody supersedes for long, so that a loss has to be mended.
            world.send(0);
            world.steps(10);
        }
        world.verdict().unwrap();
        world.ages_us.sort_unstable();
        let p99 = world.ages_us[world.ages_us.len() * 99 / 100];
        assert!(p99 <= p99_max_us, "{lost}: p99 {p99} us");
        assert_eq!(world.by_connection, 0);
    }
}

#[test]
fn a_blocked_way_is_found_out_and_nothing_is_lost_by_it_and_it_is_tried_again() {
    let network = Network { lost: 0.0, doubled: 0.0, delay_us: 300, jitter_us: 0 };
    let mut world = World::new(1, network, Planted::Nothing);
    world.steps(100);
    world.send(0);
    world.steps(100);
    assert_eq!((world.by_datagram, world.by_connection), (1, 0));
    world.is_blocked = true;
    world.send(0);
    world.steps(1_000);
    assert!(!world.sender.is_open());
    world.send(0);
    world.steps(5_000);
    assert_eq!(world.came[&0], [1, 2, 3]);
    assert_eq!(world.warnings, 1);
    world.is_blocked = false;
    world.steps(10_000);
    world.send(0);
    world.steps(100);
    assert!(world.sender.is_open());
    assert_eq!((world.came[&0].len(), world.by_datagram), (4, 3));
    world.verdict().unwrap();
}

/// The lengths of row after row, from 120 bytes to a whole datagram.
const LENGTHS: [usize; 6] = [120, 488, 788, 988, 1_188, DATAGRAM_MAX];

/// Values of each length 50 times a second, for so long. Returns how many of each came.
fn send_each_length(world: &mut World, millis: u64) -> Vec<usize> {
    let before: Vec<_> = (0..6).map(|key| world.came.get(&key).map_or(0, Vec::len)).collect();
    for _ in 0..millis / 20 {
        (0..6).for_each(|key| world.send(key));
        world.steps(20);
    }
    world.steps(250);
    (0..6).map(|key| world.came.get(&key).map_or(0, Vec::len) - before[usize::from(key)]).collect()
}

/// How many values of each length come in 5 s, of 250, where longer datagrams than `longest` vanish from the start.
fn behind_a_hole(longest: usize, planted: Planted) -> (Vec<usize>, World) {
    let network = Network { lost: 0.0, doubled: 0.0, delay_us: 300, jitter_us: 100 };
    let mut world = World::new(3, network, planted);
    (world.longest, world.lengths) = (longest, |key| LENGTHS[usize::from(key)]);
    world.steps(1_000);
    (send_each_length(&mut world, 5_000), world)
}

// spec: DATAGRAM-7
#[test]
fn where_long_datagrams_vanish_every_length_comes_at_the_full_rate() {
    for longest in [300, 600, 972, 1_199] {
        let (came, mut world) = behind_a_hole(longest, Planted::Nothing);
        assert_eq!(came, [250; 6], "longer than {longest} vanish");
        let report = world.sender.report();
        assert!(matches!(report, Some(Report::Narrow(passes)) if passes <= longest), "{report:?}");
        world.verdict().unwrap();
        let (came, _) = behind_a_hole(longest, Planted::LengthsBelieved);
        assert!(came[5] < 10, "a probe that is believed for every length is found: {came:?}");
    }
}

// spec: DATAGRAM-7
#[test]
fn a_way_that_shrinks_while_it_is_used_costs_a_few_values_and_is_used_wholly_again_when_it_grows() {
    let network = Network { lost: 0.01, doubled: 0.0, delay_us: 300, jitter_us: 100 };
    let mut world = World::new(5, network, Planted::Nothing);
    world.lengths = |key| LENGTHS[usize::from(key)];
    world.steps(100);
    assert_eq!(send_each_length(&mut world, 1_000), [50; 6]);
    world.longest = 700;
    let came = send_each_length(&mut world, 2_000);
    assert!(came.iter().all(|count| (95..=100).contains(count)), "{came:?}");
    let by_connection = world.by_connection;
    assert_eq!(send_each_length(&mut world, 2_000), [100; 6]);
    assert!(world.by_connection > by_connection);
    world.longest = DATAGRAM_MAX;
    world.steps(11_000);
    let by_connection = world.by_connection;
    assert_eq!(send_each_length(&mut world, 1_000), [50; 6]);
    assert_eq!(world.by_connection, by_connection, "all go by datagram again");
    world.verdict().unwrap();
}
