//! An attacker that records the robot's discovery datagrams, and replays them.

use std::{
    io::{self, Read as _},
    net::{Ipv4Addr, SocketAddrV4, UdpSocket},
    sync::atomic::{AtomicBool, Ordering},
    time::Duration,
};

use socket2::{Domain, Protocol, Socket, Type};

use super::{
    super::{keys::MALLORY, robot::NDL_PORT},
    Happened, Scene, done,
};
use sinew_testkit::random::SeededRandom;

/// Maximum number of recorded datagrams.
const KEPT: usize = 8_192;
/// Datagrams sent per millisecond.
const AT_ONCE: usize = 4;

/// Kinds of datagrams.
const KINDS: [&str; 3] = ["sent again", "changed", "made up"];
/// Destinations.
const DESTINATIONS: [&str; 3] = ["knee", "hip", "the group"];
/// The node's cause for a datagram that was not made by its project, or that it has received before.
pub(in super::super) const NOT_OURS: &str = "NDL datagram not of this project's keys";

/// The recorded datagrams of the robot.
#[derive(Default)]
pub(in super::super) struct Recording {
    datagrams: Vec<Vec<u8>>,
    /// The number of unicast datagrams among them.
    to_one: usize,
}

/// Datagrams that the network accepted, by kind and destination, and the last error per destination.
#[derive(Default)]
struct Sent {
    counts: [[u64; 3]; 3],
    errors: [Option<io::Error>; 3],
}

pub(super) fn replayed_and_forged(scene: &Scene<'_>) -> Happened {
    let sent = scene.on_threads(1, |_| send(scene)).pop().unwrap_or_default();
    let mut broken = Vec::new();
    let Recording { datagrams, to_one } = &scene.recorded;
    let to_all = datagrams.len() - to_one;
    if to_all == 0 || *to_one == 0 {
        broken.push(format!("{to_all} datagrams to all and {to_one} to one node were recorded"));
    }
    let mut what = vec![format!("{to_all} to all and {to_one} to one node recorded")];
    for (kind, counts) in KINDS.iter().zip(sent.counts) {
        for ((destination, count), error) in DESTINATIONS.iter().zip(counts).zip(&sent.errors) {
            what.push(format!("{count} {kind} to {destination}"));
            if count == 0 {
                broken.push(format!("none was {kind} to {destination}: {error:?}"));
            }
        }
    }
    let all = sent.counts.iter().flatten().sum();
    Happened {
        refused: vec![(NOT_OURS, 1)],
        done: done("datagrams", all),
        ..Happened::new(what.join(", "), broken)
    }
}

fn send(scene: &Scene<'_>) -> Sent {
    let (recorded, mut random, mut sent) = (&scene.recorded.datagrams, SeededRandom::new(7), Sent::default());
    let socket = Socket::new(Domain::IPV4, Type::DGRAM, Some(Protocol::UDP)).expect("a socket");
    socket.bind(&SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, NDL_PORT).into()).expect("the attacker's own port");
    // The attacker's host has no multicast route: without this no multicast datagram leaves it.
    socket.set_multicast_if_v4(&MALLORY.address()).expect("the attacker's own interface");
    let socket = UdpSocket::from(socket);
    while !scene.is_over() {
        for _ in 0..AT_ONCE {
            let kind = (random.number() % 3) as usize;
            let mut datagram = match recorded.get(random.number() as usize % recorded.len().max(1)) {
                Some(datagram) if kind < 2 => datagram.clone(),
                // No datagram to replay: this does not count as one.
                None if kind < 2 => continue,
                _ => (0..random.number() % 1_400).map(|_| random.number() as u8).collect(),
            };
            if kind == 1 && !datagram.is_empty() {
                let at = random.number() as usize % datagram.len();
                datagram[at] ^= 1 << (random.number() % 8);
            }
            let to = (random.number() % 3) as usize;
            // A datagram that the network does not accept is not sent again.
            match socket.send_to(&datagram, scene.target.datagrams[to]) {
                Ok(_) => sent.counts[kind][to] += 1,
                Err(error) => sent.errors[to] = Some(error),
            }
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    sent
}

/// Records the discovery datagrams on this host's interface, multicast and unicast, until it is over.
pub(in super::super) fn listen(group: SocketAddrV4, over: &AtomicBool) -> Recording {
    /// All packets of the host, including those that it sends (`ETH_P_ALL`), which the system expects in
    /// network byte order.
    const ALL_PACKETS: u16 = 0x0003;
    let all = Protocol::from(i32::from(ALL_PACKETS.to_be()));
    let mut socket = Socket::new(Domain::PACKET, Type::DGRAM, Some(all)).expect("a right of root");
    socket.set_read_timeout(Some(Duration::from_millis(50))).expect("a socket");
    let mut recorded = Recording::default();
    while !over.load(Ordering::Relaxed) && recorded.datagrams.len() < KEPT {
        let mut packet = [0; 2_048];
        let Ok(length) = socket.read(&mut packet) else { continue };
        if let Some((to, datagram)) = datagram(&packet[..length], [group.port(), NDL_PORT]) {
            recorded.to_one += usize::from(to != *group.ip());
            recorded.datagrams.push(datagram.to_vec());
        }
    }
    recorded
}

/// Returns the UDP datagram in an IPv4 packet to one of these ports, and its destination.
fn datagram(packet: &[u8], ports: [u16; 2]) -> Option<(Ipv4Addr, &[u8])> {
    const UDP: u8 = 17;
    let word = |bytes: &[u8], at: usize| Some(u16::from_be_bytes([*bytes.get(at)?, *bytes.get(at + 1)?]));
    let (version, header) = (packet.first()? >> 4, usize::from(packet.first()? & 0x0f) * 4);
    let is_whole = word(packet, 6)? & 0x3fff == 0;
    if version != 4 || packet.get(9) != Some(&UDP) || !is_whole {
        return None;
    }
    let to: [u8; 4] = packet.get(16..20)?.try_into().ok()?;
    let udp = packet.get(header..)?;
    let payload = udp.get(8..usize::from(word(udp, 4)?))?;
    ports.contains(&word(udp, 2)?).then_some((to.into(), payload))
}
