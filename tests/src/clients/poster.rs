//! The role of a poster process: 8 addresses that send to all others in every class, and report to the
//! tracker.
//!
//! Half of them wait for outcomes, the other half for messages. If all waited for outcomes, no message would
//! be handled.

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
    commands,
    entry::{Entry, Poster, Way},
    print_line,
    registration::{address, register, wishes},
};
use sinew_testkit::random::SeededRandom;

/// Posters per process.
pub(super) const POSTERS: Poster = 8;
/// Capacity of each queue. No queue may become full here: the tracker accounts for every message.
pub(super) const CAPACITY: usize = 65_536;
/// Maximum number of unconfirmed messages sent in a row.
const BATCH_MAX: u32 = 8;
/// Messages handled before the poster sends again.
const HANDLED_IN_A_ROW: u32 = 64;

/// The phase set by the scenario: posting, then quiet, then the end.
static STAGE: AtomicU8 = AtomicU8::new(POSTING);
const POSTING: u8 = 0;
const QUIET: u8 = 1;
const END: u8 = 2;

macro_rules! letter {
    ($type:ident, $name:literal, $class:ident) => {
        payload!($name, $class =>
            pub(super) struct $type {
                pub(super) incarnation: u32,
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

/// `SOCKET PROCESS INCARNATION POSTERS_IN_ALL SEED PAUSE_MS`
pub(super) fn run(arguments: &[String]) {
    let number = |index: usize| arguments[index].parse::<u64>().expect("a number");
    let (process, incarnation) = (number(1) as Poster, number(2) as u32);
    let all = number(3) as Poster;
    let api = NodeApi::connect(&arguments[0]).expect("the node accepts clients");
    for index in 0..POSTERS {
        let (api, me) = (api.clone(), process * POSTERS + index);
        let random = SeededRandom::new(number(4) ^ u64::from(me) << 40 ^ u64::from(incarnation) << 20);
        let pause = Duration::from_millis(number(5));
        thread::spawn(move || Letters::register(&api, me, all, incarnation, random).work(pause));
    }
    for order in commands() {
        assert_eq!(order, "quiet");
        be_quiet();
    }
    // The end of the process releases the addresses.
    STAGE.store(END, Ordering::Relaxed);
}

/// Returns whether a poster waits for messages rather than for outcomes.
const fn is_handler(poster: Poster) -> bool {
    poster.is_multiple_of(2)
}

/// Mostly small bodies; now and then one that is larger than a socket buffer and half a ring.
pub(super) fn body(random: &mut SeededRandom, number: u64) -> Vec<u8> {
    let length = match random.below(512) {
        0 => random.below(400_000),
        1..16 => random.below(20_000),
        _ => random.below(300),
    };
    vec![number as u8; length as usize]
}

/// Timeout for an outcome.
pub(super) fn within(random: &mut SeededRandom) -> Duration {
    Duration::from_millis(u64::from(5 + random.below(300)))
}

/// Returns whether this process is to send.
pub(super) fn is_posting() -> bool {
    STAGE.load(Ordering::Relaxed) == POSTING
}

/// Stops the posters of this process from sending.
pub(super) fn be_quiet() {
    STAGE.store(QUIET, Ordering::Relaxed);
}

struct Letters {
    endpoint: Endpoint,
    me: Poster,
    /// Number of all posters.
    all: Poster,
    incarnation: u32,
    random: SeededRandom,
    /// The last number for each destination and class.
    numbers: BTreeMap<Way, u64>,
}

impl Letters {
    fn register(api: &NodeApi, me: Poster, all: Poster, incarnation: u32, random: SeededRandom) -> Self {
        let registration = wishes().fixed_address(address(me)).inbox_capacity(CAPACITY);
        let endpoint = register(api, &registration);
        let this = Self { endpoint, me, all, incarnation, random, numbers: BTreeMap::new() };
        this.report(&Entry::Up(Time::now()));
        this
    }

    fn report(&self, entry: &Entry) {
        if let Entry::Broken(why) = entry {
            eprintln!("poster {} in incarnation {}: {why}", self.me, self.incarnation);
        }
        print_line(&format!("{} {entry}", self.me));
    }

    fn work(mut self, pause: Duration) {
        while is_posting() {
            if is_handler(self.me) || self.random.once_in(4) {
                self.send_some();
            } else {
                self.ask_one();
            }
            let within = self.random.time_below(pause);
            self.handle_some(within);
        }
        self.report(&Entry::Quiet);
        while STAGE.load(Ordering::Relaxed) != END {
            self.handle_some(Duration::from_millis(5));
        }
    }

    fn somewhere(&mut self, class: Class) -> (Way, Tid) {
        let other = (self.me + 1 + self.random.below(u32::from(self.all) - 1) as Poster) % self.all;
        let tid = Tid::new(self.endpoint.tid().node, address(other));
        (Way { to: other, class }, tid)
    }

    fn next_number(&mut self, way: Way) -> u64 {
        let number = self.numbers.entry(way).or_default();
        *number += 1;
        *number
    }

    fn send_some(&mut self) {
        let class = [Class::Control, Class::Stream, Class::Bulk][self.random.below(3) as usize];
        let (way, tid) = self.somewhere(class);
        let count = u64::from(1 + self.random.below(BATCH_MAX));
        let first = self.numbers.get(&way).copied().unwrap_or_default() + 1;
        self.report(&Entry::Sends(way, first, count, Time::now()));
        for _ in 0..count {
            let number = self.next_number(way);
            let body = body(&mut self.random, number);
            let incarnation = self.incarnation;
            let sent = match class {
                Class::Control => self.endpoint.send(tid, &Wire { incarnation, number, body }),
                Class::Stream => self.endpoint.send(tid, &Card { incarnation, number, body }),
                Class::Bulk => self.endpoint.send(tid, &Parcel { incarnation, number, body }),
            };
            if let Err(error) = sent {
                self.was_not_sent(way, number, &error);
            }
        }
    }

    fn ask_one(&mut self) {
        let class = if self.random.once_in(2) { Class::Control } else { Class::Bulk };
        let (mut way, mut tid) = self.somewhere(class);
        while !is_handler(way.to) && !self.random.once_in(8) {
            (way, tid) = self.somewhere(class);
        }
        let number = self.next_number(way);
        let (incarnation, body) = (self.incarnation, body(&mut self.random, number));
        let within = within(&mut self.random);
        self.report(&Entry::Asks(way, number, Time::now()));
        let outcome = if class == Class::Control {
            self.endpoint.message(tid, &Wire { incarnation, number, body }).confirmed(within)
        } else {
            self.endpoint.message(tid, &Parcel { incarnation, number, body }).confirmed(within)
        };
        match outcome {
            Ok(outcome) => self.report(&Entry::Outcome(way, number, outcome)),
            Err(error) => self.was_not_sent(way, number, &error),
        }
    }

    fn was_not_sent(&self, way: Way, number: u64, error: &ApiError) {
        // No other error may occur while the node runs.
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
        self.report(&entry);
    }

    fn handle_some(&mut self, within: Duration) {
        for _ in 0..HANDLED_IN_A_ROW {
            match self.endpoint.receive(within) {
                Ok(Some(received)) => self.handle(received),
                Ok(None) => return,
                Err(error) => {
                    self.report(&Entry::Broken(error.to_string()));
                    // Ends here, because the error would repeat forever.
                    std::process::exit(1);
                }
            }
        }
    }

    fn handle(&mut self, received: Received) {
        let read = match received.class() {
            Class::Control => {
                received.decode().map(|Wire { incarnation, number, body }| (incarnation, number, body))
            }
            Class::Stream => {
                received.decode().map(|Card { incarnation, number, body }| (incarnation, number, body))
            }
            Class::Bulk => {
                received.decode().map(|Parcel { incarnation, number, body }| (incarnation, number, body))
            }
        };
        let from = received.source().app.bits() - address(0).bits();
        match read {
            Ok((incarnation, number, body)) if body.iter().all(|byte| *byte == number as u8) => {
                self.report(&Entry::Got(from as Poster, incarnation, received.class(), number));
            }
            Ok((incarnation, number, _)) => {
                self.report(&Entry::Broken(format!(
                    "{number} of {from} in incarnation {incarnation} has other bytes"
                )));
            }
            Err(error) => self.report(&Entry::Broken(format!("unreadable, from {from}: {error}"))),
        }
        if self.random.once_in(64) {
            thread::sleep(self.random.time_below(Duration::from_millis(3)));
        }
        if self.random.once_in(16) {
            received.settle(Outcome::Rejected(Rejection::ByHandler));
        }
    }
}
