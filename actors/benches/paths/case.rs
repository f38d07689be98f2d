//! The cases: which path, which payload, which reference.

use std::{
    io::{BufRead, BufReader},
    process::{Child, Command, Stdio},
};

use sinew_figures::{Beside, End, Figures, Pinning};

use crate::{ROLE, raw, sinew_ends};

/// One path, measured against one reference.
pub(crate) struct Case {
    pub(crate) name: &'static str,
    path: Path,
    payload_bytes: usize,
    reference: &'static str,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Path {
    /// Two applications on one thread of one node; reference: actix's own `Addr::send` on one arbiter.
    SameThread,
    /// Two applications of one node, a thread each; reference: actix's own `Addr::send` across arbiters.
    TwoThreads,
    /// An application of a node and an endpoint in another process; reference: a raw unix stream.
    TwoProcesses,
    /// Applications of two nodes, each on its node's IO thread; reference: raw blocking TCP.
    TwoNodesIo,
    /// Applications of two nodes, each on a thread of its own; reference: raw blocking TCP.
    TwoNodesOwn,
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
    Case { name: "two_nodes_io_thread_8", path: Path::TwoNodesIo, payload_bytes: 8, reference: "raw_tcp" },
    Case {
        name: "two_nodes_io_thread_1000",
        path: Path::TwoNodesIo,
        payload_bytes: 1000,
        reference: "raw_tcp",
    },
    Case {
        name: "two_nodes_io_thread_65536",
        path: Path::TwoNodesIo,
        payload_bytes: 65_536,
        reference: "raw_tcp",
    },
    Case {
        name: "two_nodes_own_thread_1000",
        path: Path::TwoNodesOwn,
        payload_bytes: 1000,
        reference: "raw_tcp",
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
        Path::TwoProcesses => (two_processes(bytes, pinning), raw_pair("raw_unix", bytes, pinning)),
        Path::TwoNodesIo => (two_nodes("node_io", bytes, pinning), raw_pair("raw_tcp", bytes, pinning)),
        Path::TwoNodesOwn => (two_nodes("node_own", bytes, pinning), raw_pair("raw_tcp", bytes, pinning)),
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
    }
    .report();
}

/// The echoing end, in a process of its own: prints a line when it can be reached, ends when its input does.
pub(crate) fn echo(kind: &str, pinning: &str, at: &str) {
    let pinning = Pinning::named(pinning);
    pinning.pin(End::Echoing);
    match kind {
        "raw_unix" => raw::echo_unix(at),
        "raw_tcp" => raw::echo_tcp(),
        "endpoint" => sinew_ends::echo_endpoint(at),
        "node_io" => sinew_ends::echo_node(at, true),
        "node_own" => sinew_ends::echo_node(at, false),
        _ => eprintln!("no such echo: {kind}"),
    }
}

/// Another process of this program; it is ended when this is dropped.
pub(crate) struct Echo {
    child: Child,
    /// What it said when it could be reached.
    pub(crate) line: String,
}

impl Echo {
    fn start(kind: &str, at: &str, pinning: Pinning) -> Self {
        let program = std::env::current_exe().expect("this program has a path");
        let mut child = Command::new(program)
            .env(ROLE, format!("echo {kind} {} {at}", pinning.name()))
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .expect("a process for the other end");
        let mut line = String::new();
        let output = child.stdout.take().expect("its output is a pipe");
        BufReader::new(output).read_line(&mut line).expect("the other end says that it is there");
        Self { child, line: line.trim().to_owned() }
    }
}

impl Drop for Echo {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn raw_pair(kind: &str, bytes: usize, pinning: Pinning) -> Figures {
    let path = std::env::temp_dir().join(format!("sinew-paths-raw-{}", std::process::id()));
    let echo = Echo::start(kind, &path.to_string_lossy(), pinning);
    pinning.pin(End::Measuring);
    let figures = raw::measure(kind, &path, &echo.line, bytes);
    // Left by the echo, which was killed.
    let _ = std::fs::remove_file(path);
    figures
}

fn two_processes(bytes: usize, pinning: Pinning) -> Figures {
    pinning.pin(End::Measuring);
    let path = std::env::temp_dir().join(format!("sinew-paths-lncl-{}", std::process::id()));
    sinew_ends::through_lncl(&path, bytes, || Echo::start("endpoint", &path.to_string_lossy(), pinning))
}

fn two_nodes(kind: &str, bytes: usize, pinning: Pinning) -> Figures {
    pinning.pin(End::Measuring);
    let group =
        format!("239.255.83.{}:{}", std::process::id() % 200 + 1, 20_000 + std::process::id() % 20_000);
    let _echo = Echo::start(kind, &group, pinning);
    sinew_ends::between_nodes(&group, bytes, kind == "node_io")
}
