//! Who hears the robot's datagrams of discovery, and sends them again.

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
use crate::dice::Dice;

/// Datagrams that are recorded at most.
const KEPT: usize = 8_192;
/// Datagrams each millisecond.
const AT_ONCE: usize = 4;

/// What is sent.
const KINDS: [&str; 3] = ["sent again", "changed", "made up"];
/// Where to.
const DESTINATIONS: [&str; 3] = ["knee", "hip", "the group"];
/// The node's word for a datagram that nobody of its project has made, or that it has taken before.
pub(in super::super) const NOT_OURS: &str = "NDL datagram not of this project's keys";

/// What was heard of the robot.
#[derive(Default)]
pub(in super::super) struct Recording {
    datagrams: Vec<Vec<u8>>,
    /// Of these, so many were said to one node alone.
    to_one: usize,
}

/// What the network took of each kind for each destination, and why it did not take the last one that it did not.
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
    let (recorded, mut dice, mut sent) = (&scene.recorded.datagrams, Dice::new(7), Sent::default());
    let socket = Socket::new(Domain::IPV4, Type::DGRAM, Some(Protocol::UDP)).expect("a socket");
    socket.bind(&SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, NDL_PORT).into()).expect("the attacker's own port");
    // His host has no route to groups: without this nothing that he says to one leaves it.
    socket.set_multicast_if_v4(&MALLORY.address()).expect("the attacker's own interface");
    let socket = UdpSocket::from(socket);
    while !scene.is_over() {
        for _ in 0..AT_ONCE {
            let kind = (dice.roll() % 3) as usize;
            let mut datagram = match recorded.get(dice.roll() as usize % recorded.len().max(1)) {
                Some(datagram) if kind < 2 => datagram.clone(),
                // Nothing to send again: that is not counted as if it were.
                None if kind < 2 => continue,
                _ => (0..dice.roll() % 1_400).map(|_| dice.roll() as u8).collect(),
            };
            if kind == 1 && !datagram.is_empty() {
                let at = dice.roll() as usize % datagram.len();
                datagram[at] ^= 1 << (dice.roll() % 8);
            }
            let to = (dice.roll() % 3) as usize;
            // What the network does not take is not sent again.
            match socket.send_to(&datagram, scene.target.datagrams[to]) {
                Ok(_) => sent.counts[kind][to] += 1,
                Err(error) => sent.errors[to] = Some(error),
            }
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    sent
}

/// What passes on this host's interface of discovery, to the group or to one node, until it is over.
pub(in super::super) fn listen(group: SocketAddrV4, over: &AtomicBool) -> Recording {
    /// All of the host's packets, those that it sends too (`ETH_P_ALL`), which the system takes in the network's order.
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

/// The UDP datagram in an IPv4 packet to one of these ports, and to whom it is.
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
