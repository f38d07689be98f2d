//! The role of a poster's process: 8 addresses that send to all others in every class, and tell the ledger.
//!
//! Half of them wait for outcomes, the other half for messages: if all waited for each other nobody would handle anything.

use std::{
    collections::BTreeMap,
    sync::atomic::{AtomicU8, Ordering},
    thread,
    time::Duration,
};

use sinew::{
    Class, Endpoint, NodeApi, Outcome, Tid, Time,
    client::{ApiError, Received},
    message::Rejection,
    payload,
};

use super::{
    entry::{Entry, Poster, Way},
    registration::{address, register, wishes},
    say, told,
};
use crate::dice::Dice;

/// Posters of one process.
pub(super) const POSTERS: Poster = 8;
/// Messages that wait at one place, at most. None of them may be full here: the ledger asks for every message.
pub(super) const CAPACITY: usize = 65_536;
/// Unconfirmed messages that are sent in a row, at most.
const BATCH_MAX: u32 = 8;
/// Messages that are handled before the poster sends again.
const HANDLED_IN_A_ROW: u32 = 64;

/// What the director wants: posts, then quiet, then the end.
static STAGE: AtomicU8 = AtomicU8::new(POSTING);
const POSTING: u8 = 0;
const QUIET: u8 = 1;
const END: u8 = 2;

macro_rules! letter {
    ($type:ident, $name:literal, $class:ident) => {
        payload!($name, $class =>
            pub(super) struct $type {
                pub(super) life: u32,
                pub(super) number: u64,
                #[serde(with = "serde_bytes")]
                pub(super) body: Vec<u8>,
            }
        );
    };
}
letter!(Wire, "poster.control", Control);
letter!(Card, "poster.stream", Stream);
letter!(Parcel, "poster.bulk", Bulk);

/// `SOCKET PROCESS LIFE POSTERS_IN_ALL SEED PAUSE_MS`
pub(super) fn play(arguments: &[String]) {
    let number = |index: usize| arguments[index].parse::<u64>().expect("a number");
    let (process, life) = (number(1) as Poster, number(2) as u32);
    let all = number(3) as Poster;
    let api = NodeApi::connect(&arguments[0]).expect("the door is open");
    for index in 0..POSTERS {
        let (api, me) = (api.clone(), process * POSTERS + index);
        let dice = Dice::new(number(4) ^ u64::from(me) << 40 ^ u64::from(life) << 20);
        let pause = Duration::from_millis(number(5));
        thread::spawn(move || Letters::register(&api, me, all, life, dice).work(pause));
    }
    for order in told() {
        assert_eq!(order, "quiet");
        be_quiet();
    }
    // The addresses are given back by the end of the process.
    STAGE.store(END, Ordering::Relaxed);
}

/// Whether a poster waits for messages, and not for outcomes.
const fn is_handler(poster: Poster) -> bool {
    poster.is_multiple_of(2)
}

/// Small ones mostly; now and then one that fits no socket buffer and no half of a ring.
pub(super) fn body(dice: &mut Dice, number: u64) -> Vec<u8> {
    let length = match dice.below(512) {
        0 => dice.below(400_000),
        1..16 => dice.below(20_000),
        _ => dice.below(300),
    };
    vec![number as u8; length as usize]
}

/// How long an outcome is waited for.
pub(super) fn within(dice: &mut Dice) -> Duration {
    Duration::from_millis(u64::from(5 + dice.below(300)))
}

/// Whether this process is to send.
pub(super) fn is_posting() -> bool {
    STAGE.load(Ordering::Relaxed) == POSTING
}

/// The posters of this process send no more.
pub(super) fn be_quiet() {
    STAGE.store(QUIET, Ordering::Relaxed);
}

struct Letters {
    endpoint: Endpoint,
    me: Poster,
    /// How many posters there are.
    all: Poster,
    life: u32,
    dice: Dice,
    /// The last number on each way.
    numbers: BTreeMap<Way, u64>,
}

impl Letters {
    fn register(api: &NodeApi, me: Poster, all: Poster, life: u32, dice: Dice) -> Self {
        let registration = wishes().fixed_address(address(me)).inbox_capacity(CAPACITY);
        let endpoint = register(api, &registration);
        let this = Self { endpoint, me, all, life, dice, numbers: BTreeMap::new() };
        this.tell(&Entry::Up(Time::now()));
        this
    }

    fn tell(&self, entry: &Entry) {
        if let Entry::Broken(why) = entry {
            eprintln!("poster {} in life {}: {why}", self.me, self.life);
        }
        say(&format!("{} {entry}", self.me));
    }

    fn work(mut self, pause: Duration) {
        while is_posting() {
            if is_handler(self.me) || self.dice.once_in(4) {
                self.send_some();
            } else {
                self.ask_one();
            }
            let within = self.dice.time_below(pause);
            self.handle_some(within);
        }
        self.tell(&Entry::Quiet);
        while STAGE.load(Ordering::Relaxed) != END {
            self.handle_some(Duration::from_millis(5));
        }
    }

    fn somewhere(&mut self, class: Class) -> (Way, Tid) {
        let other = (self.me + 1 + self.dice.below(u32::from(self.all) - 1) as Poster) % self.all;
        let tid = Tid::new(self.endpoint.tid().node, address(other));
        (Way { to: other, class }, tid)
    }

    fn next_number(&mut self, way: Way) -> u64 {
        let number = self.numbers.entry(way).or_default();
        *number += 1;
        *number
    }

    fn send_some(&mut self) {
        let class = [Class::Control, Class::Stream, Class::Bulk][self.dice.below(3) as usize];
        let (way, tid) = self.somewhere(class);
        let count = u64::from(1 + self.dice.below(BATCH_MAX));
        let first = self.numbers.get(&way).copied().unwrap_or_default() + 1;
        self.tell(&Entry::Sends(way, first, count, Time::now()));
        for _ in 0..count {
            let number = self.next_number(way);
            let body = body(&mut self.dice, number);
            let life = self.life;
            let sent = match class {
                Class::Control => self.endpoint.send(tid, &Wire { life, number, body }),
                Class::Stream => self.endpoint.send(tid, &Card { life, number, body }),
                Class::Bulk => self.endpoint.send(tid, &Parcel { life, number, body }),
            };
            if let Err(error) = sent {
                self.was_not_sent(way, number, &error);
            }
        }
    }

    fn ask_one(&mut self) {
        let class = if self.dice.once_in(2) { Class::Control } else { Class::Bulk };
        let (mut way, mut tid) = self.somewhere(class);
        while !is_handler(way.to) && !self.dice.once_in(8) {
            (way, tid) = self.somewhere(class);
        }
        let number = self.next_number(way);
        let (life, body) = (self.life, body(&mut self.dice, number));
        let within = within(&mut self.dice);
        self.tell(&Entry::Asks(way, number, Time::now()));
        let outcome = if class == Class::Control {
            self.endpoint.message(tid, &Wire { life, number, body }).confirmed(within)
        } else {
            self.endpoint.message(tid, &Parcel { life, number, body }).confirmed(within)
        };
        match outcome {
            Ok(outcome) => self.tell(&Entry::Outcome(way, number, outcome)),
            Err(error) => self.was_not_sent(way, number, &error),
        }
    }

    fn was_not_sent(&self, way: Way, number: u64, error: &ApiError) {
        // Nothing else may happen while the node lives.
        let entry = match error {
            ApiError::Stalled(_) => Entry::NotSent(way, number),
            ApiError::Closed(_)
            | ApiError::Disconnected(_)
            | ApiError::NoNode { .. }
            | ApiError::NotAPath { .. }
            | ApiError::BadName { .. }
            | ApiError::Refused(_)
            | ApiError::Waiting { .. }
            | ApiError::NoAnswer(_)
            | ApiError::TooLong { .. }
            | ApiError::Ended(_)
            | ApiError::TooManyGroups
            | ApiError::NotSealed(_)
            | ApiError::NoReply(_)
            | ApiError::LoanActive
            | ApiError::NotYours(_)
            | ApiError::ToMany(_)
            | ApiError::UnknownName { .. }
            | ApiError::NotAsked
            | ApiError::OthersRequest(_)
            | ApiError::Malformed(_)
            | ApiError::Frame(_) => Entry::Broken(format!("number {number} to {way:?}: {error}")),
        };
        self.tell(&entry);
    }

    fn handle_some(&mut self, within: Duration) {
        for _ in 0..HANDLED_IN_A_ROW {
            match self.endpoint.receive(within) {
                Ok(Some(received)) => self.handle(received),
                Ok(None) => return,
                Err(error) => {
                    self.tell(&Entry::Broken(error.to_string()));
                    // It would be said again and again.
                    std::process::exit(1);
                }
            }
        }
    }

    fn handle(&mut self, received: Received) {
        let read = match received.class() {
            Class::Control => received.decode().map(|Wire { life, number, body }| (life, number, body)),
            Class::Stream => received.decode().map(|Card { life, number, body }| (life, number, body)),
            Class::Bulk => received.decode().map(|Parcel { life, number, body }| (life, number, body)),
        };
        let from = received.source().app.bits() - address(0).bits();
        match read {
            Ok((life, number, body)) if body.iter().all(|byte| *byte == number as u8) => {
                self.tell(&Entry::Got(from as Poster, life, received.class(), number));
            }
            Ok((life, number, _)) => {
                self.tell(&Entry::Broken(format!("{number} of {from} in life {life} has other bytes")));
            }
            Err(error) => self.tell(&Entry::Broken(format!("unreadable, from {from}: {error}"))),
        }
        if self.dice.once_in(64) {
            thread::sleep(self.dice.time_below(Duration::from_millis(3)));
        }
        if self.dice.once_in(16) {
            received.settle(Outcome::Rejected(Rejection::ByHandler));
        }
    }
}
