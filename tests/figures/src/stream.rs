//! What the system's own streams give: the references of most benches.

use std::{
    io::{Read, Write},
    net::{Ipv4Addr, TcpListener, TcpStream},
    os::{
        fd::{AsFd, OwnedFd},
        unix::net::UnixStream,
    },
};

use crate::{Figures, Rounds, process::say_there};

/// Two connected sockets on the loopback interface, without delay.
///
/// # Panics
/// If the system has none.
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

/// What this process was given as its input.
///
/// # Panics
/// If it has no descriptor left.
#[must_use]
pub fn input() -> OwnedFd {
    std::io::stdin().as_fd().try_clone_to_owned().expect("a descriptor")
}

/// Round trips through a stream with somebody who [echoes](echo).
///
/// # Panics
/// If the other end goes away.
pub fn round_trips(mut stream: impl Read + Write, rounds: Rounds) -> Figures {
    let mut buffer = vec![7; rounds.bytes];
    rounds.time(|| {
        stream.write_all(&buffer).expect("the echo reads");
        stream.read_exact(&mut buffer).expect("the echo answers");
    })
}

/// Sends back what comes through the stream that is this process's input, until that ends.
pub fn echo(bytes: usize) {
    // Reading and writing are the same for both sorts of streams.
    let (mut stream, mut buffer) = (UnixStream::from(input()), vec![0; bytes]);
    say_there();
    while stream.read_exact(&mut buffer).and_then(|()| stream.write_all(&buffer)).is_ok() {}
}
