//! The cost of one host in a network of many: puts while hosts join, puts at rest, and CPU time for each.
//!
//! ```sh
//! cargo run --release --manifest-path bridges/zenoh/Cargo.toml -p sinew-zenoh-link --example scale -- 10 100 1000
//! ```
//!
//! Every host runs its link with a project key. Routers are an array: the times are those of the link alone. At
//! rest each node queries each other one once in `PERIOD`, and answers as many queries, as discovery does.

use std::{
    collections::BTreeSet,
    io::{self, Write as _},
    net::{Ipv4Addr, SocketAddrV4},
    time::{Duration, Instant},
};

use sinew_zenoh_link::{Input, Instance, Link, Output, ProjectKey, SEAL_BYTES, Settings, Target};

const GROUP: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(239, 255, 83, 119), 6_910);
const PORT: u16 = 6_911;
/// Time between two queries of a node to another one: the default of `ndl.period_ms`.
const PERIOD: Duration = Duration::from_millis(500);
/// Bytes of a query or an answer of discovery with keys: header, announcement and seal.
const DATAGRAM: usize = 300;
/// Default numbers of hosts.
const HOSTS: [usize; 4] = [10, 30, 100, 300];
/// Periods at rest that are played. All of them together have at most so many packets.
const PACKETS_MAX: usize = 2_000_000;

struct World {
    links: Vec<Link>,
    puts: u64,
    delivered: u64,
    bytes: u64,
}

fn address(host: usize) -> Ipv4Addr {
    let number = u32::try_from(host).expect("some thousand hosts");
    Ipv4Addr::from_bits(Ipv4Addr::new(10, 99, 0, 1).to_bits() + number)
}

fn instance(host: usize) -> Instance {
    Instance((host as u128).to_be_bytes())
}

fn link(host: usize) -> Link {
    let settings = Settings {
        project: "leg".to_owned(),
        address: address(host),
        prefix: 16,
        ports: BTreeSet::from([PORT]),
        group: Some(GROUP),
        group_every: Duration::from_secs(1),
        key: ProjectKey::parse("3c".repeat(32).as_bytes()),
    };
    Link::new(settings, instance(host))
}

/// Builds a discovery datagram.
fn datagram(source: Ipv4Addr, target: SocketAddrV4) -> Vec<u8> {
    let mut bytes = vec![0; 28 + DATAGRAM];
    let length = u16::try_from(bytes.len()).expect("it is short");
    (bytes[0], bytes[1], bytes[9]) = (0x45, 48 << 2, 17);
    bytes[2..4].copy_from_slice(&length.to_be_bytes());
    bytes[12..16].copy_from_slice(&source.octets());
    bytes[16..20].copy_from_slice(&target.ip().octets());
    bytes[20..22].copy_from_slice(&PORT.to_be_bytes());
    bytes[22..24].copy_from_slice(&target.port().to_be_bytes());
    bytes
}

impl World {
    /// Gives an input to a host, and carries its puts to their targets.
    fn give(&mut self, now: Duration, host: usize, input: Input<'_>) {
        self.links[host].handle(now, input);
        while let Some(output) = self.links[host].poll() {
            let Output::Put { target, payload, .. } = output else { continue };
            self.puts += 1;
            self.bytes += payload.len() as u64;
            let source = address(host);
            for other in 0..self.links.len() {
                let is_target = target == Target::All || target == Target::Host(address(other));
                if other != host && is_target {
                    self.links[other].handle(now, Input::PutReceived { target, source, payload: &payload });
                    while self.links[other].poll().is_some() {
                        self.delivered += 1;
                    }
                    if target != Target::All {
                        break;
                    }
                }
            }
        }
    }

    /// All hosts join, one after the other. Each queries the group, then its token appears.
    fn join(&mut self, now: Duration) {
        for host in 0..self.links.len() {
            let query = datagram(address(host), GROUP);
            self.give(now, host, Input::PacketRead(&query));
            for other in 0..host {
                self.give(now, other, Input::HostAppeared(address(host), instance(host)));
                self.give(now, host, Input::HostAppeared(address(other), instance(other)));
            }
        }
    }

    /// One period at rest of one host: a query to each other one, and an answer to each.
    fn rest(&mut self, now: Duration, host: usize) {
        for other in (0..self.links.len()).filter(|other| *other != host) {
            let target = SocketAddrV4::new(address(other), PORT);
            let query = datagram(address(host), target);
            self.give_directly(now, (host, other), &query);
            self.give_directly(now, (host, other), &query);
        }
    }

    /// Carries one packet, without a search for the target.
    fn give_directly(&mut self, now: Duration, (host, other): (usize, usize), packet: &[u8]) {
        self.links[host].handle(now, Input::PacketRead(packet));
        while let Some(output) = self.links[host].poll() {
            let Output::Put { target, payload, .. } = output else { continue };
            self.puts += 1;
            let source = address(host);
            self.links[other].handle(now, Input::PutReceived { target, source, payload: &payload });
            while self.links[other].poll().is_some() {
                self.delivered += 1;
            }
        }
    }
}

fn report(hosts: usize) -> io::Result<()> {
    let mut world = World { links: (0..hosts).map(link).collect(), puts: 0, delivered: 0, bytes: 0 };
    world.join(Duration::from_secs(1));
    let joined = world.puts / hosts as u64;
    let per_period = 2 * hosts * (hosts - 1);
    let played = (PACKETS_MAX / per_period.max(1)).clamp(1, 20);
    (world.puts, world.delivered) = (0, 0);
    let start = Instant::now();
    for period in 0..played {
        let now = Duration::from_secs(10) + PERIOD * u32::try_from(period).expect("at most 20");
        (0..hosts).for_each(|host| world.rest(now, host));
    }
    let spent = start.elapsed();
    assert_eq!(world.puts, world.delivered, "each put arrived");
    let packet_ns = spent.as_nanos() as f64 / world.puts as f64;
    let per_second = 2.0 * (hosts - 1) as f64 / PERIOD.as_secs_f64();
    let bytes = per_second * (28 + DATAGRAM + SEAL_BYTES) as f64;
    writeln!(
        io::stdout(),
        "{hosts:>6} {joined:>16} {per_second:>16.0} {:>16.0} {packet_ns:>16.0} {:>16.2}",
        bytes / 1e3,
        // One host sends and receives as many.
        per_second * packet_ns / 1e7,
    )
}

fn main() -> io::Result<()> {
    let given: Vec<usize> = std::env::args().skip(1).filter_map(|number| number.parse().ok()).collect();
    writeln!(
        io::stdout(),
        "{:>6} {:>16} {:>16} {:>16} {:>16} {:>16}",
        "hosts",
        "puts at the join",
        "puts/s at rest",
        "kB/s at rest",
        "ns for a packet",
        "% of a CPU"
    )?;
    let hosts = if given.is_empty() { HOSTS.to_vec() } else { given };
    hosts.into_iter().filter(|hosts| *hosts > 1).try_for_each(report)
}
