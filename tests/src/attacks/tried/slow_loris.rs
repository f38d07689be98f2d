//! Who speaks so slowly that he never comes to an end.

use std::{
    io::{self, Read as _, Write as _},
    net::TcpStream,
    time::{Duration, Instant},
};

use super::{super::stranger::client, Happened, Scene, done, handshakes::beginning};

const CONNECTIONS: usize = 256;
/// Of a node that takes 64 strangers.
const FEW: usize = 48;
/// Until when each of these must be closed: many times `gncl.handshake`, on a machine that is shared.
const CLOSED: Duration = Duration::from_secs(30);
const PACE: Duration = Duration::from_millis(100);
const PATIENCE: Duration = Duration::from_millis(200);

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
        broken.push("nothing was said".to_owned());
    }
    if *open > 0 {
        broken.push(format!("{open} of {FEW} slow connections were not closed within {CLOSED:?}"));
    }
    broken.extend(error.iter().map(|error| format!("{FEW} connections were not made: {error}")));
    Happened {
        // Some of them may come before the node knows that the many have gone.
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

/// The many alone, for as long as the scene lasts.
pub(super) fn drip_from_many(scene: &Scene<'_>) -> Happened {
    let (beginning, until) = (beginning(&client(None)), Instant::now() + scene.lasts);
    let seen = scene.on_threads(1, |_| come_again(scene, &beginning, until));
    let (made, bytes) = seen[0];
    let what = format!("{made} connections, {bytes} bytes, one at a time");
    Happened { done: done("connections", made), ..Happened::new(what, Vec::new()) }
}

/// So many that the node has to choose whom it closes. Returns the connections and the bytes.
fn come_again(scene: &Scene<'_>, beginning: &[u8], until: Instant) -> (u64, u64) {
    let mut connections: Vec<Option<(TcpStream, usize)>> = (0..CONNECTIONS).map(|_| None).collect();
    let (mut made, mut bytes) = (0_u64, 0_u64);
    while !scene.is_over() && Instant::now() < until {
        for place in &mut connections {
            if place.is_none() {
                *place = TcpStream::connect_timeout(&scene.target.connections, PATIENCE)
                    .ok()
                    .map(|socket| (socket, 0));
                made += u64::from(place.is_some());
            }
            let Some((socket, said)) = place else { continue };
            let byte = beginning.get(*said..=*said).unwrap_or(&[0]);
            if socket.write_all(byte).is_ok() {
                *said += 1;
                bytes += 1;
            } else {
                // The node has closed it: he comes again.
                *place = None;
            }
        }
        scene.rest(PACE);
    }
    (made, bytes)
}

/// What became of those that the node has room for.
#[derive(Default)]
struct Few {
    /// Still open at the end.
    open: usize,
    /// Until the last of them was closed.
    longest: Duration,
    /// Why not all were made.
    error: Option<io::Error>,
}

/// Fewer than the node has places for strangers: only its deadline for a handshake ends these, whether the scene is over or not.
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

/// The other end has closed it.
fn is_ended(socket: &mut TcpStream) -> bool {
    match socket.read(&mut [0; 256]) {
        Ok(count) => count == 0,
        Err(error) => error.kind() != io::ErrorKind::WouldBlock,
    }
}
