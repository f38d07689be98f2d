//! Hosts on simulated routers that drop, repeat, reorder, alter and replay puts, and that restart. Each host
//! runs a reliable transfer to each other one, as TCP would, and queries the discovery group.
//!
//! `SINEW_SEEDS=1000 cargo test --release --test simulation` runs more seeds. A failure names its seed, and
//! `SINEW_SEED=17` runs that one alone.

use std::{
    cmp::Reverse,
    collections::{BTreeMap, BTreeSet, BinaryHeap},
    net::{Ipv4Addr, SocketAddrV4},
    ops::RangeInclusive,
    time::Duration,
};

use fastrand::Rng;
use sinew_zenoh_link::{
    Header, HostFact, Input, Instance, Link, Output, ProjectKey, Protocol, Settings, Target, key,
};

const HOSTS: u8 = 4;
const GROUP: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(239, 255, 83, 119), 6_910);
/// Served port, of discovery and of transfers.
const PORT: u16 = 6_911;
/// A port that no host serves.
const CLOSED: u16 = 22;
/// Messages of each transfer.
const MESSAGES: u64 = 40;
const STEP: Duration = Duration::from_millis(10);
/// Time with faults, and time without them afterwards.
const FAULTS: Duration = Duration::from_secs(20);
const HEALED: Duration = Duration::from_secs(20);
const RETRANSMIT: Duration = Duration::from_millis(200);
const QUERY_PERIOD: Duration = Duration::from_millis(500);
/// Payloads that an attacker keeps for replays.
const RECORDED_MAX: usize = 256;

/// The purpose of a simulated packet.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Content {
    Query,
    Message(u64),
    Acknowledgement(u64),
    Attack,
}

fn address(host: u8) -> Ipv4Addr {
    Ipv4Addr::new(10, 99, 0, host + 1)
}

/// Builds a UDP packet with a unique number.
fn packet(source: u8, target: SocketAddrV4, number: u64, content: Content) -> Vec<u8> {
    let mut bytes = vec![0; 28];
    (bytes[0], bytes[1], bytes[9]) = (0x45, 46 << 2, 17);
    bytes[12..16].copy_from_slice(&address(source).octets());
    bytes[16..20].copy_from_slice(&target.ip().octets());
    bytes[20..22].copy_from_slice(&PORT.to_be_bytes());
    bytes[22..24].copy_from_slice(&target.port().to_be_bytes());
    bytes.extend(number.to_be_bytes());
    let (kind, of) = match content {
        Content::Query => (0, 0),
        Content::Message(of) => (1, of),
        Content::Acknowledgement(of) => (2, of),
        Content::Attack => (3, 0),
    };
    bytes.push(kind);
    bytes.extend(of.to_be_bytes());
    let length = u16::try_from(bytes.len()).expect("it is short");
    bytes[2..4].copy_from_slice(&length.to_be_bytes());
    bytes
}

fn content(packet: &[u8]) -> Content {
    let of = u64::from_be_bytes(packet[37..45].try_into().expect("8 bytes"));
    match packet[36] {
        0 => Content::Query,
        1 => Content::Message(of),
        2 => Content::Acknowledgement(of),
        _ => Content::Attack,
    }
}

/// A put under way: when it arrives, its number, target, source, payload.
type UnderWay = Reverse<(Duration, u64, Target, Ipv4Addr, Vec<u8>)>;

/// One host: its link, and both ends of its transfers.
struct Host {
    link: Link,
    instance: Instance,
    /// The message that each other host has not acknowledged, and when it was last sent.
    unacknowledged: BTreeMap<u8, (u64, Option<Duration>)>,
    /// The last message of each other host.
    received: BTreeMap<u8, u64>,
    /// The packets that the present link has written.
    written: BTreeSet<Vec<u8>>,
    /// When a query of each other host was last received.
    queried: BTreeMap<u8, Duration>,
}

struct World {
    rng: Rng,
    seed: u64,
    now: Duration,
    hosts: Vec<Host>,
    under_way: BinaryHeap<UnderWay>,
    /// Tokens that disappear later: when, and of which host.
    leaving: Vec<(Duration, u8, Instance)>,
    /// Each packet that a host gave to its link.
    made: BTreeSet<Vec<u8>>,
    recorded: Vec<(Target, Ipv4Addr, Vec<u8>)>,
    routers_up: bool,
    number: u64,
}

fn link(host: u8, instance: Instance) -> Link {
    let settings = Settings {
        project: "leg".to_owned(),
        address: address(host),
        prefix: 24,
        ports: BTreeSet::from([PORT]),
        group: Some(GROUP),
        group_every: Duration::from_secs(1),
        key: ProjectKey::parse("3c".repeat(32).as_bytes()),
    };
    Link::new(settings, instance)
}

impl World {
    fn new(seed: u64) -> Self {
        let mut rng = Rng::with_seed(seed);
        let hosts = (0..HOSTS).map(|host| {
            let instance = Instance(rng.u128(..).to_be_bytes());
            let others = (0..HOSTS).filter(move |other| *other != host);
            Host {
                link: link(host, instance),
                instance,
                unacknowledged: others.map(|other| (other, (1, None))).collect(),
                received: BTreeMap::new(),
                written: BTreeSet::new(),
                queried: BTreeMap::new(),
            }
        });
        let hosts = hosts.collect();
        Self {
            rng,
            seed,
            now: Duration::ZERO,
            hosts,
            under_way: BinaryHeap::new(),
            leaving: Vec::new(),
            made: BTreeSet::new(),
            recorded: Vec::new(),
            routers_up: false,
            number: 0,
        }
    }

    const fn has_faults(&self) -> bool {
        self.now.as_nanos() < FAULTS.as_nanos()
    }

    fn chance(&mut self, of_thousand: u32) -> bool {
        self.has_faults() && self.rng.u32(0..1_000) < of_thousand
    }

    /// Gives a packet of a host to its link.
    fn send(&mut self, from: u8, to: SocketAddrV4, content: Content) {
        self.number += 1;
        let packet = packet(from, to, self.number, content);
        self.made.insert(packet.clone());
        self.give(from, Input::PacketRead(&packet));
    }

    fn give(&mut self, host: u8, input: Input<'_>) {
        let now = self.now;
        self.hosts[usize::from(host)].link.handle(now, input);
        while let Some(output) = self.hosts[usize::from(host)].link.poll() {
            match output {
                Output::Put { target, payload, .. } => self.put(address(host), target, &payload),
                Output::Write(packet) => self.write(host, packet),
                Output::Host(HostFact::AddressTaken(instance)) => {
                    panic!("seed {}: {instance} has the address of host {host}", self.seed)
                }
                Output::Host(_) => {}
            }
        }
    }

    /// The routers: a put is lost, repeated, altered, recorded, and delayed by itself.
    fn put(&mut self, source: Ipv4Addr, target: Target, payload: &[u8]) {
        if !self.routers_up || self.chance(100) {
            return;
        }
        let copies = if self.chance(50) { 2 } else { 1 };
        for _ in 0..copies {
            let mut payload = payload.to_vec();
            if self.chance(30) {
                let at = self.rng.usize(0..payload.len());
                payload[at] ^= 1 << self.rng.u32(0..8);
            }
            self.deliver_later(source, target, payload);
        }
        if self.recorded.len() < RECORDED_MAX {
            self.recorded.push((target, source, payload.to_vec()));
        }
        if self.chance(50) {
            let (target, source, payload) = self.recorded[self.rng.usize(0..self.recorded.len())].clone();
            self.deliver_later(source, target, payload.clone());
            let host = self.rng.u8(0..HOSTS);
            self.deliver_later(address(host), target, payload);
        }
    }

    fn deliver_later(&mut self, source: Ipv4Addr, target: Target, payload: Vec<u8>) {
        let due = self.now + Duration::from_millis(self.rng.u64(1..80));
        self.number += 1;
        self.under_way.push(Reverse((due, self.number, target, source, payload)));
    }

    fn arrive(&mut self) {
        while let Some(Reverse((due, ..))) = self.under_way.peek()
            && *due <= self.now
            && let Some(Reverse((_, _, target, source, payload))) = self.under_way.pop()
        {
            let key = key::put("leg", target, source);
            let (target, source) = key::parse_put(&key).expect("a key of the link");
            for host in 0..HOSTS {
                if source != address(host) && (target == Target::All || target == Target::Host(address(host)))
                {
                    self.give(host, Input::PutReceived { target, source, payload: &payload });
                }
            }
        }
    }

    /// The host's kernel: it gets only packets that another host made for it, each once.
    fn write(&mut self, host: u8, packet: Vec<u8>) {
        let (seed, now) = (self.seed, self.now);
        let header = Header::parse(&packet).expect("a packet");
        let content = content(&packet);
        assert!(self.made.contains(&packet), "seed {seed}, {now:?}: nobody made {header:?}");
        assert_eq!(header.protocol, Protocol::Udp);
        assert_ne!(content, Content::Attack, "seed {seed}, {now:?}: host {host} got {header:?}");
        let from = header.source.octets()[3] - 1;
        let this = &mut self.hosts[usize::from(host)];
        if content == Content::Query {
            this.queried.insert(from, now);
            return;
        }
        assert_eq!(header.target, address(host), "seed {seed}, {now:?}");
        assert!(this.written.insert(packet), "seed {seed}, {now:?}: host {host} got {header:?} twice");
        match content {
            Content::Message(number) => {
                let last = this.received.entry(from).or_default();
                assert!(number <= *last + 1, "seed {seed}, {now:?}: message {number} overtook others");
                *last = number.max(*last);
                self.send(host, SocketAddrV4::new(address(from), PORT), Content::Acknowledgement(number));
            }
            Content::Acknowledgement(number) => {
                let (next, sent) = this.unacknowledged.get_mut(&from).expect("another host");
                if *next == number {
                    (*next, *sent) = (number + 1, None);
                }
            }
            Content::Query | Content::Attack => {}
        }
    }

    fn tokens(&mut self, host: u8, instance: Instance, appears: bool) {
        let (of, instance) = key::parse_token(&key::token("leg", address(host), instance)).expect("a token");
        for other in 0..HOSTS {
            let input = if appears {
                Input::HostAppeared(of, instance)
            } else {
                Input::HostDisappeared(of, instance)
            };
            self.give(other, input);
        }
    }

    fn all_tokens(&mut self, appear: bool) {
        for host in 0..HOSTS {
            self.tokens(host, self.hosts[usize::from(host)].instance, appear);
        }
    }

    /// Routers and programs restart.
    fn restarts(&mut self) {
        if !self.routers_up && !self.chance(950) {
            self.routers_up = true;
            self.all_tokens(true);
        } else if self.routers_up && self.chance(4) {
            self.routers_up = false;
            self.all_tokens(false);
        }
        let due: Vec<_> = self.leaving.iter().filter(|(at, ..)| *at <= self.now).copied().collect();
        self.leaving.retain(|(at, ..)| *at > self.now);
        for (_, host, instance) in due {
            self.tokens(host, instance, false);
        }
        if self.chance(3) {
            let host = self.rng.u8(0..HOSTS);
            let instance = Instance(self.rng.u128(..).to_be_bytes());
            let this = &mut self.hosts[usize::from(host)];
            let former = std::mem::replace(&mut this.instance, instance);
            this.link = link(host, instance);
            this.written.clear();
            self.leaving.push((self.now + Duration::from_secs(2), host, former));
            if self.routers_up {
                self.tokens(host, instance, true);
                for other in 0..HOSTS {
                    let (of, instance) = (address(other), self.hosts[usize::from(other)].instance);
                    self.give(host, Input::HostAppeared(of, instance));
                }
            }
        }
    }

    /// The nodes: queries, messages, retransmissions, and packets to ports that are closed.
    fn traffic(&mut self, tick: u32) {
        let is_query_due = (STEP * tick).as_millis() % QUERY_PERIOD.as_millis() == 0;
        for host in 0..HOSTS {
            if is_query_due {
                self.send(host, GROUP, Content::Query);
            }
            for other in (0..HOSTS).filter(|other| *other != host) {
                let (next, sent) = self.hosts[usize::from(host)].unacknowledged[&other];
                let is_due = sent.is_none_or(|sent| self.now >= sent + RETRANSMIT);
                if next <= MESSAGES && is_due {
                    let now = Some(self.now);
                    self.hosts[usize::from(host)].unacknowledged.insert(other, (next, now));
                    self.send(host, SocketAddrV4::new(address(other), PORT), Content::Message(next));
                }
                if self.chance(20) {
                    self.send(host, SocketAddrV4::new(address(other), CLOSED), Content::Attack);
                }
            }
        }
    }

    fn run(&mut self) {
        let ticks = (FAULTS + HEALED).as_millis() / STEP.as_millis();
        for tick in 0..u32::try_from(ticks).expect("some thousand") {
            self.now = STEP * tick;
            self.restarts();
            self.arrive();
            self.traffic(tick);
        }
    }

    fn check(&self) {
        for (host, of) in self.hosts.iter().enumerate() {
            for (other, (next, _)) in &of.unacknowledged {
                assert_eq!(*next, MESSAGES + 1, "seed {}: host {host} to {other} has not ended", self.seed);
            }
            for (other, last) in &of.received {
                assert_eq!(*last, MESSAGES, "seed {}: host {host} from {other}", self.seed);
            }
            let recent = of.queried.values().filter(|at| **at > self.now - Duration::from_secs(3)).count();
            assert_eq!(recent, usize::from(HOSTS) - 1, "seed {}: {:?}", self.seed, of.queried);
            assert_eq!(of.link.hosts().count(), usize::from(HOSTS) - 1, "seed {}", self.seed);
        }
    }
}

fn seeds() -> RangeInclusive<u64> {
    let number = |name| std::env::var(name).ok().map(|text| text.parse().expect("a number"));
    match (number("SINEW_SEED"), number("SINEW_SEEDS")) {
        (Some(seed), _) => seed..=seed,
        (None, count) => 1..=count.unwrap_or(20),
    }
}

#[test]
fn transfers_end_in_order_whatever_routers_do() {
    let mut replayed = 0;
    let mut forged = 0;
    for seed in seeds() {
        let mut world = World::new(seed);
        world.run();
        world.check();
        for host in &world.hosts {
            replayed += host.link.counts().dropped_for(sinew_zenoh_link::DropCause::Replayed);
            forged += host.link.counts().dropped_for(sinew_zenoh_link::DropCause::Forged);
        }
    }
    assert!(replayed > 0 && forged > 0, "the routers planted faults: {replayed} replays, {forged} forgeries");
}
