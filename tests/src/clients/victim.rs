//! The role of a process that is killed: some addresses that send to everybody, and hold loans all the time.

use std::{
    collections::VecDeque,
    sync::atomic::{AtomicU16, Ordering},
    thread,
    time::Duration,
};

use sinew::{Endpoint, NodeApi, Tid, client::Received, message::Kind};

use super::{
    registration::{address, register, wishes},
    say,
    steady::{ECHO, SINK},
    told,
};
use crate::{
    dice::Dice,
    puppet::{Job, Order, Value},
};

/// Addresses of one process.
pub(super) const ADDRESSES: u16 = 4;
/// Messages in hand, at most.
const HELD_MAX: usize = 32;
/// How long a message is waited for, and lent memory held, at most.
const WHILE: Duration = Duration::from_millis(8);
/// What is written to memory that was lent and is never sent.
const SCRAP: &str = "victim.scrap";

/// `SOCKET PROCESSES SEED`: waits until it is told which of the processes it is.
pub(super) fn play(arguments: &[String]) {
    let number = |index: usize| arguments[index].parse::<u64>().expect("a number");
    say(&"waits");
    let Some(place) = told().next() else { return };
    let (process, processes) = (place.parse::<u16>().expect("a number"), number(1) as u16);
    let api = NodeApi::connect(&arguments[0]).expect("the door is open");
    for index in 0..ADDRESSES {
        let (api, me) = (api.clone(), process * ADDRESSES + index);
        let dice = Dice::new(number(2) ^ u64::from(me) << 40);
        thread::spawn(move || Victim::register(&api, me, processes * ADDRESSES, dice).work());
    }
    told().for_each(drop);
}

struct Victim {
    endpoint: Endpoint,
    others: Vec<Tid>,
    held: VecDeque<Received>,
    dice: Dice,
    number: u64,
    /// Until it has held both.
    says_so: bool,
}

impl Victim {
    fn register(api: &NodeApi, me: u16, all: u16, dice: Dice) -> Self {
        let mut endpoint = register(api, &wishes().fixed_address(address(me)));
        let node = endpoint.tid().node;
        let mut others: Vec<Tid> =
            (0..all).filter(|other| *other != me).map(|other| Tid::new(node, address(other))).collect();
        for name in [ECHO, SINK] {
            others.extend(endpoint.resolve(name, crate::DEADLINE).expect("the node answers"));
        }
        Self { endpoint, others, held: VecDeque::new(), dice, number: 0, says_so: true }
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
        self.others[self.dice.below(self.others.len() as u32) as usize]
    }

    fn send_one(&mut self) {
        let to = self.somewhere();
        self.number += 1;
        let number = self.number;
        let sent = match self.dice.below(8) {
            0 => self.endpoint.message(to, &Order { number }).confirmed(Duration::from_millis(2)).map(drop),
            1..3 => self.endpoint.send(to, &Order { number }),
            3..5 => self.endpoint.send(to, &Value { number }),
            _ => self.endpoint.send(to, &Job { number }),
        };
        if let Err(error) = sent {
            eprintln!("a victim cannot send: {error}");
        }
    }

    /// What it has in its hand: the oldest goes when there are too many.
    fn hold_some(&mut self) {
        let within = self.dice.time_below(WHILE);
        while let Some(received) = self.endpoint.receive(within).expect("the node lives") {
            self.held.push_back(received);
            if self.held.len() > HELD_MAX {
                self.held.pop_front();
                return;
            }
        }
    }

    /// Memory in the ring that was created, is written to, and is not sent.
    fn hold_a_loan(&mut self) {
        let (to, length) = (self.somewhere(), self.dice.below(20_000) as usize);
        let while_held = self.dice.time_below(WHILE);
        let mut loan = self.endpoint.create_message(to, Kind::named(SCRAP), length).expect("it is not long");
        loan.fill(0xAB);
        // A ring that is full for a moment lends nothing.
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
        say(&"holds");
    }
}
