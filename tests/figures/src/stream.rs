//! Round trips over operating-system streams: the references of most benches.

use std::{
    io::{Read, Write},
    net::{Ipv4Addr, TcpListener, TcpStream},
    os::{
        fd::{AsFd, OwnedFd},
        unix::net::UnixStream,
    },
};

use crate::{Figures, Rounds, process::print_ready};

/// Two connected TCP sockets on the loopback interface, with `TCP_NODELAY`.
///
/// # Panics
/// If the system cannot provide sockets.
#[must_use]
pub fn tcp_pair() -> (TcpStream, TcpStream) {
    let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).expect("a free port");
    let ours = TcpStream::connect(listener.local_addr().expect("it is bound")).expect("it listens");
    let (theirs, _) = listener.accept().expect("the one that has connected");
    for stream in [&ours, &theirs] {
        stream.set_nodelay(true).expect("TCP has no delay");
    }
    (ours, theirs)
}

/// The descriptor that this process received as its standard input.
///
/// # Panics
/// If no file descriptor is left.
#[must_use]
pub fn input() -> OwnedFd {
    std::io::stdin().as_fd().try_clone_to_owned().expect("a descriptor")
}

/// Runs round trips over a stream with a peer that [echoes](echo).
///
/// # Panics
/// If the peer closes the stream.
pub fn round_trips(mut stream: impl Read + Write, rounds: Rounds) -> Figures {
    let mut buffer = vec![7; rounds.bytes];
    rounds.time(|| {
        stream.write_all(&buffer).expect("the echo reads");
        stream.read_exact(&mut buffer).expect("the echo answers");
    })
}

/// Echoes all data from the stream on standard input, until the stream ends.
pub fn echo(bytes: usize) {
    // Reads and writes are the same system calls for both kinds of streams.
    let (mut stream, mut buffer) = (UnixStream::from(input()), vec![0; bytes]);
    print_ready();
    while stream.read_exact(&mut buffer).and_then(|()| stream.write_all(&buffer)).is_ok() {}
}
