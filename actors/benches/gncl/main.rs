//! The cost of messages between two nodes: round trips, floods, many nodes, and one class beside another.
//!
//! `cargo bench -p sinew --bench gncl [-- [--short] WORD...]` runs the cases that have every WORD in their
//! names, in fresh processes, each with one node. The standard output has JSON lines, the standard error a
//! table. Times are microseconds per round trip. Nothing here asserts a time. `--short` runs a tenth.
//!
//! - `rounds-THREAD-BYTES-PACE-CPUS`: round trips of 8 B, 64 B, 1000 B, 64 KiB and 1 MB in class Control,
//!   back to back and one every millisecond. The applications are on their nodes' IO threads (also with
//!   `gncl.spin`) or on their own threads. The reference is blocking TCP. `sleeps` is the number of sleeps of
//!   a thread of either process per message that another thread had to end.
//! - `flood-CARRIER-CPUS`: one-way packets of 1000 bytes in class Bulk, as fast as possible, confirmed or
//!   not, and over bare TCP, with one write for each packet and one for 32. `cpu_ns_each_message` is the CPU time
//!   of the sending process per packet, `cpu_ns_each_message_there` that of the receiving one. The number of
//!   packets is fixed: 1,000,000, or 100,000 with `--short`.
//! - `secured-rounds-..`, `secured-flood-..`: the same between nodes with keys (TLS 1.3), beside nodes
//!   without. `secured-handshake`: the time until both ends of a connection have authenticated each other.
//! - `table_2-N`: the paper's test. Every node sends 1000 bytes to every other one with a full echo: 3, 8 and
//!   16 nodes, together 2,000 round trips a second. `cpu_ns_each_message` is the CPU time of all processes
//!   per received message, `sleeps_each_1000_messages` the number of sleeps of their threads.
//!   `table_2_raw_tcp-N`: the same over bare TCP, one thread per process.
//! - `idle-N`: N connected nodes without traffic.
//! - `control_beside_bulk_N`: round trips of 64 bytes in class Control, one every millisecond, first alone.
//!   Then they run beside a flood of N-byte Bulk messages to another application of the other node, as fast
//!   as it takes them. The result is the p99 beside the flood divided by the p99 alone (`p99_ratio_percent`).
//!   The reference is bare TCP: a connection beside another one on which as many bytes are written at once.
//! - `control_beside_slow_consumer`: the same between nodes, and the flooded application takes a millisecond
//!   for each message.
//! - `stream_by_WAY-CHANNELS`: one-way values of class Stream, one every millisecond on each of 1, 16 and 64
//!   channels, by datagrams and by the connection (`gncl.datagrams`). The result is the age of values when
//!   they are handled. `cpu_ns_each_value` is the CPU time of both processes per value. `acks_per_s` counts
//!   the datagrams that this host sent besides the handled values (acknowledgements, retransmissions, a few
//!   of NDL's). `superseded` counts measured values that did not arrive. `superseded_on_the_way_with_warm_up`
//!   and `superseded_in_mailboxes_with_warm_up` state where newer ones replaced them, over all sent values.
//!   `--bench stream_allocations` counts memory allocations.
//! - `rest_raw_tcp`: the first 1000 bytes after a pause over bare TCP, on an open connection and on a new one
//!   with a handshake.
//! - `slow_link`: the same as `control_beside_bulk_1000`, and bare TCP, on two hosts with a link of 10 Mbit/s
//!   between them (network namespaces: needs root, `ip` and `tc`). `slow_link_priorities`: the hosts send
//!   queued packets by priority.

mod beside;
mod beside_raw;
mod crowd;
mod crowd_raw;
mod flood;
mod keys;
mod nodes;
#[path = "../ping/mod.rs"]
mod ping;
mod rest;
mod rounds;
mod slow_link;
mod stream_ends;
mod stream_ways;

use std::{
    net::{Ipv4Addr, SocketAddrV4},
    process::ExitCode,
    time::Duration,
};

use sinew_figures::{Asked, Beside, End, Pace, Pinning, Rounds, process};
use sinew_testkit::Queue;

use crate::{
    crowd::{By, Share},
    flood::Carrier,
    nodes::At,
    rounds::Thread,
    stream_ends::{By as Way, Plan},
};

/// A measurement.
#[derive(Clone, Copy, Debug)]
enum Case {
    Rounds {
        thread: Thread,
        rounds: Rounds,
        pinning: Pinning,
    },
    Flood {
        carrier: Carrier,
        packets: usize,
        pinning: Pinning,
    },
    Crowd {
        by: By,
        nodes: usize,
        seconds: u64,
        /// Round trips of all together, a second.
        rate: u64,
    },
    /// The size of a flood message, and the time that its receiver takes for each.
    Beside {
        name: &'static str,
        bulk_bytes: usize,
        pause_us: u64,
        rounds: u64,
    },
    /// Values of class Stream.
    Stream(Plan),
    /// First messages after a pause: this number of each kind.
    Rest(u64),
    SlowLink(Queue),
    /// Between nodes with keys, beside nodes without.
    Secured(Secured),
}

#[derive(Clone, Copy, Debug)]
enum Secured {
    Rounds { thread: Thread, rounds: Rounds, pinning: Pinning },
    Flood { carrier: Carrier, packets: usize, pinning: Pinning },
    Handshakes(usize),
}

impl Case {
    /// Every case, in the order in which they run.
    fn all(is_short: bool) -> Vec<Self> {
        let part = if is_short { 10 } else { 1 };
        let mut cases = Vec::new();
        for pinning in Pinning::ALL {
            for (bytes, pace) in payloads(is_short) {
                let rounds = Rounds::of(bytes, pace, is_short);
                let threads = Thread::ALL.into_iter();
                let threads = threads.filter(|thread| !(thread.spins() && pinning == Pinning::OneCpu));
                cases.extend(threads.map(|thread| Self::Rounds { thread, rounds, pinning }));
            }
        }
        for pinning in [Pinning::Anywhere, Pinning::OneCpuEach] {
            cases.extend(Carrier::ALL.map(|carrier| Self::Flood {
                carrier,
                packets: 1_000_000 / part,
                pinning,
            }));
        }
        let seconds = if is_short { 3 } else { 20 };
        let crowd = |by, nodes, rate| Self::Crowd { by, nodes, seconds, rate };
        for nodes in crowd::SIZES {
            cases.extend([By::Nodes, By::Tcp].map(|by| crowd(by, nodes, crowd::RATE)));
        }
        cases.extend([4, 16].map(|nodes| crowd(By::Nodes, nodes, 0)));
        let beside = [
            ("control_beside_bulk_1000", 1_000, 0),
            ("control_beside_bulk_65536", 65_536, 0),
            ("control_beside_bulk_1000000", 1_000_000, 0),
            ("control_beside_slow_consumer", 1_000, 1_000),
        ];
        let rounds = 4_000 / part as u64;
        cases.extend(beside.map(|(name, bulk_bytes, pause_us)| Self::Beside {
            name,
            bulk_bytes,
            pause_us,
            rounds,
        }));
        let values = 10_000 / part as u64;
        for channels in stream_ways::CHANNELS {
            cases.extend(Way::ALL.map(|by| Self::Stream(Plan { by, channels, values })));
        }
        cases.push(Self::Rest(200 / part as u64));
        cases.extend([Queue::OneLine, Queue::Priorities].map(Self::SlowLink));
        cases.extend(Secured::all(is_short).into_iter().map(Self::Secured));
        cases
    }

    fn name(self) -> String {
        match self {
            Self::Rounds { thread, rounds: Rounds { bytes, pace, .. }, pinning } => {
                format!("rounds-{}-{bytes}B-{}-{}", thread.name(), pace.name(), pinning.name())
            }
            Self::Flood { carrier, pinning, .. } => format!("flood-{}-{}", carrier.name(), pinning.name()),
            Self::Crowd { nodes, rate: 0, .. } => format!("idle-{nodes}"),
            Self::Crowd { by: By::Nodes, nodes, .. } => format!("table_2-{nodes}"),
            Self::Crowd { by: By::Tcp, nodes, .. } => format!("table_2_raw_tcp-{nodes}"),
            Self::Beside { name, .. } => name.to_owned(),
            Self::Stream(Plan { by, channels, .. }) => format!("stream_by_{}-{channels}", by.name()),
            Self::Rest(_) => "rest_raw_tcp".to_owned(),
            Self::SlowLink(Queue::OneLine) => "slow_link".to_owned(),
            Self::SlowLink(Queue::Priorities) => "slow_link_priorities".to_owned(),
            Self::Secured(Secured::Rounds { thread, rounds, pinning }) => {
                format!("secured-{}", Self::Rounds { thread, rounds, pinning }.name())
            }
            Self::Secured(Secured::Flood { carrier, packets, pinning }) => {
                format!("secured-{}", Self::Flood { carrier, packets, pinning }.name())
            }
            Self::Secured(Secured::Handshakes(_)) => "secured-handshake".to_owned(),
        }
    }

    /// Runs it in a process of its own. Returns whether that went well.
    fn run(self, is_short: bool) -> bool {
        let worked = process::has_run(process::command(&format!("measure {is_short} {}", self.name())));
        if !worked {
            eprintln!("{}: failed", self.name());
        }
        worked
    }

    /// Returns whether that went well.
    fn measure(self) -> bool {
        match self {
            Self::Rounds { thread, rounds, pinning } => {
                pinning.pin(End::Measuring);
                rounds::measure(thread, rounds, pinning);
            }
            Self::Flood { carrier, packets, pinning } => {
                pinning.pin(End::Measuring);
                flood::measure(carrier, packets, pinning, false);
            }
            Self::Crowd { by, nodes: count, seconds, rate } => {
                crowd::measure(&self.name(), by, Share { index: 0, count, seconds, rate });
            }
            Self::Beside { name, bulk_bytes, pause_us, rounds } => {
                let at = At::loopback();
                let _other = process::Process::start(&format!("beside_echo {pause_us} {}", at.host(2)));
                beside::measure(name, at, bulk_bytes, rounds);
                // No reference here: a TCP stream stalls if its reader takes a message a millisecond.
                if pause_us == 0 {
                    let raw = SocketAddrV4::new(Ipv4Addr::LOCALHOST, at.port());
                    let _other = process::Process::start(&format!("beside_raw_echo {raw}"));
                    beside_raw::measure(name, raw, bulk_bytes, [rounds; 2]);
                }
            }
            Self::Stream(plan) => stream_ways::measure(&self.name(), plan),
            Self::Rest(count) => {
                let raw = SocketAddrV4::new(Ipv4Addr::LOCALHOST, At::loopback().port());
                let _other = process::Process::start(&format!("rest_echo {raw}"));
                rest::measure(raw, count);
            }
            Self::SlowLink(queue) => return slow_link::measure(&self.name(), queue),
            Self::Secured(secured) => secured.measure(),
        }
        true
    }
}

impl Secured {
    fn all(is_short: bool) -> Vec<Self> {
        let part = if is_short { 10 } else { 1 };
        let mut cases = Vec::new();
        for pinning in [Pinning::OneCpu, Pinning::OneCpuEach] {
            for (bytes, pace) in payloads(is_short) {
                let rounds = Rounds::of(bytes, pace, is_short);
                cases.extend([Thread::Io, Thread::Own].map(|thread| Self::Rounds {
                    thread,
                    rounds,
                    pinning,
                }));
            }
        }
        let (packets, pinning) = (1_000_000 / part, Pinning::OneCpuEach);
        let carriers = [Carrier::Confirmed, Carrier::Unconfirmed];
        cases.extend(carriers.map(|carrier| Self::Flood { carrier, packets, pinning }));
        cases.push(Self::Handshakes(2_000 / part));
        cases
    }

    fn measure(self) {
        match self {
            Self::Rounds { thread, rounds, pinning } => {
                pinning.pin(End::Measuring);
                rounds::measure_secured(thread, rounds, pinning);
            }
            Self::Flood { carrier, packets, pinning } => {
                pinning.pin(End::Measuring);
                for is_secured in [true, false] {
                    flood::measure(carrier, packets, pinning, is_secured);
                }
            }
            Self::Handshakes(count) => keys::measure_handshakes(count),
        }
    }
}

/// The payload sizes, and the pace of their round trips.
fn payloads(is_short: bool) -> Vec<(usize, Pace)> {
    let mut payloads = vec![(1000, Pace::BackToBack), (1000, Pace::EveryMillisecond)];
    if !is_short {
        let others = [8, 64, 65_536, 1_000_000];
        payloads.extend(others.into_iter().flat_map(|bytes| Pace::ALL.map(|pace| (bytes, pace))));
    }
    payloads
}

fn main() -> ExitCode {
    if let Some(role) = process::role() {
        return play(&role);
    }
    let asked = Asked::read(include_str!("main.rs"), &["--short"]);
    let is_short = asked.is_short();
    let wanted = asked.wanted(Case::all(is_short), |case| case.name());
    sinew_figures::head();
    Beside::head();
    let failed = wanted.into_iter().filter(|case| !case.run(is_short)).count();
    if failed == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

/// Runs the role that another process of this program assigned to this one.
fn play(role: &str) -> ExitCode {
    let words: Vec<&str> = role.split(' ').collect();
    match words[..] {
        ["measure", is_short, name] => {
            let case = Case::all(is_short == "true").into_iter().find(|case| case.name() == name);
            if !case.expect("a name that this program wrote itself").measure() {
                return ExitCode::FAILURE;
            }
        }
        ["echo", thread, pinning, at] => {
            Pinning::named(pinning).pin(End::Echoing);
            rounds::echo(Thread::named(thread), At::read(at));
        }
        ["raw_echo", bytes, pinning] => {
            Pinning::named(pinning).pin(End::Echoing);
            sinew_figures::stream::echo(number(bytes));
        }
        ["sink", carrier, packets, pinning, at] => {
            Pinning::named(pinning).pin(End::Echoing);
            flood::sink(Carrier::named(carrier), number(packets), At::read(at));
        }
        ["member", index, count, seconds, rate, at] => {
            crowd::member(share(index, count, seconds, rate), At::read(at));
        }
        ["raw_member", index, count, seconds, rate, port] => {
            crowd_raw::member(share(index, count, seconds, rate), number(port) as u16);
        }
        ["beside_echo", pause_us, at] => {
            beside::echo(At::read(at), Duration::from_micros(number(pause_us) as u64));
        }
        ["stream_take", by, channels, values, at] => {
            let by = Way::ALL.into_iter().find(|way| way.name() == by);
            let by = by.expect("a name that this program wrote itself");
            let plan = Plan { by, channels: number(channels), values: number(values) as u64 };
            stream_ways::take(plan, At::read(at));
        }
        ["slow_nodes", case, at] => slow_link::nodes(case, At::read(at)),
        ["beside_raw_echo", address] => beside_raw::echo(address.parse().expect("an address of ours")),
        ["rest_echo", address] => rest::echo(address.parse().expect("an address of ours")),
        ["slow_raw", case, address] => slow_link::raw(case, address.parse().expect("an address of ours")),
        _ => {
            eprintln!("no such role: {role}");
            return ExitCode::FAILURE;
        }
    }
    ExitCode::SUCCESS
}

fn share(index: &str, count: &str, seconds: &str, rate: &str) -> Share {
    let (seconds, rate) = (number(seconds) as u64, number(rate) as u64);
    Share { index: number(index), count: number(count), seconds, rate }
}

fn number(word: &str) -> usize {
    word.parse().expect("a number that this program wrote itself")
}
