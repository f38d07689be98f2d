//! An attacker that sends so slowly that the handshake never completes.

use std::{
    io::{self, Read as _, Write as _},
    net::TcpStream,
    time::{Duration, Instant},
};

use super::{super::raw_peer::client, Happened, Scene, done, handshakes::beginning};

const CONNECTIONS: usize = 256;
/// Number of connections to a node that accepts 64 unauthenticated ones.
const FEW: usize = 48;
/// Deadline for the node to close each of these: many times `gncl.handshake`, for a shared machine.
const CLOSED: Duration = Duration::from_secs(30);
const PACE: Duration = Duration::from_millis(100);
const TIMEOUT: Duration = Duration::from_millis(200);

pub(super) fn drip(scene: &Scene<'_>) -> Happened {
    let beginning = beginning(&client(None));
    let until = Instant::now() + scene.lasts / 2;
    let seen = scene.on_threads(1, |_| {
        let many = come_again(scene, &beginning, until);
        (many, few(scene, &beginning))
    });
    let ((made, bytes), Few { open, longest, error }) = &seen[0];
    let mut broken = Vec::new();
    if *bytes == 0 {
        broken.push("nothing was sent".to_owned());
    }
    if *open > 0 {
        broken.push(format!("{open} of {FEW} slow connections were not closed within {CLOSED:?}"));
    }
    broken.extend(error.iter().map(|error| format!("{FEW} connections were not made: {error}")));
    Happened {
        // Some of them may connect before the node has noticed that the many others are closed.
        refused: vec![("too late", FEW as u64 / 2)],
        ..Happened::new(
            format!(
                "{made} connections, {bytes} bytes, one at a time; {} of {FEW} closed by the node, the last after {} ms",
                FEW - open,
                longest.as_millis()
            ),
            broken,
        )
    }
}

/// Only the many connections, for the duration of the scene.
pub(super) fn drip_from_many(scene: &Scene<'_>) -> Happened {
    let (beginning, until) = (beginning(&client(None)), Instant::now() + scene.lasts);
    let seen = scene.on_threads(1, |_| come_again(scene, &beginning, until));
    let (made, bytes) = seen[0];
    let what = format!("{made} connections, {bytes} bytes, one at a time");
    Happened { done: done("connections", made), ..Happened::new(what, Vec::new()) }
}

/// So many connections that the node has to choose which one to close. Returns the number of connections and
/// of bytes.
fn come_again(scene: &Scene<'_>, beginning: &[u8], until: Instant) -> (u64, u64) {
    let mut connections: Vec<Option<(TcpStream, usize)>> = (0..CONNECTIONS).map(|_| None).collect();
    let (mut made, mut bytes) = (0_u64, 0_u64);
    while !scene.is_over() && Instant::now() < until {
        for place in &mut connections {
            if place.is_none() {
                *place = TcpStream::connect_timeout(&scene.target.connections, TIMEOUT)
                    .ok()
                    .map(|socket| (socket, 0));
                made += u64::from(place.is_some());
            }
            let Some((socket, sent)) = place else { continue };
            let byte = beginning.get(*sent..=*sent).unwrap_or(&[0]);
            if socket.write_all(byte).is_ok() {
                *sent += 1;
                bytes += 1;
            } else {
                // The node has closed it: the attacker reconnects.
                *place = None;
            }
        }
        scene.rest(PACE);
    }
    (made, bytes)
}

/// The fate of the connections that the node has room for.
#[derive(Default)]
struct Few {
    /// Still open at the end.
    open: usize,
    /// Time until the last of them was closed.
    longest: Duration,
    /// The reason if not all were opened.
    error: Option<io::Error>,
}

/// Fewer connections than the node accepts unauthenticated ones. Only its handshake deadline closes these,
/// even after the scene is over.
fn few(scene: &Scene<'_>, beginning: &[u8]) -> Few {
    let mut seen = Few::default();
    let mut connections = Vec::new();
    for _ in 0..FEW {
        match TcpStream::connect_timeout(&scene.target.connections, CLOSED).and_then(|socket| {
            socket.set_nonblocking(true)?;
            Ok(socket)
        }) {
            Ok(socket) => connections.push(socket),
            Err(error) => seen.error = Some(error),
        }
    }
    let began = Instant::now();
    for byte in beginning.iter().cycle() {
        connections.retain_mut(|socket| {
            let is_open = socket.write_all(&[*byte]).is_ok() && !is_ended(socket);
            if !is_open {
                seen.longest = began.elapsed();
            }
            is_open
        });
        if connections.is_empty() || began.elapsed() > CLOSED {
            break;
        }
        std::thread::sleep(PACE);
    }
    seen.open = connections.len();
    seen
}

/// Returns whether the peer has closed the connection.
fn is_ended(socket: &mut TcpStream) -> bool {
    match socket.read(&mut [0; 256]) {
        Ok(count) => count == 0,
        Err(error) => error.kind() != io::ErrorKind::WouldBlock,
    }
}
