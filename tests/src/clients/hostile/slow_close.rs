//! Descriptors that block on close, passed in every place where the node or a host may receive them: before a
//! registration, beside a frame, on a bell, in place of an offer. Closing one blocks until its other end is
//! closed, which the scenario controls.
//!
//! If the kernel can refuse descriptors (Linux 6.16 and later), they arrive only in place of an offer.

use std::{
    collections::VecDeque,
    io::{self, ErrorKind, Write},
    net::{Ipv4Addr, SocketAddr, TcpListener, TcpStream},
    os::{fd::OwnedFd, unix::net::UnixStream},
    sync::atomic::{AtomicBool, Ordering},
    thread,
    time::{Duration, Instant},
};

use rustix::net::{
    AddressFamily, SendFlags, SocketFlags, SocketType, socketpair,
    sockopt::{set_socket_linger, set_socket_recv_buffer_size, set_socket_send_buffer_size},
};
use sinew_shm::Offer;

use super::raw_connection::pass_by;

/// Time that the other end is kept open: longer than any allowed delay.
pub(super) const KEPT: Duration = Duration::from_secs(3);
/// Interval between checks for new and expired ends.
const POLL_INTERVAL: Duration = Duration::from_millis(20);
/// Maximum number of ends kept at the same time. Above it the oldest is closed early.
const KEPT_MAX: usize = 1_024;

/// Owned by the scenario: keeps the other ends open.
pub(crate) struct Keeper(TcpListener);

impl Keeper {
    /// Listens on loopback.
    pub(crate) fn new() -> Self {
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).expect("a port on loopback");
        listener.set_nonblocking(true).expect("a port on loopback");
        // Small receive buffer, so that a connection without a reader fills up soon.
        set_socket_recv_buffer_size(&listener, 4_096).expect("a port on loopback");
        Self(listener)
    }

    pub(crate) fn port(&self) -> u16 {
        self.0.local_addr().expect("a port on loopback").port()
    }

    /// Keeps each end open for its time, until `over`.
    pub(crate) fn keep(&self, over: &AtomicBool) {
        let mut kept = VecDeque::new();
        while !over.load(Ordering::Relaxed) {
            while let Ok((end, _)) = self.0.accept() {
                kept.push_back((Instant::now(), end));
            }
            while kept.front().is_some_and(|(since, _)| since.elapsed() >= KEPT) || kept.len() > KEPT_MAX {
                kept.pop_front();
            }
            thread::sleep(POLL_INTERVAL);
        }
        // Drains connections of the last moment: closing one blocks as long as its other end is open here.
        while self.0.accept().is_ok() {}
    }
}

/// The result of passing a descriptor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Passed {
    /// It was sent.
    Sent,
    /// The system refused it.
    Refused,
}

/// A connection that blocks on its last close until the keeper closes its end.
struct SlowClose(TcpStream);

impl SlowClose {
    fn connect(keeper: u16) -> io::Result<Self> {
        let mut stream = TcpStream::connect(SocketAddr::from((Ipv4Addr::LOCALHOST, keeper)))?;
        set_socket_send_buffer_size(&stream, 16 * 1_024)?;
        stream.set_nonblocking(true)?;
        let chunk = [0; 4 * 1_024];
        loop {
            match stream.write(&chunk) {
                Ok(_) => {}
                Err(error) if error.kind() == ErrorKind::WouldBlock => break,
                Err(error) => return Err(error),
            }
        }
        set_socket_linger(&stream, Some(Duration::from_secs(3_600)))?;
        Ok(Self(stream))
    }
}

/// Passes one with `bytes`, and keeps no copy.
pub(super) fn pass_slow_close(keeper: u16, socket: &UnixStream, bytes: &[u8]) -> io::Result<Passed> {
    pass_copies(keeper, socket, bytes, 1)
}

/// The same with the last byte as urgent data. A reader that peeks skips this byte, and the descriptor too if
/// it is the only byte.
pub(super) fn pass_urgent(keeper: u16, socket: &UnixStream, bytes: &[u8]) -> io::Result<Passed> {
    pass_copies_by(SendFlags::OOB, keeper, socket, bytes, 1)
}

/// Passes one with `bytes` in `count` copies, and keeps none.
pub(super) fn pass_copies(
    keeper: u16,
    socket: &UnixStream,
    bytes: &[u8],
    count: usize,
) -> io::Result<Passed> {
    pass_copies_by(SendFlags::empty(), keeper, socket, bytes, count)
}

fn pass_copies_by(
    flags: SendFlags,
    keeper: u16,
    socket: &UnixStream,
    bytes: &[u8],
    count: usize,
) -> io::Result<Passed> {
    let connection = SlowClose::connect(keeper)?.0;
    let copies: Vec<OwnedFd> =
        (0..count).map(|_| Ok(connection.try_clone()?.into())).collect::<io::Result<_>>()?;
    let passed = pass_by(flags, socket, bytes, &copies);
    let is_refused = |error: &io::Error| error.raw_os_error() == Some(rustix::io::Errno::PERM.raw_os_error());
    let result = match passed {
        Ok(()) => Ok(Passed::Sent),
        Err(error) if is_refused(&error) => Ok(Passed::Refused),
        Err(error) => Err(error),
    };
    if !matches!(result, Ok(Passed::Sent)) {
        set_socket_linger(&connection, None)?;
    }
    // The victim may have closed its copy, so that this is the last one. The close then must not block the
    // hostile client either.
    thread::spawn(move || drop((copies, connection)));
    result
}

/// An offer like `model`, with a slow-closing descriptor already queued on its message bell.
pub(super) fn offer_with_full_bells(keeper: u16, model: &Offer) -> io::Result<(Offer, Vec<OwnedFd>)> {
    let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
    let pair = || socketpair(AddressFamily::UNIX, SocketType::STREAM, flags, None);
    let ((message, message_ear), (room, room_ear)) = (pair()?, pair()?);
    let ear = UnixStream::from(message_ear);
    pass_slow_close(keeper, &ear, b"1")?;
    let memory = model.descriptors()[0].try_clone()?;
    let offer =
        Offer::from_parts(&model.to_bytes(), vec![memory, message, room]).map_err(io::Error::other)?;
    Ok((offer, vec![ear.into(), room_ear]))
}

#[cfg(test)]
mod tests {
    use std::io::Read;

    use super::*;

    #[test]
    fn keeper_drops_late_connections_when_it_stops() {
        let keeper = Keeper::new();
        let passed = SlowClose::connect(keeper.port()).expect("it listens");
        keeper.keep(&AtomicBool::new(true));
        passed.0.set_nonblocking(false).expect("a connection");
        passed.0.set_read_timeout(Some(Duration::from_secs(60))).expect("a connection");
        let ended = (&passed.0).read(&mut [0; 1]).map_err(|error| error.kind());
        assert!(matches!(ended, Ok(0) | Err(ErrorKind::ConnectionReset)), "{ended:?}");
    }
}
