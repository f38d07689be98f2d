//! Many messages at once: eight senders to one receiver, maximum throughput, and Control beside a flood of Bulk.

use std::{
    thread,
    time::{Duration, Instant},
};

use sinew_figures::{
    Figures, Pinning,
    process::{Process, print_ready},
};
use sinew_runtime::{
    time::Time,
    wire::{Class, Kind},
};

use crate::{
    case::{Way, role},
    ends::{DEADLINE, Home, register},
};

/// Bytes of a packet.
pub(crate) const PACKET: usize = 1000;
/// Maximum number of packets of a flood in flight.
pub(crate) const WINDOW: u64 = 128;
/// Number of packets of a flood that are acknowledged together.
pub(crate) const ANSWERED_EACH: u64 = 32;
/// Number of sending processes.
pub(crate) const SENDERS: usize = 8;

const BLOCK: Kind = Kind::named("lncl.block");
const ANSWER: Kind = Kind::named("lncl.answer");
const BEGIN: Kind = Kind::named("lncl.begin");
const COMMAND: Kind = Kind::named("lncl.command");
/// Bytes of a command.
pub(crate) const COMMAND_BYTES: usize = 64;

/// How old packets were when they were received.
pub(crate) struct Ages {
    pub(crate) figures: Figures,
    mean_ns: u64,
    first_ns: u64,
}

impl Ages {
    /// Of these ages in nanoseconds.
    pub(crate) fn of(ages: &[u64]) -> Self {
        let mut figures = Figures::new();
        ages.iter().for_each(|age| figures.record(Duration::from_nanos(*age)));
        let mean_ns = ages.iter().sum::<u64>() / ages.len().max(1) as u64;
        Self { figures, mean_ns, first_ns: ages.first().copied().unwrap_or_default() }
    }

    pub(crate) fn mean_us(&self) -> f64 {
        self.mean_ns as f64 / 1_000.0
    }

    pub(crate) fn first_us(&self) -> f64 {
        self.first_ns as f64 / 1_000.0
    }
}

/// Sends this number of packets, one every millisecond on a fixed grid.
pub(crate) fn paced(packets: u64, mut send: impl FnMut()) {
    let mut next = Instant::now();
    for _ in 0..packets {
        next += Duration::from_millis(1);
        thread::sleep(next.saturating_duration_since(Instant::now()));
        send();
    }
}

/// Ages of the packets that eight processes send to one, and the number of lost packets.
pub(crate) fn fan_in(way: Way, packets: u64, pinning: Pinning) -> (Figures, u64) {
    let home = Home::start(pinning);
    let mut endpoint = register(way, home.socket(), "sink");
    let role = format!("{} {packets}", role("sender", way, pinning, home.socket()));
    let senders: Vec<_> = (0..SENDERS).map(|_| Process::start(&role)).collect();
    let expected = packets * SENDERS as u64;
    // Each sender has sent its first packet, a request to start. All are there now, so they may start.
    let mut waiting = Vec::new();
    while waiting.len() < SENDERS {
        let asks = endpoint.receive(DEADLINE).expect("the node lives").expect("the senders are there");
        waiting.push(asks.source());
    }
    for sender in waiting {
        let begin = endpoint.create_message(sender, BEGIN, 1).expect("short");
        endpoint.loaned(begin).send().expect("the node takes it");
    }
    let mut figures = Figures::new();
    while figures.rounds() < expected {
        let Some(packet) = endpoint.receive(DEADLINE).expect("the node lives") else { break };
        figures.record(packet.age(Time::now()).expect("of this host"));
    }
    drop(senders);
    let lost = expected - figures.rounds();
    (figures, lost)
}

/// One of the eight senders.
pub(crate) fn send(way: Way, socket: &str, packets: u64) {
    let mut endpoint = register(way, socket, &format!("sender-{}", std::process::id()));
    print_ready();
    let sink = endpoint.resolve("sink", DEADLINE).expect("the node lives").expect("it is registered");
    let asks = endpoint.create_message(sink, BEGIN, 1).expect("short");
    endpoint.loaned(asks).send().expect("the node takes it");
    let _begin = endpoint.receive(DEADLINE).expect("the node lives").expect("the word to begin");
    paced(packets, || {
        let mut packet = endpoint.create_message(sink, BLOCK, PACKET).expect("not too long");
        packet.fill(7);
        endpoint.loaned(packet).send().expect("the node takes it");
    });
    // The address would go with this process before all is received.
    let _none = endpoint.receive(DEADLINE);
}

/// The times from the first packet of each 32 to their answer, and how many packets went through a second.
pub(crate) fn flood(way: Way, packets: u64, pinning: Pinning) -> (Figures, f64) {
    let home = Home::start(pinning);
    let _sink = Process::start(&role("sink", way, pinning, home.socket()));
    let mut endpoint = register(way, home.socket(), "flood");
    let sink = endpoint.resolve("sink", DEADLINE).expect("the node lives").expect("it is registered");
    let (mut figures, mut answered, mut begun) = (Figures::new(), 0, Vec::new());
    let start = Instant::now();
    let mut sent = 0;
    while answered < packets {
        if sent < packets && sent - answered < WINDOW {
            if sent.is_multiple_of(ANSWERED_EACH) {
                begun.push(Instant::now());
            }
            let mut packet = endpoint.create_message(sink, BLOCK, PACKET).expect("not too long");
            packet.fill(7);
            endpoint.loaned(packet).send().expect("the node takes it");
            sent += 1;
        } else {
            let _answer = endpoint.receive(DEADLINE).expect("the node lives").expect("the sink answers");
            figures.record(begun[(answered / ANSWERED_EACH) as usize].elapsed());
            answered += ANSWERED_EACH;
        }
    }
    (figures, packets as f64 / start.elapsed().as_secs_f64())
}

/// The sink of a flood: until the measuring end ends this process.
pub(crate) fn sink(way: Way, socket: &str) {
    let (mut endpoint, mut taken) = (register(way, socket, "sink"), 0_u64);
    print_ready();
    while let Some(packet) = endpoint.receive(DEADLINE).expect("the node lives") {
        taken += 1;
        let source = packet.source();
        drop(packet);
        if taken.is_multiple_of(ANSWERED_EACH) {
            let answer = endpoint.create_message(source, ANSWER, 8).expect("short");
            endpoint.loaned(answer).send().expect("the node takes it");
        }
    }
}

/// Whether Bulk is sent beside the commands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Flood {
    None,
    Bulk,
}

/// Round trips of commands of class Control, one every millisecond, from the call of `send` to the answer.
pub(crate) fn commands(way: Way, flood: Flood, rounds: u64, pinning: Pinning) -> Figures {
    let home = Home::start(pinning);
    let _sink = Process::start(&role("commanded", way, pinning, home.socket()));
    let mut endpoint = register(way, home.socket(), "commander");
    let sink = endpoint.resolve("sink", DEADLINE).expect("the node lives").expect("it is registered");
    let (mut figures, mut sent_at, mut next) = (Figures::new(), None, Instant::now());
    while figures.rounds() < rounds {
        if sent_at.is_none() && Instant::now() >= next {
            let command = endpoint.create_message(sink, COMMAND, COMMAND_BYTES).expect("short");
            sent_at = Some(Instant::now());
            endpoint.loaned(command).class(Class::Control).send().expect("the sink reads");
        }
        if flood == Flood::Bulk {
            let mut packet = endpoint.create_message(sink, BLOCK, PACKET).expect("not too long");
            packet.fill(7);
            endpoint.loaned(packet).class(Class::Bulk).send().expect("the sink reads");
        }
        let within = match (flood, sent_at) {
            (Flood::Bulk, _) => Duration::ZERO,
            (Flood::None, Some(_)) => DEADLINE,
            (Flood::None, None) => next.saturating_duration_since(Instant::now()),
        };
        if endpoint.receive(within).expect("the node lives").is_some() {
            let sent_at = sent_at.take().expect("one answer for each command");
            figures.record(sent_at.elapsed());
            next += Duration::from_millis(1);
        }
    }
    figures
}

/// Answers commands, and drops everything else: until the measuring end ends this process.
pub(crate) fn answer_commands(way: Way, socket: &str) {
    let mut endpoint = register(way, socket, "sink");
    print_ready();
    while let Some(received) = endpoint.receive(DEADLINE).expect("the node lives") {
        if received.kind() == COMMAND {
            let answer = endpoint.create_message(received.source(), COMMAND, COMMAND_BYTES).expect("short");
            endpoint.loaned(answer).class(Class::Control).send().expect("the commander reads");
        }
    }
}
