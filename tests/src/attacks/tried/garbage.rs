//! Who pours random bytes on every port, as fast as they go.

use std::{
    collections::BTreeMap,
    io::Write as _,
    net::{Ipv4Addr, TcpStream, UdpSocket},
    time::Duration,
};

use super::{
    Happened, Scene,
    credentials::{NOT_PROVEN, SECURITY},
    datagrams::NOT_OURS,
};
use crate::dice::Dice;

const THREADS: usize = 3;
/// The first bytes of a connection by TLS, and of one that is none.
const LIKE_TLS: [u8; 3] = [0x16, 3, 1];
const UNLIKE_TLS: [u8; 1] = [0];
const PATIENCE: Duration = Duration::from_millis(200);
/// Bytes of a datagram.
const DATAGRAM: usize = 1_200;

pub(super) fn pour(scene: &Scene<'_>) -> Happened {
    let poured = scene.on_threads(THREADS, |number| {
        let mut dice = Dice::new(number as u64 + 1);
        let garbage: Vec<u8> = (0..64 << 10).map(|_| dice.roll() as u8).collect();
        match number {
            0 => by_udp(scene, &garbage),
            1 => by_tcp(scene, &LIKE_TLS, &garbage, &mut dice),
            _ => by_tcp(scene, &UNLIKE_TLS, &garbage, &mut dice),
        }
    });
    let datagrams = poured[0];
    let bytes: u64 = poured[1..].iter().sum();
    let broken =
        if datagrams == 0 || bytes == 0 { vec!["nothing was poured".to_owned()] } else { Vec::new() };
    Happened {
        // What is no TLS; what looked like it and was none; what is no datagram of the project.
        refused: vec![(SECURITY, 1), (NOT_PROVEN, 1), (NOT_OURS, 1)],
        done: BTreeMap::from([("MiB by TCP", bytes >> 20), ("datagrams", datagrams)]),
        ..Happened::new(
            format!("{} MiB by TCP, {datagrams} datagrams of {DATAGRAM} bytes", bytes >> 20),
            broken,
        )
    }
}

/// Returns the datagrams.
fn by_udp(scene: &Scene<'_>, garbage: &[u8]) -> u64 {
    let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0)).expect("a port of the attacker's");
    let mut sent = 0_u64;
    while !scene.is_over() {
        let at = sent as usize * 7 % (garbage.len() - DATAGRAM);
        sent += u64::from(socket.send_to(&garbage[at..at + DATAGRAM], scene.target.datagrams[0]).is_ok());
    }
    sent
}

/// Begins each connection so. Returns the bytes.
fn by_tcp(scene: &Scene<'_>, first: &[u8], garbage: &[u8], dice: &mut Dice) -> u64 {
    let mut bytes = 0;
    while !scene.is_over() {
        let Ok(mut socket) = TcpStream::connect_timeout(&scene.target.connections, PATIENCE) else {
            continue;
        };
        // Whom nobody reads any more does not wait for ever.
        if socket.set_write_timeout(Some(PATIENCE)).is_err() {
            continue;
        }
        let at = dice.roll() as usize % 1_024;
        if socket.write_all(first).is_err() {
            continue;
        }
        while !scene.is_over() && socket.write_all(&garbage[at..]).is_ok() {
            bytes += (garbage.len() - at) as u64;
        }
    }
    bytes
}
