//! Who hears the robot's datagrams of discovery, and sends them again.

use std::{
    net::{Ipv4Addr, UdpSocket},
    time::{Duration, Instant},
};

use socket2::{Domain, Protocol, Socket, Type};

use super::{super::robot::NDL_PORT, Happened, Scene};
use crate::dice::Dice;

/// How long is recorded, and how much at most.
const RECORDING: Duration = Duration::from_secs(1);
const KEPT: usize = 256;
/// Datagrams each millisecond.
const AT_ONCE: usize = 4;

pub(super) fn replayed_and_forged(scene: &Scene<'_>) -> Happened {
    let sent = scene.on_threads(1, |_| {
        let recorded = record(scene);
        let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, NDL_PORT)).expect("the attacker's own port");
        let mut dice = Dice::new(7);
        let mut sent = [0_u64; 3];
        while !scene.is_over() {
            for _ in 0..AT_ONCE {
                let kind = (dice.roll() % 3) as usize;
                let mut datagram = match recorded.get(dice.roll() as usize % recorded.len().max(1)) {
                    Some(datagram) if kind < 2 => datagram.clone(),
                    _ => (0..dice.roll() % 1_400).map(|_| dice.roll() as u8).collect(),
                };
                if kind == 1 && !datagram.is_empty() {
                    let at = dice.roll() as usize % datagram.len();
                    datagram[at] ^= 1 << (dice.roll() % 8);
                }
                let to = if dice.once_in(2) { scene.robot.discovery() } else { scene.robot.group().into() };
                // What the network does not take is not sent again.
                sent[kind] += u64::from(socket.send_to(&datagram, to).is_ok());
            }
            std::thread::sleep(Duration::from_millis(1));
        }
        (recorded.len(), sent)
    });
    let (recorded, [again, changed, made_up]) = sent[0];
    let mut broken = Vec::new();
    if recorded == 0 {
        broken.push("nothing was recorded".to_owned());
    }
    let what = format!("{recorded} recorded; {again} sent again, {changed} changed, {made_up} made up");
    Happened { what, broken }
}

/// What the robot's nodes say to the group.
fn record(scene: &Scene<'_>) -> Vec<Vec<u8>> {
    let group = scene.robot.group();
    let socket = Socket::new(Domain::IPV4, Type::DGRAM, Some(Protocol::UDP)).expect("a socket");
    socket.set_reuse_address(true).expect("a socket");
    socket.bind(&group.into()).expect("the group's port");
    let own = super::super::keys::MALLORY.address();
    socket.join_multicast_v4(group.ip(), &own).expect("the attacker's own interface");
    let socket = UdpSocket::from(socket);
    socket.set_read_timeout(Some(Duration::from_millis(50))).expect("a socket");
    let (mut recorded, until) = (Vec::new(), Instant::now() + RECORDING);
    while Instant::now() < until && !scene.is_over() && recorded.len() < KEPT {
        let mut datagram = [0; 2_048];
        if let Ok(length) = socket.recv(&mut datagram) {
            recorded.push(datagram[..length].to_vec());
        }
    }
    recorded
}
