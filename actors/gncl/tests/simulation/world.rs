//! The simulated nodes and the network between them: one direction of values, step by step on virtual time.

use std::{collections::BTreeMap, time::Duration};

use sinew_gncl::datagrams::{
    Acknowledgement, Core, DATAGRAM_MAX, FLOWS_MAX, Fault, Incoming, LIMITS, Offered, Order, Outgoing,
    SHORTEST, stamp,
};
use sinew_runtime::time::Time;
use sinew_sim::{Chance, Network, Pipe, Quality, Queue};

use super::Planted;

/// A flow, and the number of one of its values.
type Value = (u8, u64);

#[derive(Clone, Debug)]
enum Datagram {
    Probe(u32, u64),
    Value(u32, u64, Value),
    Acknowledgement(Box<Acknowledgement>),
}

/// The ends of the network.
const SENDER: char = 's';
const RECEIVER: char = 'r';

/// One direction of values, and the acknowledgements in the other direction.
pub(super) struct World {
    chance: Chance,
    pub(super) now: Time,
    planted: Planted,
    network: Network<char>,
    /// The longest datagram that gets through to the receiver.
    pub(super) longest: usize,
    /// The datagram length of a flow's values.
    pub(super) lengths: fn(u8) -> usize,
    /// The connection has no room while this is set.
    pub(super) is_full: bool,
    /// The time at which the sender is notified that the receiver has forgotten it; datagrams sent before have the
    /// former key.
    another_key: Option<Time>,
    pub(super) sender: Core<u8, Value>,
    receiver: Core<u8, Value>,
    /// No reads and timer checks before this time: the layer is being restarted.
    sender_back: Time,
    receiver_back: Time,
    there: Queue<Datagram>,
    back: Queue<Datagram>,
    connection: Pipe<(u64, Value)>,
    sent: BTreeMap<u8, u64>,
    /// The numbers of the forwarded values of each flow.
    pub(super) came: BTreeMap<u8, Vec<u64>>,
    pub(super) ages_us: Vec<u64>,
    sent_at: BTreeMap<Value, Time>,
    pub(super) by_datagram: u64,
    pub(super) by_connection: u64,
    /// Datagrams with a value, repetitions included.
    pub(super) transmissions: u64,
    pub(super) warnings: usize,
}

impl World {
    pub(super) fn new(seed: u64, quality: Quality, planted: Planted) -> Self {
        let now = Time::ZERO + Duration::from_secs(5);
        let (mut sender, mut receiver) = (Core::new(now.as_nanos()), Core::new(now.as_nanos()));
        sender.announced(now);
        receiver.announced(now);
        match planted {
            Planted::NumbersNotCompared => receiver.plant(Fault::NumbersNotCompared),
            Planted::NotRepeated => sender.plant(Fault::NotRepeated),
            Planted::AllLengthsTrusted => sender.plant(Fault::AllLengthsTrusted),
            Planted::Nothing
            | Planted::NumbersNotKept
            | Planted::ReceivedNumbersNotKept
            | Planted::NotOffered
            | Planted::ConnectionNotCompared
            | Planted::FullDrops
            | Planted::DroppedTooEarly
            | Planted::NewKeyDrops => {}
        }
        Self {
            chance: Chance::new(seed),
            now,
            planted,
            network: Network::new(quality),
            longest: DATAGRAM_MAX,
            lengths: |_| 200,
            is_full: false,
            another_key: None,
            sender,
            receiver,
            sender_back: now,
            receiver_back: now,
            there: Queue::starting_at(now),
            back: Queue::starting_at(now),
            connection: Pipe::default(),
            sent: BTreeMap::new(),
            came: BTreeMap::new(),
            ages_us: Vec::new(),
            sent_at: BTreeMap::new(),
            by_datagram: 0,
            by_connection: 0,
            transmissions: 0,
            warnings: 0,
        }
    }

    /// Blocks all datagrams, or lets them through.
    pub(super) fn block(&mut self, is_blocked: bool) {
        for (from, to) in [(SENDER, RECEIVER), (RECEIVER, SENDER)] {
            if is_blocked {
                self.network.cut(from, to);
            } else {
                self.network.mend(from, to);
            }
        }
    }

    /// Sets the quality of the network, and lets datagrams through.
    pub(super) fn heal(&mut self, quality: Quality) {
        self.network.heal(quality);
    }

    pub(super) fn send(&mut self, key: u8) {
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
                let number = self.sender.outgoing.start_on_connection(key);
                if self.planted == Planted::DroppedTooEarly {
                    self.sender.outgoing.accepted_by_connection(key, number);
                }
                if self.is_full {
                    // Its application is notified, and may retry: the value was not accepted.
                    self.sender.outgoing.rejected_by_connection(key);
                    *self.sent.entry(key).or_default() -= 1;
                } else {
                    self.sender.outgoing.accepted_by_connection(key, number);
                    self.connect(number, value);
                }
            }
        }
    }

    fn offer_to_connection(&mut self) {
        let (planted, is_full) = (self.planted, self.is_full);
        let mut taken = Vec::new();
        self.sender.outgoing.offer_to_connection(self.now, |number, value| match (planted, is_full) {
            (Planted::NotOffered, _) => Offered::Taken,
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
        let delay = self.chance.between(Duration::from_micros(200), Duration::from_millis(200));
        self.connection.send(self.now + delay, (number, value));
        self.by_connection += 1;
    }

    fn flush_sender(&mut self) {
        let (now, stamp) = (self.now, stamp(self.now));
        while let Some(order) = self.sender.poll(now) {
            let (datagram, length) = match order {
                Order::Probe(number, length) => (Datagram::Probe(stamp, number), length),
                Order::Value(number, value) => {
                    self.transmissions += 1;
                    (Datagram::Value(stamp, number, *value), (self.lengths)(value.0))
                }
                Order::Acknowledgement => {
                    let ack = self.sender.incoming.take(now, 32).expect("it is due");
                    (Datagram::Acknowledgement(Box::new(ack)), SHORTEST)
                }
            };
            let is_lost = self.another_key.is_some() || length > self.longest;
            let arrivals = self.network.arrivals(&mut self.chance, SENDER, RECEIVER);
            for delay in arrivals.into_iter().filter(|_| !is_lost) {
                self.there.push(now + delay, datagram.clone());
            }
        }
    }

    fn flush_receiver(&mut self) {
        let (now, stamp) = (self.now, stamp(self.now));
        while let Some(order) = self.receiver.poll(now) {
            let datagram = match order {
                Order::Probe(number, _) => Datagram::Probe(stamp, number),
                Order::Value(..) => unreachable!("it sends none"),
                Order::Acknowledgement => {
                    // The acknowledgement has room for few ranges only.
                    Datagram::Acknowledgement(Box::new(
                        self.receiver.incoming.take(now, 2).expect("it is due"),
                    ))
                }
            };
            for delay in self.network.arrivals(&mut self.chance, RECEIVER, SENDER) {
                self.back.push(now + delay, datagram.clone());
            }
        }
    }

    fn hand_on(&mut self, (key, number): Value) {
        self.came.entry(key).or_default().push(number);
        let sent = self.sent_at[&(key, number)];
        self.ages_us.push(self.now.since(sent).as_micros() as u64);
    }

    fn read_there(&mut self) {
        while let Some(datagram) = self.there.pop_until(self.now) {
            match datagram {
                Datagram::Probe(stamp, number) => self.receiver.on_probe(self.now, stamp, number),
                Datagram::Value(stamp, number, value) => {
                    if self.receiver.incoming.on_value(self.now, stamp, value.0, number) {
                        self.hand_on(value);
                    }
                }
                Datagram::Acknowledgement(ack) => drop(self.receiver.acknowledged(self.now, &ack)),
            }
        }
        while let Some((number, value)) = self.connection.receive(self.now) {
            let is_new = self.receiver.incoming.on_connection_value(value.0, number);
            if is_new || self.planted == Planted::ConnectionNotCompared {
                self.hand_on(value);
            }
        }
    }

    fn read_back(&mut self) {
        while let Some(datagram) = self.back.pop_until(self.now) {
            match datagram {
                Datagram::Probe(stamp, number) => self.sender.on_probe(self.now, stamp, number),
                Datagram::Value(..) => unreachable!("nobody sends one"),
                Datagram::Acknowledgement(ack) => drop(self.sender.acknowledged(self.now, &ack)),
            }
        }
    }

    /// Runs a tenth of a millisecond.
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
            self.offer_to_connection();
            self.flush_sender();
        }
    }

    pub(super) fn steps(&mut self, millis: u64) {
        (0..millis * 10).for_each(|_| self.step());
    }

    pub(super) fn restart_sender(&mut self) {
        self.sender_back = self.now + Duration::from_millis(1 + self.chance.below(60));
        if self.planted == Planted::NumbersNotKept {
            self.sender.outgoing = Outgoing::new(1, LIMITS);
        }
    }

    pub(super) fn restart_receiver(&mut self) {
        self.receiver_back = self.now + Duration::from_millis(1 + self.chance.below(60));
        if self.planted == Planted::ReceivedNumbersNotKept {
            self.receiver.incoming = Incoming::new(FLOWS_MAX);
        }
    }

    /// The receiver forgets the sender except for the received numbers; it has another key from now on.
    pub(super) fn forget_sender(&mut self) {
        let mut former = std::mem::replace(&mut self.receiver, Core::new(self.now.as_nanos()));
        former.incoming.begin_anew();
        self.receiver.incoming = former.incoming;
        self.receiver.announced(self.now);
        self.there.retain(|_| false);
        self.another_key = Some(self.now + Duration::from_millis(1 + self.chance.below(300)));
    }

    fn hear_of_another_key(&mut self) {
        if self.another_key.take_if(|at| *at <= self.now).is_some() {
            self.sender.begin_anew();
            if self.planted == Planted::NewKeyDrops {
                self.sender.outgoing.end();
            }
            self.sender.announced(self.now);
        }
    }

    /// Returns the first violation, if any.
    pub(super) fn verdict(&self) -> Result<(), String> {
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
