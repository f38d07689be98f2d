//! Who pours random bytes on every port, as fast as they go.

use std::{
    io::Write as _,
    net::{Ipv4Addr, TcpStream, UdpSocket},
    time::Duration,
};

use super::{Happened, Scene, datagrams::NOT_OURS};
use crate::dice::Dice;

const THREADS: usize = 3;
const PATIENCE: Duration = Duration::from_millis(200);
/// Bytes of a datagram.
const DATAGRAM: usize = 1_200;

pub(super) fn pour(scene: &Scene<'_>) -> Happened {
    let poured = scene.on_threads(THREADS, |number| {
        let mut dice = Dice::new(number as u64 + 1);
        let garbage: Vec<u8> = (0..64 << 10).map(|_| dice.roll() as u8).collect();
        if number == 0 { by_udp(scene, &garbage) } else { by_tcp(scene, &garbage, &mut dice) }
    });
    let datagrams = poured[0];
    let bytes: u64 = poured[1..].iter().sum();
    let broken =
        if datagrams == 0 || bytes == 0 { vec!["nothing was poured".to_owned()] } else { Vec::new() };
    Happened {
        refused: vec![(NOT_OURS, 1)],
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
        sent += u64::from(socket.send_to(&garbage[at..at + DATAGRAM], scene.robot.discovery()).is_ok());
    }
    sent
}

/// Returns the bytes.
fn by_tcp(scene: &Scene<'_>, garbage: &[u8], dice: &mut Dice) -> u64 {
    let mut bytes = 0;
    while !scene.is_over() {
        let Ok(mut socket) = TcpStream::connect_timeout(&scene.robot.knee(), PATIENCE) else { continue };
        // Whom nobody reads any more does not wait for ever.
        if socket.set_write_timeout(Some(PATIENCE)).is_err() {
            continue;
        }
        // Half of them look as TLS does at first.
        let at = dice.roll() as usize % 1_024;
        if dice.once_in(2) && socket.write_all(&[0x16, 3, 1]).is_err() {
            continue;
        }
        while !scene.is_over() && socket.write_all(&garbage[at..]).is_ok() {
            bytes += (garbage.len() - at) as u64;
        }
    }
    bytes
}
