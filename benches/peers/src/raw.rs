//! The primitives of the system: a ring in shared memory, a unix stream, TCP.

use std::os::unix::net::UnixStream;

use sinew_figures::{
    Figures, Pinning, Rounds,
    process::{Process, print_ready},
    stream,
};
use sinew_shm::bare::{self, End, Waiting};

use crate::path::{Path, echo_role};

fn waiting(path: Path) -> Waiting {
    if path == Path::BarePoll { Waiting::Poll } else { Waiting::Futex }
}

/// Round trips through a bare ring.
pub(crate) fn ring(path: Path, rounds: Rounds, pinning: Pinning) -> Figures {
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
    let (mut end, mut buffer) = (End::second(stream::input(), bytes, waiting(path)), vec![0; bytes]);
    print_ready();
    loop {
        end.receive(&mut buffer);
        end.send(&buffer);
    }
}

/// Round trips through a unix stream.
pub(crate) fn unix(rounds: Rounds, pinning: Pinning) -> Figures {
    let (ours, theirs) = UnixStream::pair().expect("a pair of sockets");
    let _echo = Process::start_on(&echo_role(Path::UnixStream, rounds.bytes, pinning, "-"), theirs.into());
    stream::round_trips(ours, rounds)
}

/// Round trips through TCP.
pub(crate) fn tcp(rounds: Rounds, pinning: Pinning) -> Figures {
    let (ours, theirs) = stream::tcp_pair();
    let _echo = Process::start_on(&echo_role(Path::Tcp, rounds.bytes, pinning, "-"), theirs.into());
    stream::round_trips(ours, rounds)
}
