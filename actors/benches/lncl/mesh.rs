//! A full mesh: 64 addresses in eight processes, each of which sends to all others.

use std::{
    collections::HashMap,
    thread,
    time::{Duration, Instant},
};

use sinew::{Endpoint, Tid};
use sinew_figures::{
    Pinning,
    process::{Process, print_ready},
};
use sinew_runtime::wire::Kind;

use crate::{
    case::{Way, role},
    crowds::PACKET,
    ends::{DEADLINE, Home, register},
};

const PROCESSES: usize = 8;
const ADDRESSES: usize = 64;
/// Messages from each address to each other one before the time is taken, so that links are made.
const WARM_UP: usize = 32;
/// Rounds by which an address may be ahead of the slowest other one. At most `2 * AHEAD * 63` messages wait for an
/// address, and its queue at the node has room for 256.
const AHEAD: usize = 2;

const BLOCK: Kind = Kind::named("lncl.block");
const READY: Kind = Kind::named("lncl.ready");
const BEGIN: Kind = Kind::named("lncl.begin");
const DONE: Kind = Kind::named("lncl.done");

/// Messages a second of all addresses together, where each sends this number to each other one.
pub(crate) fn measure(way: Way, rounds: usize, pinning: Pinning) -> f64 {
    let home = Home::start(pinning);
    let mut leader = register(way, home.socket(), "leader");
    let role_of = |index| format!("{} {index} {rounds}", role("mesh", way, pinning, home.socket()));
    let _members: Vec<_> = (0..PROCESSES).map(|index| Process::start(&role_of(index))).collect();
    let all = each(&mut leader, READY);
    begin(&mut leader, &all);
    each(&mut leader, READY);
    let start = Instant::now();
    begin(&mut leader, &all);
    each(&mut leader, DONE);
    (ADDRESSES * (ADDRESSES - 1) * rounds) as f64 / start.elapsed().as_secs_f64()
}

/// Waits for a word of each address, and returns the addresses.
fn each(leader: &mut Endpoint, word: Kind) -> Vec<Tid> {
    let mut heard = Vec::new();
    while heard.len() < ADDRESSES {
        let received = leader.receive(DEADLINE).expect("the node lives").expect("all members are there");
        assert_eq!(received.kind(), word);
        heard.push(received.source());
    }
    heard
}

fn begin(leader: &mut Endpoint, all: &[Tid]) {
    all.iter().for_each(|member| say(leader, *member, BEGIN));
}

fn say(endpoint: &mut Endpoint, to: Tid, word: Kind) {
    let message = endpoint.create_message(to, word, 1).expect("short");
    endpoint.loaned(message).send().expect("it is taken");
}

/// One of the processes: its addresses, each with a thread.
pub(crate) fn take_part(way: Way, socket: &str, index: usize, rounds: usize) {
    let members = (0..ADDRESSES / PROCESSES).map(|number| {
        let (socket, number) = (socket.to_owned(), index * (ADDRESSES / PROCESSES) + number);
        thread::spawn(move || member(way, &socket, number, rounds))
    });
    let members: Vec<_> = members.collect();
    print_ready();
    members.into_iter().for_each(|member| member.join().expect("no member panics"));
}

/// An address of the mesh.
struct Member {
    endpoint: Endpoint,
    leader: Tid,
    others: Vec<Tid>,
    /// Blocks received from each other address so far.
    blocks: HashMap<Tid, usize>,
    /// Rounds sent so far.
    rounds: usize,
    /// Words to begin so far.
    begun: usize,
}

fn member(way: Way, socket: &str, number: usize, rounds: usize) {
    let mut endpoint = register(way, socket, &name(number));
    let mut find = |name: &str| endpoint.resolve(name, DEADLINE).expect("the node lives");
    let leader = find("leader").expect("it is registered");
    let deadline = Instant::now() + DEADLINE;
    let mut others = Vec::new();
    for other in (0..ADDRESSES).filter(|other| *other != number) {
        let found = loop {
            if let Some(found) = find(&name(other)) {
                break found;
            }
            assert!(Instant::now() < deadline, "waited for {}", name(other));
            thread::sleep(Duration::from_millis(1));
        };
        others.push(found);
    }
    let blocks = others.iter().map(|other| (*other, 0)).collect();
    let mut member = Member { endpoint, leader, others, blocks, rounds: 0, begun: 0 };
    member.play(1, WARM_UP);
    member.play(2, rounds);
    say(&mut member.endpoint, leader, DONE);
    // The address would go with this thread before the others have received all.
    while member.takes(DEADLINE) {}
}

fn name(number: usize) -> String {
    format!("member-{number}")
}

impl Member {
    /// Sends to all others and receives from all others, each this often, after the word to begin.
    fn play(&mut self, word: usize, rounds: usize) {
        say(&mut self.endpoint, self.leader, READY);
        while self.begun < word {
            assert!(self.takes(DEADLINE), "waited for the word to begin");
        }
        for _ in 0..rounds {
            self.rounds += 1;
            self.takes_rounds(self.rounds.saturating_sub(AHEAD));
            for index in 0..self.others.len() {
                let mut block =
                    self.endpoint.create_message(self.others[index], BLOCK, PACKET).expect("not too long");
                block.fill(7);
                self.endpoint.loaned(block).send().expect("the others read");
                while self.takes(Duration::ZERO) {}
            }
        }
        self.takes_rounds(self.rounds);
    }

    /// Receives until each other address has sent this number of rounds.
    fn takes_rounds(&mut self, rounds: usize) {
        while self.blocks.values().any(|blocks| *blocks < rounds) {
            assert!(self.takes(DEADLINE), "waited for the blocks of the others");
        }
    }

    /// Receives one message. Returns whether there was one.
    fn takes(&mut self, within: Duration) -> bool {
        let Some(received) = self.endpoint.receive(within).expect("the node lives") else { return false };
        if received.kind() == BLOCK {
            *self.blocks.get_mut(&received.source()).expect("it comes from one of the others") += 1;
        }
        self.begun += usize::from(received.kind() == BEGIN);
        true
    }
}
