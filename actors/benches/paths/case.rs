//! The cases: which path, which payload, which reference.

use std::os::unix::net::UnixStream;

use sinew_figures::{Beside, End, Figures, Pinning, process::Process, stream};

use crate::{raw, rounds, sinew_ends};

/// A path with its reference.
pub(crate) struct Case {
    pub(crate) name: &'static str,
    path: Path,
    payload_bytes: usize,
    reference: &'static str,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Path {
    /// Two applications on one thread of one node; reference: actix's `Addr::send` on one arbiter.
    SameThread,
    /// Two applications of one node, each on its own thread; reference: actix's `Addr::send` across arbiters.
    TwoThreads,
    /// An application of a node and an endpoint in another process; reference: a raw unix stream.
    TwoProcesses,
    /// An application of a node and another one in a process of its own; reference: a raw unix stream.
    OwnProcess,
}

pub(crate) const CASES: &[Case] = &[
    Case {
        name: "same_thread_8",
        path: Path::SameThread,
        payload_bytes: 8,
        reference: "actix_send_same_arbiter",
    },
    Case {
        name: "same_thread_1000",
        path: Path::SameThread,
        payload_bytes: 1000,
        reference: "actix_send_same_arbiter",
    },
    Case {
        name: "two_threads_1000",
        path: Path::TwoThreads,
        payload_bytes: 1000,
        reference: "actix_send_two_arbiters",
    },
    Case {
        name: "two_processes_8",
        path: Path::TwoProcesses,
        payload_bytes: 8,
        reference: "raw_unix_stream",
    },
    Case {
        name: "two_processes_1000",
        path: Path::TwoProcesses,
        payload_bytes: 1000,
        reference: "raw_unix_stream",
    },
    Case {
        name: "two_processes_65536",
        path: Path::TwoProcesses,
        payload_bytes: 65_536,
        reference: "raw_unix_stream",
    },
    Case {
        name: "own_process_1000",
        path: Path::OwnProcess,
        payload_bytes: 1000,
        reference: "raw_unix_stream",
    },
];

/// The measuring end.
pub(crate) fn measure(name: &str, pinning: &str) {
    let case = CASES.iter().find(|case| case.name == name).expect("a name that this program wrote itself");
    let pinning = Pinning::named(pinning);
    let bytes = case.payload_bytes;
    let (seen, reference) = match case.path {
        Path::SameThread => {
            (sinew_ends::in_process(bytes, pinning, true), raw::actix_send(bytes, pinning, true))
        }
        Path::TwoThreads => {
            (sinew_ends::in_process(bytes, pinning, false), raw::actix_send(bytes, pinning, false))
        }
        Path::TwoProcesses => (two_processes(bytes, pinning), raw_unix(bytes, pinning)),
        // The process of the application runs this program up to the start of its node, and no reference.
        Path::OwnProcess => (own_process(bytes, pinning), raw_unix(bytes, pinning)),
    };
    Beside {
        bench: "paths",
        case: case.name,
        payload_bytes: bytes,
        pinning: pinning.name(),
        pace: "back_to_back",
        seen: &seen,
        reference: case.reference,
        raw: &reference,
        counts: &[],
    }
    .report();
}

/// The echoing end, in a process of its own: prints a line when it can be reached, ends when its input does.
pub(crate) fn echo(kind: &str, pinning: &str, at: &str) {
    Pinning::named(pinning).pin(End::Echoing);
    match kind {
        "raw_unix" => stream::echo(number(at)),
        "endpoint" => sinew_ends::echo_endpoint(at),
        _ => eprintln!("no such echo: {kind}"),
    }
}

fn number(word: &str) -> usize {
    word.parse().expect("a number that this program wrote itself")
}

fn raw_unix(bytes: usize, pinning: Pinning) -> Figures {
    pinning.pin(End::Measuring);
    let (ours, theirs) = UnixStream::pair().expect("a pair of sockets");
    let _echo = Process::start_on(&format!("echo raw_unix {} {bytes}", pinning.name()), theirs.into());
    stream::round_trips(ours, rounds(bytes))
}

fn two_processes(bytes: usize, pinning: Pinning) -> Figures {
    pinning.pin(End::Measuring);
    let path = std::env::temp_dir().join(format!("sinew-paths-lncl-{}", std::process::id()));
    let role = format!("echo endpoint {} {}", pinning.name(), path.display());
    sinew_ends::through_lncl(&path, bytes, || Process::start(&role))
}

fn own_process(bytes: usize, pinning: Pinning) -> Figures {
    pinning.pin(End::Measuring);
    sinew_ends::to_own_process(bytes, pinning)
}
