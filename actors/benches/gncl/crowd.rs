//! Table 2 of the paper: every node sends 1000 bytes to every other one, and receives them back.
//!
//! The total rate of all nodes is the same for every number of nodes, so that the costs of a message can be
//! compared. The cost is the CPU time of all processes divided by the number of messages that arrived, in
//! both directions. A rate of zero shows the cost of idle nodes.

use std::{
    net::Ipv4Addr,
    sync::mpsc::{SyncSender, sync_channel},
    time::{Duration, Instant},
};

use serde::{Deserialize, Serialize};
use sinew::prelude::*;
use sinew_figures::{
    Alone, Figures,
    process::{self, Process, await_end, print_ready},
};

use crate::{nodes::At, ping::DEADLINE};

/// How they are connected.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum By {
    Nodes,
    /// Bare TCP: [`crowd_raw`](crate::crowd_raw).
    Tcp,
}

/// How many nodes there are.
pub(crate) const SIZES: [usize; 3] = [3, 8, 16];
/// Round trips of all nodes together, a second.
pub(crate) const RATE: u64 = 2_000;
/// Bytes of a packet.
pub(crate) const PACKET: usize = 1000;
/// Time until connections are up and buffers are warm.
pub(crate) const WARM_UP: Duration = Duration::from_secs(2);
/// The paper's own mean there and back between three Raspberry Pis, in nanoseconds.
const PAPER_MEAN_NS: u64 = 552_600;

#[derive(Serialize, Deserialize)]
struct There {
    /// When it was sent, in nanoseconds of the sender's own.
    sent_ns: u64,
    #[serde(with = "serde_bytes")]
    block: Vec<u8>,
}

impl Payload for There {
    const NAME: &'static str = "gncl.there";
}

#[derive(Serialize, Deserialize)]
struct Back {
    /// Send time of the request that this message answers.
    sent_ns: u64,
    #[serde(with = "serde_bytes")]
    block: Vec<u8>,
}

impl Payload for Back {
    const NAME: &'static str = "gncl.back";
}

/// The task of one member.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Share {
    pub(crate) index: usize,
    pub(crate) count: usize,
    pub(crate) seconds: u64,
    /// Round trips of all together, a second.
    pub(crate) rate: u64,
}

impl Share {
    /// Period of a member's own requests.
    pub(crate) fn period(self) -> Option<Duration> {
        (self.count as u64 * 1_000_000_000).checked_div(self.rate).map(Duration::from_nanos)
    }
}

/// The results of one member.
pub(crate) struct Seen {
    figures: Figures,
    total_ns: u64,
    /// Of its process, while the others were counted.
    cpu: Duration,
    /// How often a thread of its process went to sleep meanwhile.
    sleeps: u64,
}

impl Seen {
    pub(crate) fn begin() -> Self {
        Self { figures: Figures::new(), total_ns: 0, cpu: process::cpu_time(), sleeps: process::sleeps() }
    }

    pub(crate) fn record(&mut self, took_ns: u64) {
        self.figures.record(Duration::from_nanos(took_ns));
        self.total_ns += took_ns;
    }

    pub(crate) fn end(mut self) -> Self {
        self.cpu = process::cpu_time().saturating_sub(self.cpu);
        self.sleeps = process::sleeps().saturating_sub(self.sleeps);
        self
    }
}

struct Member {
    others: Vec<String>,
    next: usize,
    period: Option<Duration>,
    measured: Duration,
    clock: Instant,
    seen: Option<Seen>,
    done: SyncSender<Seen>,
}

impl Actor for Member {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        if let Some(period) = self.period {
            context.every(period, |member: &mut Self, _, context: &mut AppContext<Self>| member.ask(context));
        }
        context.after(WARM_UP, |member: &mut Self, _, _| member.begin());
        context.after(WARM_UP + self.measured, |member: &mut Self, _, _| member.end());
    }
}

impl Member {
    fn ask(&mut self, context: &AppContext<Self>) {
        let name = &self.others[self.next % self.others.len()];
        self.next += 1;
        // An application on a stopped node does not answer; its round trip is missing among the times.
        let _ = context.send(name.as_str(), &There { sent_ns: self.now_ns(), block: vec![7; PACKET] });
    }

    fn begin(&mut self) {
        self.seen = Some(Seen::begin());
    }

    fn end(&mut self) {
        if let Some(seen) = self.seen.take() {
            self.done.send(seen.end()).expect("somebody waits for it");
        }
    }

    fn now_ns(&self) -> u64 {
        u64::try_from(self.clock.elapsed().as_nanos()).expect("a bench does not last for centuries")
    }
}

struct Echo;

impl Actor for Echo {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<There>> for Echo {
    type Result = ();

    fn handle(&mut self, there: Delivery<There>, context: &mut Self::Context) {
        let There { sent_ns, block } = there.payload;
        // A refused reply is missing among the times.
        let _ = context.send(there.source, &Back { sent_ns, block });
    }
}

impl Handler<Delivery<Back>> for Member {
    type Result = ();

    fn handle(&mut self, back: Delivery<Back>, _: &mut Self::Context) {
        let took = self.now_ns() - back.payload.sent_ns;
        std::hint::black_box(back.payload.block);
        if let Some(seen) = &mut self.seen {
            seen.record(took);
        }
    }
}

/// One member, in its own process: writes its results to the standard output.
pub(crate) fn member(share: Share, at: At) {
    let Share { index, count, seconds, .. } = share;
    let others: Vec<_> =
        (0..count).filter(|other| *other != index).map(|other| format!("echo-{other}")).collect();
    let echo = AppSpec::new(format!("echo-{index}"), || Echo).handles::<There>().on_io_thread();
    let required = others.clone();
    let (done, seen) = sync_channel(1);
    let make = move || Member {
        // Each member starts with a different peer.
        next: index,
        others: others.clone(),
        period: share.period(),
        measured: Duration::from_secs(seconds),
        clock: Instant::now(),
        seen: None,
        done: done.clone(),
    };
    let member = AppSpec::new("member", make).handles::<Back>().requires(required).on_io_thread();
    let node = at.node(&format!("node-{index}")).app(echo).app(member).start().expect("a node");
    print_ready();
    hand_over(seen.recv_timeout(DEADLINE).expect("the rounds end"));
    node.stop();
}

/// Writes the results to the standard output, and waits until all members have done so.
pub(crate) fn hand_over(seen: Seen) {
    println!("{} {} {} {}", seen.total_ns, seen.cpu.as_nanos(), seen.sleeps, resident_kib());
    if seen.figures.rounds() > 0 {
        seen.figures.hand_over();
    }
    println!("end");
    // The others may not be through.
    await_end();
}

/// Resident memory of this process in KiB; 0 if the system does not report it.
fn resident_kib() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    line.and_then(|line| line.split_whitespace().next()?.parse().ok()).unwrap_or(0)
}

/// The results of all members.
#[derive(Default)]
struct Sum {
    figures: Figures,
    total_ns: u64,
    cpu_ns: u64,
    sleeps: u64,
    resident_kib_max: u64,
}

impl Sum {
    fn add(&mut self, member: &mut Process) {
        let line = member.line();
        let numbers: Vec<u64> = line.split(' ').map(number).collect();
        let [total_ns, cpu_ns, sleeps, resident_kib] = numbers[..] else {
            panic!("a member hands over what it has seen");
        };
        self.total_ns += total_ns;
        self.cpu_ns += cpu_ns;
        self.sleeps += sleeps;
        self.resident_kib_max = self.resident_kib_max.max(resident_kib);
        let mut lines = String::new();
        loop {
            let line = member.line();
            assert!(!line.is_empty(), "a member failed");
            if line == "end" {
                break;
            }
            lines += &line;
            lines.push('\n');
        }
        if !lines.is_empty() {
            self.figures.add(&Figures::taken(&lines).expect("a member hands over its times"));
        }
    }
}

/// All of them together, and their line.
pub(crate) fn measure(case: &str, by: By, share: Share) {
    let Share { count, seconds, rate, .. } = share;
    let at = At::loopback();
    let role = |index: usize| match by {
        By::Nodes => {
            let at = at.on(Ipv4Addr::new(127, 0, 1, index as u8 + 1));
            format!("member {index} {count} {seconds} {rate} {at}")
        }
        By::Tcp => format!("raw_member {index} {count} {seconds} {rate} {}", at.port()),
    };
    let mut members: Vec<_> = (0..count).map(|index| Process::start(&role(index))).collect();
    let mut sum = Sum::default();
    // All members live until the last result is read.
    members.iter_mut().for_each(|member| sum.add(member));
    if rate == 0 { sum.report_rest(case, share) } else { sum.report(case, share) }
}

impl Sum {
    fn report(&self, case: &str, share: Share) {
        let rounds = self.figures.rounds().max(1);
        let counts = [
            ("mean_ns", self.total_ns / rounds),
            ("paper_mean_ns", PAPER_MEAN_NS),
            ("cpu_ns_each_message", self.cpu_ns / (2 * rounds)),
            ("sleeps_each_1000_messages", 1_000 * self.sleeps / (2 * rounds)),
            ("round_trips_per_s", rounds / share.seconds),
        ];
        Alone { bench: "gncl", case, figure: "there and back", seen: &self.figures, counts: &counts }
            .report();
    }

    /// Reports a run without messages.
    fn report_rest(&self, case: &str, share: Share) {
        let mut seen = Figures::new();
        let nodes_and_seconds = share.count as u64 * share.seconds;
        seen.record(Duration::from_nanos(self.cpu_ns / nodes_and_seconds));
        let counts =
            [("sleeps_per_s", self.sleeps / nodes_and_seconds), ("resident_kib_max", self.resident_kib_max)];
        Alone { bench: "gncl", case, figure: "CPU of a node each second", seen: &seen, counts: &counts }
            .report();
    }
}

fn number(word: &str) -> u64 {
    word.parse().expect("a number that this program wrote itself")
}
