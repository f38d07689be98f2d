//! Descriptors that take for ever to close, passed where the node or a host may find them: before a registration, beside a frame, on a
//! bell, where an offer is due. Who closes one waits until its other end is closed, and that is in the hands of the director.
//!
//! Where the kernel refuses them (Linux from 6.16 on) they only come where an offer is due.

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

use super::stranger::pass_by;

/// So long the other end is kept: longer than anybody may be held up.
pub(super) const KEPT: Duration = Duration::from_secs(3);
/// Time between two looks for new ones and old ones.
const LOOK: Duration = Duration::from_millis(20);
/// Ends that are kept at once. The oldest goes before its time where there are more.
const KEPT_MAX: usize = 1_024;

/// The director's: keeps the other ends.
pub(crate) struct Keeper(TcpListener);

impl Keeper {
    /// Listens on loopback.
    pub(crate) fn new() -> Self {
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).expect("a port on loopback");
        listener.set_nonblocking(true).expect("a port on loopback");
        // So little is taken, though nobody reads.
        set_socket_recv_buffer_size(&listener, 4_096).expect("a port on loopback");
        Self(listener)
    }

    pub(crate) fn port(&self) -> u16 {
        self.0.local_addr().expect("a port on loopback").port()
    }

    /// Keeps each end for its time, until it is told not to.
    pub(crate) fn keep(&self, over: &AtomicBool) {
        let mut kept = VecDeque::new();
        while !over.load(Ordering::Relaxed) {
            while let Ok((end, _)) = self.0.accept() {
                kept.push_back((Instant::now(), end));
            }
            while kept.front().is_some_and(|(since, _)| since.elapsed() >= KEPT) || kept.len() > KEPT_MAX {
                kept.pop_front();
            }
            thread::sleep(LOOK);
        }
        // Those of the last moment: whoever closes one waits as long as nobody has it here.
        while self.0.accept().is_ok() {}
    }
}

/// What became of one that was passed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Passed {
    /// It is on its way.
    Came,
    /// The system has refused it.
    Refused,
}

/// A connection whose last close waits for the keeper.
struct Lingering(TcpStream);

impl Lingering {
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
pub(super) fn pass_lingering(keeper: u16, socket: &UnixStream, bytes: &[u8]) -> io::Result<Passed> {
    pass_copies(keeper, socket, bytes, 1)
}

/// The same, the last byte urgent: who looks at what is there passes that over, and the descriptor where it is the only byte.
pub(super) fn pass_urgent(keeper: u16, socket: &UnixStream, bytes: &[u8]) -> io::Result<Passed> {
    pass_copies_by(SendFlags::OOB, keeper, socket, bytes, 1)
}

/// Passes one with `bytes` in so many copies, and keeps none.
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
    let lingering = Lingering::connect(keeper)?.0;
    let copies: Vec<OwnedFd> =
        (0..count).map(|_| Ok(lingering.try_clone()?.into())).collect::<io::Result<_>>()?;
    let passed = pass_by(flags, socket, bytes, &copies);
    let is_refused = |error: &io::Error| error.raw_os_error() == Some(rustix::io::Errno::PERM.raw_os_error());
    let became = match passed {
        Ok(()) => Ok(Passed::Came),
        Err(error) if is_refused(&error) => Ok(Passed::Refused),
        Err(error) => Err(error),
    };
    if !matches!(became, Ok(Passed::Came)) {
        set_socket_linger(&lingering, None)?;
    }
    // The victim may have closed its copy, so that this is the last one: then the hostile one does not wait either.
    thread::spawn(move || drop((copies, lingering)));
    became
}

/// An offer like `model` whose bell for messages has one in it already.
pub(super) fn offer_with_full_bells(keeper: u16, model: &Offer) -> io::Result<(Offer, Vec<OwnedFd>)> {
    let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
    let pair = || socketpair(AddressFamily::UNIX, SocketType::STREAM, flags, None);
    let ((message, message_ear), (room, room_ear)) = (pair()?, pair()?);
    let ear = UnixStream::from(message_ear);
    pass_lingering(keeper, &ear, b"1")?;
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
    fn of_what_was_passed_in_the_last_moment_nothing_is_kept_when_it_is_over() {
        let keeper = Keeper::new();
        let passed = Lingering::connect(keeper.port()).expect("it listens");
        keeper.keep(&AtomicBool::new(true));
        passed.0.set_nonblocking(false).expect("a connection");
        passed.0.set_read_timeout(Some(Duration::from_secs(60))).expect("a connection");
        let ended = (&passed.0).read(&mut [0; 1]).map_err(|error| error.kind());
        assert!(matches!(ended, Ok(0) | Err(ErrorKind::ConnectionReset)), "{ended:?}");
    }
}
