//! One-way packets as fast as possible, until the last one has arrived: confirmed, unconfirmed, and over bare
//! TCP.

use std::{
    collections::VecDeque,
    io::{BufReader, Read, Write},
    os::unix::net::UnixStream,
    sync::mpsc::{SyncSender, sync_channel},
    time::{Duration, Instant},
};

use serde::{Deserialize, Serialize};
use sinew::{
    message::{Confirmation, Sender},
    prelude::*,
};
use sinew_figures::{
    Alone, Figures, Pinning,
    process::{Process, await_end, cpu_time, print_ready, print_time},
    stream,
};

use crate::{
    keys::{self, FIRST, Keys, SECOND},
    nodes::At,
    ping::DEADLINE,
};

/// Bytes of a packet.
const PACKET: usize = 1000;
/// Maximum number of confirmed packets in flight: the number of messages without an outcome that a mailbox
/// holds.
const UNDER_WAY: usize = 256;
/// Number of packets per write over bare TCP in the batched case.
const TOGETHER: usize = 32;

/// The carrier of the packets.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Carrier {
    /// Bulk, with an outcome for each packet.
    Confirmed,
    /// Bulk, without.
    Unconfirmed,
    /// Bare TCP, a length before each packet, a write for each.
    Tcp,
    /// The same, a write for 32 KiB.
    TcpTogether,
}

impl Carrier {
    pub(crate) const ALL: [Self; 4] = [Self::Confirmed, Self::Unconfirmed, Self::Tcp, Self::TcpTogether];

    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::Confirmed => "confirmed",
            Self::Unconfirmed => "unconfirmed",
            Self::Tcp => "raw_tcp",
            Self::TcpTogether => "raw_tcp_together",
        }
    }

    /// # Panics
    /// If there is none of that name.
    pub(crate) fn named(name: &str) -> Self {
        let found = Self::ALL.into_iter().find(|carrier| carrier.name() == name);
        found.expect("a name that this program wrote itself")
    }
}

/// The cost of a flood.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Cost {
    /// Time until all packets have arrived.
    pub(crate) took: Duration,
    /// CPU time of the sending process from its first packet on.
    pub(crate) cpu: Duration,
    /// CPU time of the receiving process from its first packet on.
    pub(crate) cpu_there: Duration,
}

/// The start of a flood at its sender.
#[derive(Clone, Copy, Debug)]
struct Begin {
    at: Instant,
    cpu: Duration,
}

impl Begin {
    fn now() -> Self {
        Self { at: Instant::now(), cpu: cpu_time() }
    }

    /// Returns the elapsed time, and the CPU time of this process since.
    fn elapsed(self) -> (Duration, Duration) {
        (self.at.elapsed(), cpu_time().saturating_sub(self.cpu))
    }
}

#[derive(Serialize, Deserialize)]
struct Packet {
    #[serde(with = "serde_bytes")]
    block: Vec<u8>,
}

impl Payload for Packet {
    const NAME: &'static str = "gncl.packet";
    const CLASS: Class = Class::Bulk;
}

#[derive(Serialize, Deserialize)]
struct Last;

impl Payload for Last {
    const NAME: &'static str = "gncl.last";
}

/// Measures, and prints the line.
pub(crate) fn measure(carrier: Carrier, packets: usize, pinning: Pinning, is_secured: bool) {
    let at = At::loopback();
    let keys = is_secured.then(|| Keys::make(at, &[("flooder", FIRST), ("sink", SECOND)]));
    let role = format!("sink {} {packets} {} {}", carrier.name(), pinning.name(), at.host(2));
    let Cost { took, cpu, cpu_there } = run(carrier, packets, at, &role);
    drop(keys);
    let mut seen = Figures::new();
    let each = |time: Duration| time / u32::try_from(packets).expect("no flood has so many");
    let each_ns = |time| u64::try_from(each(time).as_nanos()).unwrap_or(u64::MAX);
    seen.record(each(took));
    let rate = packets as u128 * 1_000_000_000 / took.as_nanos().max(1);
    let counts = [
        ("messages_per_s", u64::try_from(rate).unwrap_or(u64::MAX)),
        ("cpu_ns_each_message", each_ns(cpu)),
        ("cpu_ns_each_message_there", each_ns(cpu_there)),
        ("packets", packets as u64),
    ];
    let secured = if is_secured { "_secured" } else { "" };
    let case = format!("flood{secured}_{}_{}", carrier.name(), pinning.name());
    Alone { bench: "gncl", case: &case, figure: "time for each packet", seen: &seen, counts: &counts }
        .report();
}

/// Sends all packets to the process of this role, which is the [`sink`] at the second address.
pub(crate) fn run(carrier: Carrier, packets: usize, at: At, role: &str) -> Cost {
    match carrier {
        Carrier::Confirmed | Carrier::Unconfirmed => between_nodes(carrier, packets, at, role),
        Carrier::Tcp => raw(packets, 1, role),
        Carrier::TcpTogether => raw(packets, TOGETHER, role),
    }
}

/// The receiving end.
pub(crate) fn sink(carrier: Carrier, packets: usize, at: At) {
    if matches!(carrier, Carrier::Tcp | Carrier::TcpTogether) {
        return raw_sink(packets);
    }
    let sink = move || Sink { left: packets, begun: None };
    let app = AppSpec::new("sink", sink).handles::<Packet>().own_thread();
    let _node = keys::node(at, "sink").app(app).start().expect("a node");
    print_ready();
    await_end();
}

struct Sink {
    left: usize,
    /// CPU time of this process at its first packet.
    begun: Option<Duration>,
}

impl Actor for Sink {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Packet>> for Sink {
    type Result = ();

    fn handle(&mut self, packet: Delivery<Packet>, context: &mut Self::Context) {
        let begun = *self.begun.get_or_insert_with(cpu_time);
        std::hint::black_box(packet.payload.block);
        self.left -= 1;
        if self.left == 0 {
            print_time(cpu_time().saturating_sub(begun));
            context.send(packet.source, &Last).expect("the measuring end takes it");
        }
    }
}

struct Flooder {
    carrier: Carrier,
    packets: usize,
    begin: Begin,
    done: SyncSender<(Duration, Duration)>,
}

impl Actor for Flooder {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        let (to, sender) = (context.resolve("sink").expect("it was required"), context.sender());
        let (carrier, packets) = (self.carrier, self.packets);
        self.begin = Begin::now();
        let flood = async move {
            match carrier {
                Carrier::Confirmed => confirmed(&sender, to, packets).await,
                Carrier::Unconfirmed | Carrier::Tcp | Carrier::TcpTogether => {
                    unconfirmed(&sender, to, packets).await;
                }
            }
        };
        context.spawn(flood.into_actor(self));
    }
}

impl Handler<Delivery<Last>> for Flooder {
    type Result = ();

    fn handle(&mut self, _: Delivery<Last>, _: &mut Self::Context) {
        self.done.send(self.begin.elapsed()).expect("the measuring thread waits for it");
    }
}

async fn confirmed(sender: &Sender, to: Tid, packets: usize) {
    let (packet, mut under_way) = (Packet { block: vec![7; PACKET] }, VecDeque::new());
    for _ in 0..packets {
        if under_way.len() == UNDER_WAY {
            arrived(under_way.pop_front()).await;
        }
        let sent = sender.message(to, &packet).confirmed(DEADLINE);
        under_way.push_back(sent.expect("there is room for what is under way"));
    }
    while !under_way.is_empty() {
        arrived(under_way.pop_front()).await;
    }
}

async fn arrived(confirmation: Option<Confirmation>) {
    if let Some(confirmation) = confirmation {
        assert_eq!(confirmation.await, Outcome::Delivered);
    }
}

async fn unconfirmed(sender: &Sender, to: Tid, packets: usize) {
    let packet = Packet { block: vec![7; PACKET] };
    for _ in 0..packets {
        let sent = sender.message(to, &packet).room_within(DEADLINE).send().await;
        sent.expect("the sink takes packets");
    }
}

fn between_nodes(carrier: Carrier, packets: usize, at: At, role: &str) -> Cost {
    let mut sink = Process::start(role);
    let (done, took) = sync_channel(1);
    let make = move || Flooder { carrier, packets, begin: Begin::now(), done: done.clone() };
    let app = AppSpec::new("flooder", make).handles::<Last>().requires(["sink"]).own_thread();
    let node = keys::node(at, "flooder").app(app).start().expect("a node");
    let (took, cpu) = took.recv_timeout(DEADLINE).expect("the flood ends");
    let cpu_there = sink.time();
    node.stop();
    Cost { took, cpu, cpu_there }
}

fn raw(packets: usize, together: usize, role: &str) -> Cost {
    let (mut ours, theirs) = stream::tcp_pair();
    let mut sink = Process::start_on(role, theirs.into());
    let mut framed = vec![7; 4 + PACKET];
    framed[..4].copy_from_slice(&(PACKET as u32).to_le_bytes());
    let mut buffer = Vec::new();
    let begin = Begin::now();
    for packet in 1..=packets {
        buffer.extend_from_slice(&framed);
        if packet % together == 0 || packet == packets {
            ours.write_all(&buffer).expect("the sink reads");
            buffer.clear();
        }
    }
    ours.read_exact(&mut [0]).expect("the sink answers");
    let (took, cpu) = begin.elapsed();
    Cost { took, cpu, cpu_there: sink.time() }
}

fn raw_sink(packets: usize) {
    let stream = UnixStream::from(stream::input());
    let mut reader = BufReader::with_capacity(64 * 1024, &stream);
    let (mut length, mut packet) = ([0; 4], vec![0; PACKET]);
    print_ready();
    let begun = cpu_time();
    for _ in 0..packets {
        reader.read_exact(&mut length).expect("the sender lives");
        let length = u32::from_le_bytes(length) as usize;
        reader.read_exact(&mut packet[..length]).expect("the sender lives");
    }
    print_time(cpu_time().saturating_sub(begun));
    (&stream).write_all(&[1]).expect("the sender waits");
}
