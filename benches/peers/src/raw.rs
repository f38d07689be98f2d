//! What the system itself gives: a ring in shared memory, a unix stream, TCP.

use std::{
    io::{Read, Write},
    net::{Ipv4Addr, TcpListener, TcpStream},
    os::{
        fd::{AsFd, OwnedFd},
        unix::net::UnixStream,
    },
};

use sinew_figures::Pinning;
use sinew_shm::bare::{self, End, Waiting};

use crate::{
    path::{Path, echo_role},
    processes::{Process, say_there},
    rounds::{Rounds, Times},
};

fn waiting(path: Path) -> Waiting {
    if path == Path::BarePoll { Waiting::Poll } else { Waiting::Futex }
}

/// Round trips through a bare ring.
pub(crate) fn ring(path: Path, rounds: Rounds, pinning: Pinning) -> Times {
    let memory = bare::memory(rounds.bytes);
    let mut end = End::first(&memory, rounds.bytes, waiting(path));
    let _echo = Process::start_on(&echo_role(path, rounds.bytes, pinning, "-"), memory);
    let mut buffer = vec![7; rounds.bytes];
    rounds.time(|| {
        end.send(&buffer);
        end.receive(&mut buffer);
    })
}

/// The other end of a bare ring, which lies in this process's input.
pub(crate) fn echo_ring(path: Path, bytes: usize) {
    let (mut end, mut buffer) = (End::second(input(), bytes, waiting(path)), vec![0; bytes]);
    say_there();
    loop {
        end.receive(&mut buffer);
        end.send(&buffer);
    }
}

/// Round trips through a unix stream.
pub(crate) fn unix(rounds: Rounds, pinning: Pinning) -> Times {
    let (ours, theirs) = UnixStream::pair().expect("a pair of sockets");
    let _echo = Process::start_on(&echo_role(Path::UnixStream, rounds.bytes, pinning, "-"), theirs.into());
    stream(ours, rounds)
}

/// Round trips through TCP.
pub(crate) fn tcp(rounds: Rounds, pinning: Pinning) -> Times {
    let (ours, theirs) = tcp_pair();
    let _echo = Process::start_on(&echo_role(Path::Tcp, rounds.bytes, pinning, "-"), theirs.into());
    stream(ours, rounds)
}

/// Two connected sockets on the loopback interface.
pub(crate) fn tcp_pair() -> (TcpStream, TcpStream) {
    let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).expect("a free port");
    let ours = TcpStream::connect(listener.local_addr().expect("it is bound")).expect("it listens");
    let (theirs, _) = listener.accept().expect("the one that has connected");
    for stream in [&ours, &theirs] {
        stream.set_nodelay(true).expect("TCP has no delay");
    }
    (ours, theirs)
}

fn stream(mut stream: impl Read + Write, rounds: Rounds) -> Times {
    let mut buffer = vec![7; rounds.bytes];
    rounds.time(|| {
        stream.write_all(&buffer).expect("the echo reads");
        stream.read_exact(&mut buffer).expect("the echo answers");
    })
}

/// The other end of a stream, which is this process's input.
pub(crate) fn echo_stream(bytes: usize) {
    // Reading and writing are the same for both sorts of streams.
    let (mut stream, mut buffer) = (UnixStream::from(input()), vec![0; bytes]);
    say_there();
    while stream.read_exact(&mut buffer).and_then(|()| stream.write_all(&buffer)).is_ok() {}
}

/// What this process was given as its input.
pub(crate) fn input() -> OwnedFd {
    std::io::stdin().as_fd().try_clone_to_owned().expect("a descriptor")
}
