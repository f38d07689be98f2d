//! Who hears the robot's datagrams of discovery, and sends them again.

use std::{
    io,
    net::{Ipv4Addr, SocketAddrV4, UdpSocket},
    time::{Duration, Instant},
};

use socket2::{Domain, Protocol, Socket, Type};

use super::{
    super::{
        keys::MALLORY,
        robot::{NDL_PORT, Robot},
    },
    Happened, Scene,
};
use crate::dice::Dice;

/// How long is recorded, and how much at most.
const RECORDING: Duration = Duration::from_secs(1);
const KEPT: usize = 256;
/// Datagrams each millisecond.
const AT_ONCE: usize = 4;

/// What is sent.
const KINDS: [&str; 3] = ["sent again", "changed", "made up"];
/// Where to.
const DESTINATIONS: [&str; 2] = ["knee", "the group"];
/// The node's word for a datagram that nobody of its project has made, or that it has taken before.
pub(super) const NOT_OURS: &str = "NDL datagram not of this project's keys";

/// What the network took of each kind for each destination, and why it did not take the last one that it did not.
#[derive(Default)]
struct Sent {
    counts: [[u64; 2]; 3],
    errors: [Option<io::Error>; 2],
}

pub(super) fn replayed_and_forged(scene: &Scene<'_>) -> Happened {
    let sent = scene.on_threads(1, |_| send(scene)).pop().unwrap_or_default();
    let mut broken = Vec::new();
    if scene.recorded.is_empty() {
        broken.push("nothing was recorded".to_owned());
    }
    let mut what = vec![format!("{} recorded", scene.recorded.len())];
    for (kind, counts) in KINDS.iter().zip(sent.counts) {
        for ((destination, count), error) in DESTINATIONS.iter().zip(counts).zip(&sent.errors) {
            what.push(format!("{count} {kind} to {destination}"));
            if count == 0 {
                broken.push(format!("none was {kind} to {destination}: {error:?}"));
            }
        }
    }
    Happened { refused: vec![(NOT_OURS, 1)], ..Happened::new(what.join(", "), broken) }
}

fn send(scene: &Scene<'_>) -> Sent {
    let (recorded, mut dice, mut sent) = (&scene.recorded, Dice::new(7), Sent::default());
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
            let to_group = usize::from(dice.once_in(2));
            let to = [scene.robot.discovery(), scene.robot.group().into()][to_group];
            // What the network does not take is not sent again.
            match socket.send_to(&datagram, to) {
                Ok(_) => sent.counts[kind][to_group] += 1,
                Err(error) => sent.errors[to_group] = Some(error),
            }
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    sent
}

/// What the robot's nodes say to the group.
pub(in super::super) fn record(robot: &Robot) -> Vec<Vec<u8>> {
    let group = robot.group();
    let socket = Socket::new(Domain::IPV4, Type::DGRAM, Some(Protocol::UDP)).expect("a socket");
    socket.set_reuse_address(true).expect("a socket");
    socket.bind(&group.into()).expect("the group's port");
    socket.join_multicast_v4(group.ip(), &MALLORY.address()).expect("the attacker's own interface");
    let socket = UdpSocket::from(socket);
    socket.set_read_timeout(Some(Duration::from_millis(50))).expect("a socket");
    let (mut recorded, until) = (Vec::new(), Instant::now() + RECORDING);
    while Instant::now() < until && recorded.len() < KEPT {
        let mut datagram = [0; 2_048];
        if let Ok(length) = socket.recv(&mut datagram) {
            recorded.push(datagram[..length].to_vec());
        }
    }
    recorded
}
