//! The role of a process that is killed: some addresses that send to all others, and hold loans all the time.

use std::{
    collections::VecDeque,
    sync::atomic::{AtomicU16, Ordering},
    thread,
    time::Duration,
};

use sinew::{Endpoint, NodeApi, Tid, client::Received, message::Kind};

use super::{
    commands, print_line,
    registration::{address, register, wishes},
    steady::{ECHO, SINK},
};
use sinew_testkit::{
    random::SeededRandom,
    scripted::{Job, Order, Value},
};

/// Addresses per process.
pub(super) const ADDRESSES: u16 = 4;
/// Maximum number of messages held.
const HELD_MAX: usize = 32;
/// Maximum wait for a message, and maximum time that lent memory is held.
const WHILE: Duration = Duration::from_millis(8);
/// The kind written to lent memory that is never sent.
const SCRAP: &str = "victim.scrap";

/// `SOCKET PROCESSES SEED`: waits for its process number.
pub(super) fn run(arguments: &[String]) {
    let number = |index: usize| arguments[index].parse::<u64>().expect("a number");
    print_line(&"waits");
    let Some(place) = commands().next() else { return };
    let (process, processes) = (place.parse::<u16>().expect("a number"), number(1) as u16);
    let api = NodeApi::connect(&arguments[0]).expect("the node accepts clients");
    for index in 0..ADDRESSES {
        let (api, me) = (api.clone(), process * ADDRESSES + index);
        let random = SeededRandom::new(number(2) ^ u64::from(me) << 40);
        thread::spawn(move || Victim::register(&api, me, processes * ADDRESSES, random).work());
    }
    commands().for_each(drop);
}

struct Victim {
    endpoint: Endpoint,
    others: Vec<Tid>,
    held: VecDeque<Received>,
    random: SeededRandom,
    number: u64,
    /// Reports once, when it has held both kinds of loans.
    says_so: bool,
}

impl Victim {
    fn register(api: &NodeApi, me: u16, all: u16, random: SeededRandom) -> Self {
        let mut endpoint = register(api, &wishes().fixed_address(address(me)));
        let node = endpoint.tid().node;
        let mut others: Vec<Tid> =
            (0..all).filter(|other| *other != me).map(|other| Tid::new(node, address(other))).collect();
        for name in [ECHO, SINK] {
            others.extend(endpoint.resolve(name, sinew_testkit::DEADLINE).expect("the node answers"));
        }
        Self { endpoint, others, held: VecDeque::new(), random, number: 0, says_so: true }
    }

    fn work(mut self) {
        loop {
            for _ in 0..2 {
                self.send_one();
            }
            self.hold_some();
            self.hold_a_loan();
        }
    }

    fn somewhere(&mut self) -> Tid {
        self.others[self.random.below(self.others.len() as u32) as usize]
    }

    fn send_one(&mut self) {
        let to = self.somewhere();
        self.number += 1;
        let number = self.number;
        let sent = match self.random.below(8) {
            0 => self.endpoint.message(to, &Order { number }).confirmed(Duration::from_millis(2)).map(drop),
            1..3 => self.endpoint.send(to, &Order { number }),
            3..5 => self.endpoint.send(to, &Value { number }),
            _ => self.endpoint.send(to, &Job { number }),
        };
        if let Err(error) = sent {
            eprintln!("a victim cannot send: {error}");
        }
    }

    /// Holds messages; drops the oldest when there are too many.
    fn hold_some(&mut self) {
        let within = self.random.time_below(WHILE);
        while let Some(received) = self.endpoint.receive(within).expect("the node is alive") {
            self.held.push_back(received);
            if self.held.len() > HELD_MAX {
                self.held.pop_front();
                return;
            }
        }
    }

    /// Holds lent ring memory that is written to but not sent.
    fn hold_a_loan(&mut self) {
        let (to, length) = (self.somewhere(), self.random.below(20_000) as usize);
        let while_held = self.random.time_below(WHILE);
        let mut loan = self.endpoint.create_message(to, Kind::named(SCRAP), length).expect("it is not long");
        loan.fill(0xAB);
        // A ring that is temporarily full lends no memory.
        if self.says_so && loan.is_in_place() && !self.held.is_empty() {
            self.says_so = false;
            say_that_one_more_holds();
        }
        thread::sleep(while_held);
    }
}

fn say_that_one_more_holds() {
    static HOLDING: AtomicU16 = AtomicU16::new(0);
    if HOLDING.fetch_add(1, Ordering::Relaxed) + 1 == ADDRESSES {
        print_line(&"holds");
    }
}
