//! An attacker that sends random bytes to every port, as fast as possible.

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
use sinew_testkit::random::SeededRandom;

const THREADS: usize = 3;
/// The first bytes of a TLS connection, and of one that is not TLS.
const LIKE_TLS: [u8; 3] = [0x16, 3, 1];
const UNLIKE_TLS: [u8; 1] = [0];
const TIMEOUT: Duration = Duration::from_millis(200);
/// Length of a datagram, in bytes.
const DATAGRAM: usize = 1_200;

pub(super) fn pour(scene: &Scene<'_>) -> Happened {
    let poured = scene.on_threads(THREADS, |number| {
        let mut random = SeededRandom::new(number as u64 + 1);
        let garbage: Vec<u8> = (0..64 << 10).map(|_| random.number() as u8).collect();
        match number {
            0 => by_udp(scene, &garbage),
            1 => by_tcp(scene, &LIKE_TLS, &garbage, &mut random),
            _ => by_tcp(scene, &UNLIKE_TLS, &garbage, &mut random),
        }
    });
    let datagrams = poured[0];
    let bytes: u64 = poured[1..].iter().sum();
    let broken =
        if datagrams == 0 || bytes == 0 { vec!["nothing was poured".to_owned()] } else { Vec::new() };
    Happened {
        // Connections that are not TLS, connections that only start like TLS, and datagrams of no known
        // project.
        refused: vec![(SECURITY, 1), (NOT_PROVEN, 1), (NOT_OURS, 1)],
        done: BTreeMap::from([("MiB by TCP", bytes >> 20), ("datagrams", datagrams)]),
        ..Happened::new(
            format!("{} MiB by TCP, {datagrams} datagrams of {DATAGRAM} bytes", bytes >> 20),
            broken,
        )
    }
}

/// Returns the number of datagrams.
fn by_udp(scene: &Scene<'_>, garbage: &[u8]) -> u64 {
    let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0)).expect("a port of the attacker's");
    let mut sent = 0_u64;
    while !scene.is_over() {
        let at = sent as usize * 7 % (garbage.len() - DATAGRAM);
        sent += u64::from(socket.send_to(&garbage[at..at + DATAGRAM], scene.target.datagrams[0]).is_ok());
    }
    sent
}

/// Starts each connection with `first`. Returns the number of bytes.
fn by_tcp(scene: &Scene<'_>, first: &[u8], garbage: &[u8], random: &mut SeededRandom) -> u64 {
    let mut bytes = 0;
    while !scene.is_over() {
        let Ok(mut socket) = TcpStream::connect_timeout(&scene.target.connections, TIMEOUT) else {
            continue;
        };
        // Bounded, so that a write to a peer that does not read does not block forever.
        if socket.set_write_timeout(Some(TIMEOUT)).is_err() {
            continue;
        }
        let at = random.number() as usize % 1_024;
        if socket.write_all(first).is_err() {
            continue;
        }
        while !scene.is_over() && socket.write_all(&garbage[at..]).is_ok() {
            bytes += (garbage.len() - at) as u64;
        }
    }
    bytes
}
