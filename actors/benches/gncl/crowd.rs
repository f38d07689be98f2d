//! The paper's Table 2: every node sends to every other one, 1000 bytes, and gets them back.
//!
//! The rate of all nodes together is the same however many they are, so that what a message costs can be compared: the time
//! that all their processes had a CPU, by the messages that arrived, there and back.

use std::{
    net::Ipv4Addr,
    sync::mpsc::{SyncSender, sync_channel},
    time::{Duration, Instant},
};

use rustix::time::{ClockId, clock_gettime};
use serde::{Deserialize, Serialize};
use sinew::prelude::*;
use sinew_figures::{
    Alone, Figures,
    process::{Process, await_end, say_there},
};

use crate::{nodes::At, ping::DEADLINE};

/// How many nodes there are.
pub(crate) const SIZES: [usize; 3] = [3, 8, 16];
/// Round trips of all nodes together, a second.
const RATE: u64 = 2_000;
/// Bytes of a packet.
const PACKET: usize = 1000;
/// Until connections stand and buffers are warm.
const WARM_UP: Duration = Duration::from_secs(2);
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
    /// Of the one that it answers.
    sent_ns: u64,
    #[serde(with = "serde_bytes")]
    block: Vec<u8>,
}

impl Payload for Back {
    const NAME: &'static str = "gncl.back";
}

/// What one node has seen.
struct Seen {
    figures: Figures,
    total_ns: u64,
    /// Of its process, while the others were counted.
    cpu: Duration,
}

struct Member {
    others: Vec<String>,
    next: usize,
    period: Duration,
    measured: Duration,
    clock: Instant,
    seen: Option<Seen>,
    done: SyncSender<Seen>,
}

impl Actor for Member {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        context
            .every(self.period, |member: &mut Self, _, context: &mut AppContext<Self>| member.ask(context));
        context.after(WARM_UP, |member: &mut Self, _, _| member.begin());
        context.after(WARM_UP + self.measured, |member: &mut Self, _, _| member.end());
    }
}

impl Member {
    fn ask(&mut self, context: &AppContext<Self>) {
        let name = &self.others[self.next % self.others.len()];
        self.next += 1;
        // Whose node is gone answers nothing, and is missing among the times.
        let _ = context.send(name.as_str(), &There { sent_ns: self.now_ns(), block: vec![7; PACKET] });
    }

    fn begin(&mut self) {
        self.seen = Some(Seen { figures: Figures::new(), total_ns: 0, cpu: cpu_time() });
    }

    fn end(&mut self) {
        if let Some(mut seen) = self.seen.take() {
            seen.cpu = cpu_time().saturating_sub(seen.cpu);
            self.done.send(seen).expect("somebody waits for it");
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
        // What is refused is missing among the times.
        let _ = context.send(there.source, &Back { sent_ns, block });
    }
}

impl Handler<Delivery<Back>> for Member {
    type Result = ();

    fn handle(&mut self, back: Delivery<Back>, _: &mut Self::Context) {
        let took = self.now_ns() - back.payload.sent_ns;
        std::hint::black_box(back.payload.block);
        if let Some(seen) = &mut self.seen {
            seen.figures.record(Duration::from_nanos(took));
            seen.total_ns += took;
        }
    }
}

/// The time that this process had a CPU, with all its threads.
fn cpu_time() -> Duration {
    let time = clock_gettime(ClockId::ProcessCPUTime);
    Duration::new(time.tv_sec as u64, time.tv_nsec as u32)
}

/// One of them, in a process of its own: hands over what it has seen.
pub(crate) fn member(index: usize, count: usize, seconds: u64, at: At) {
    let others: Vec<_> =
        (0..count).filter(|other| *other != index).map(|other| format!("echo-{other}")).collect();
    let echo = AppSpec::new(format!("echo-{index}"), || Echo).handles::<There>().on_io_thread();
    let required = others.clone();
    let (done, seen) = sync_channel(1);
    let make = move || Member {
        // Everybody begins with another one.
        next: index,
        others: others.clone(),
        period: Duration::from_nanos(1_000_000_000 * count as u64 / RATE),
        measured: Duration::from_secs(seconds),
        clock: Instant::now(),
        seen: None,
        done: done.clone(),
    };
    let member = AppSpec::new("member", make).handles::<Back>().requires(required).on_io_thread();
    let node = at.node(&format!("node-{index}")).app(echo).app(member).start().expect("a node");
    say_there();
    let seen = seen.recv_timeout(DEADLINE).expect("the rounds end");
    println!("{} {}", seen.total_ns, seen.cpu.as_nanos());
    seen.figures.hand_over();
    println!("end");
    // The others may not be through.
    await_end();
    node.stop();
}

/// So many of them, and the line of all together.
pub(crate) fn measure(count: usize, seconds: u64) {
    let at = At::loopback();
    let role = |index| {
        format!("member {index} {count} {seconds} {}", at.on(Ipv4Addr::new(127, 0, 1, index as u8 + 1)))
    };
    let members: Vec<_> = (0..count).map(|index| Process::start(&role(index))).collect();
    let (mut figures, mut total_ns, mut cpu_ns) = (Figures::new(), 0, 0);
    // All of them live until the last one has been heard.
    let mut heard = Vec::new();
    for mut member in members {
        let line = member.line();
        let (total, cpu) = line.split_once(' ').expect("a member hands over what it has seen");
        total_ns += number(total);
        cpu_ns += number(cpu);
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
        figures.add(&Figures::taken(&lines).expect("a member hands over its times"));
        heard.push(member);
    }
    let rounds = figures.rounds().max(1);
    let counts = [
        ("mean_ns", total_ns / rounds),
        ("paper_mean_ns", PAPER_MEAN_NS),
        ("cpu_ns_each_message", cpu_ns / (2 * rounds)),
        ("round_trips_per_s", rounds / seconds),
    ];
    let case = format!("table_2_{count}_nodes");
    Alone { bench: "gncl", case: &case, figure: "there and back", seen: &figures, counts: &counts }.report();
}

fn number(word: &str) -> u64 {
    word.parse().expect("a number that this program wrote itself")
}
