//! A flood: packets of 1000 bytes one way, as fast as they go, until the last one is there.

use std::{
    collections::VecDeque,
    io::{BufReader, Read, Write},
    os::unix::net::UnixStream,
    process::Stdio,
    sync::{
        atomic::{AtomicU64, Ordering},
        mpsc::{SyncSender, sync_channel},
    },
    time::Instant,
};

use sinew::{Confirmation, prelude::*};
use sinew_figures::{
    Alone, Figures, Pinning,
    process::{Process, await_end, command, say_there},
    stream,
};
use zenoh::Wait;

use crate::{
    DEADLINE,
    nodes::{self, Back, There},
    zenoh as peer,
};

/// Bytes of a packet.
const PACKET: usize = 1000;
/// The first byte of a packet that counts; another one only says that somebody is there.
const COUNTS: u8 = 7;
/// Confirmed packets of Sinew's that are under way at most: as many as a mailbox holds of which nothing was said.
const UNDER_WAY: usize = 256;
/// Runs of each case.
const RUNS: usize = 5;

/// What carries the packets: TCP with a length before each; zenoh, reliable, batching as it likes; Sinew from application
/// to application on threads of their own, each packet confirmed.
const CARRIERS: [&str; 3] = ["tcp", "zenoh", "sinew_confirmed"];

/// Runs every case whose name holds every word.
pub(crate) fn run(is_short: bool, words: &[String]) {
    let packets = if is_short { 100_000 } else { 1_000_000 };
    sinew_figures::head();
    for pinning in [Pinning::Anywhere, Pinning::OneCpuEach] {
        for carrier in CARRIERS {
            let name = format!("flood-{carrier}-{}", pinning.name());
            if words.iter().all(|word| name.contains(word.as_str())) {
                run_one(&name, carrier, pinning, packets);
            }
        }
    }
}

fn run_one(name: &str, carrier: &str, pinning: Pinning, packets: u64) {
    let (mut figures, mut rates) = (Figures::new(), Vec::new());
    for _ in 0..RUNS {
        let role = format!("flood {carrier} {} {packets}", pinning.name());
        let output = command(&role).stdin(Stdio::null()).output().expect("this program starts itself");
        let line = String::from_utf8(output.stdout).ok();
        let Some(nanos) = line.and_then(|line| line.trim().parse::<u64>().ok()) else {
            eprintln!("{name} failed: {}", String::from_utf8_lossy(&output.stderr));
            continue;
        };
        figures.record(Duration::from_nanos(nanos / packets));
        rates.push(packets * 1_000_000_000 / nanos.max(1));
    }
    rates.sort_unstable();
    let Some(median) = rates.get(rates.len() / 2) else { return };
    let counts = [
        ("messages_per_second", *median),
        ("least", rates[0]),
        ("most", rates[rates.len() - 1]),
        ("packets", packets),
    ];
    Alone { bench: "peers", case: name, figure: "time for each packet", seen: &figures, counts: &counts }
        .report();
}

/// Sends them, and prints how long that took in all.
pub(crate) fn measure(carrier: &str, packets: usize, pinning: Pinning) {
    let role = |at: &str| format!("sink {carrier} {} {packets} {at}", pinning.name());
    let took = match carrier {
        "tcp" => tcp(packets, role),
        "zenoh" => zenoh(packets, role),
        "sinew_confirmed" => sinew(packets, role),
        _ => panic!("no such carrier: {carrier}"),
    };
    println!("{}", took.as_nanos());
}

/// Takes them, and answers when the last one is there.
pub(crate) fn sink(carrier: &str, packets: usize, at: &str) {
    match carrier {
        "tcp" => tcp_sink(packets),
        "zenoh" => zenoh_sink(packets, at),
        "sinew_confirmed" => sinew_sink(packets, at),
        _ => panic!("no such carrier: {carrier}"),
    }
}

fn tcp(packets: usize, role: impl Fn(&str) -> String) -> Duration {
    let (mut ours, theirs) = stream::tcp_pair();
    let _sink = Process::start_on(&role("-"), theirs.into());
    let mut framed = vec![COUNTS; 4 + PACKET];
    framed[..4].copy_from_slice(&(PACKET as u32).to_le_bytes());
    let start = Instant::now();
    for _ in 0..packets {
        ours.write_all(&framed).expect("the sink reads");
    }
    ours.read_exact(&mut [0]).expect("the sink answers");
    start.elapsed()
}

fn tcp_sink(packets: usize) {
    let stream = UnixStream::from(stream::input());
    let mut reader = BufReader::with_capacity(64 * 1024, &stream);
    let (mut length, mut packet) = ([0; 4], vec![0; PACKET]);
    say_there();
    for _ in 0..packets {
        reader.read_exact(&mut length).expect("the sender lives");
        let length = u32::from_le_bytes(length) as usize;
        reader.read_exact(&mut packet[..length]).expect("the sender lives");
    }
    (&stream).write_all(&[1]).expect("the sender waits");
    await_end();
}

fn zenoh(packets: usize, role: impl Fn(&str) -> String) -> Duration {
    let at = peer::free_address();
    let _sink = Process::start(&role(&at));
    let session = peer::session(false, &at);
    let (answer, answers) = peer::answers();
    let _subscriber = peer::subscriber(&session, false, move |sample| drop(answer.send(sample)));
    let publisher = peer::publisher(&session, true, false);
    peer::meet(&publisher, &answers, &[0; PACKET]);
    let packet = vec![COUNTS; PACKET];
    let start = Instant::now();
    for _ in 0..packets {
        publisher.put(packet.as_slice()).wait().expect("a session");
    }
    answers.recv_timeout(DEADLINE).expect("the sink answers");
    start.elapsed()
}

fn zenoh_sink(packets: usize, at: &str) {
    let session = peer::session(true, at);
    let (back, taken) = (peer::publisher(&session, false, true), AtomicU64::new(0));
    let _subscriber = peer::subscriber(&session, true, move |sample| {
        let counts = sample.payload().to_bytes().first() == Some(&COUNTS);
        if !counts || taken.fetch_add(1, Ordering::Relaxed) + 1 == packets as u64 {
            back.put([1]).wait().expect("a session");
        }
    });
    say_there();
    await_end();
}

struct Flooder {
    packets: usize,
    done: SyncSender<Duration>,
}

impl Actor for Flooder {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        let (to, sender) = (context.resolve("sink").expect("it was required"), context.sender());
        let (packets, done) = (self.packets, self.done.clone());
        let flood = async move {
            let (packet, mut under_way) = (There { block: vec![COUNTS; PACKET] }, VecDeque::new());
            let start = Instant::now();
            for _ in 0..packets {
                if under_way.len() == UNDER_WAY {
                    arrived(under_way.pop_front()).await;
                }
                let sent = sender.send_confirmed(to, &packet, DEADLINE);
                under_way.push_back(sent.expect("there is room for what is under way"));
            }
            while !under_way.is_empty() {
                arrived(under_way.pop_front()).await;
            }
            done.send(start.elapsed()).expect("somebody waits for it");
        };
        context.spawn(flood.into_actor(self));
    }
}

async fn arrived(confirmation: Option<Confirmation>) {
    if let Some(confirmation) = confirmation {
        assert_eq!(confirmation.await, Outcome::Delivered);
    }
}

fn sinew(packets: usize, role: impl Fn(&str) -> String) -> Duration {
    let group = nodes::group();
    let _sink = Process::start(&role(&group));
    let (done, took) = sync_channel(1);
    let make = move || Flooder { packets, done: done.clone() };
    let app = AppSpec::new("flooder", make).requires(["sink"]).own_thread();
    let node = nodes::neighbour("flooder", 1, &group).app(app).start().expect("a node");
    let took = took.recv_timeout(DEADLINE).expect("the flood ends");
    node.stop();
    took
}

struct Sink {
    left: usize,
}

impl Actor for Sink {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<There>> for Sink {
    type Result = ();

    fn handle(&mut self, there: Delivery<There>, context: &mut Self::Context) {
        self.left -= 1;
        if self.left == 0 {
            // Nobody waits for it: all is confirmed.
            let _ = context.send(there.source, &Back { block: Vec::new() });
        }
    }
}

fn sinew_sink(packets: usize, group: &str) {
    let app = AppSpec::new("sink", move || Sink { left: packets }).handles::<There>().own_thread();
    let _node = nodes::neighbour("sink", 2, group).app(app).start().expect("a node");
    say_there();
    await_end();
}
