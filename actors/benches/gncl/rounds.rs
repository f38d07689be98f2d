//! Round trips between applications of two nodes, beside blocking TCP.

use std::time::Duration;

use sinew::prelude::*;
use sinew_figures::{
    Beside, Figures, Pinning, Rounds,
    process::{self, Process, await_end, print_ready},
    stream,
};

use crate::{
    keys::{self, FIRST, Keys, SECOND},
    nodes::At,
    ping::{self, DEADLINE},
};

/// Poll duration of a spinning thread: longer than the pause of paced round trips.
const SPIN: Duration = Duration::from_millis(2);

/// The placement of the two applications.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Thread {
    /// On the IO threads of their nodes.
    Io,
    /// The same, and these threads poll for a while before they sleep.
    IoSpin,
    /// On threads of their own.
    Own,
}

impl Thread {
    pub(crate) const ALL: [Self; 3] = [Self::Io, Self::IoSpin, Self::Own];

    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::Io => "io_thread",
            Self::IoSpin => "io_thread_spin",
            Self::Own => "own_thread",
        }
    }

    /// # Panics
    /// If there is none of that name.
    pub(crate) fn named(name: &str) -> Self {
        let found = Self::ALL.into_iter().find(|thread| thread.name() == name);
        found.expect("a name that this program wrote itself")
    }

    /// A thread that polls without sleeping needs a different CPU than its peer.
    pub(crate) fn spins(self) -> bool {
        self == Self::IoSpin
    }

    fn node(self, name: &str, at: At) -> NodeBuilder {
        let spin = if self.spins() { SPIN } else { Duration::ZERO };
        keys::node(at, name).configure(|config| config.gncl.spin = spin)
    }

    fn place<A>(self, app: AppSpec<A>) -> AppSpec<A>
    where
        A: Actor<Context = AppContext<A>>,
    {
        match self {
            Self::Io | Self::IoSpin => app.on_io_thread(),
            Self::Own => app.own_thread(),
        }
    }
}

/// Measures nodes with keys beside nodes without, and prints the line.
pub(crate) fn measure_secured(thread: Thread, rounds: Rounds, pinning: Pinning) {
    let at = At::loopback();
    let keys = Keys::make(at, &[("ping", FIRST), ("echo", SECOND)]);
    let (seen, sleeps) = between_nodes(at, thread, rounds, pinning);
    drop(keys);
    let (open, open_sleeps) = between_nodes(at, thread, rounds, pinning);
    Beside {
        bench: "gncl",
        case: &format!("secured_{}", thread.name()),
        payload_bytes: rounds.bytes,
        pinning: pinning.name(),
        pace: rounds.pace.name(),
        seen: &seen,
        reference: "open",
        raw: &open,
        counts: &[("sleeps", sleeps), ("reference_sleeps", open_sleeps)],
    }
    .report();
}

/// Measures both, and prints the line.
pub(crate) fn measure(thread: Thread, rounds: Rounds, pinning: Pinning) {
    let (seen, sleeps) = between_nodes(At::loopback(), thread, rounds, pinning);
    let (raw, raw_sleeps) = raw(rounds, pinning);
    Beside {
        bench: "gncl",
        case: thread.name(),
        payload_bytes: rounds.bytes,
        pinning: pinning.name(),
        pace: rounds.pace.name(),
        seen: &seen,
        reference: "raw_tcp",
        raw: &raw,
        counts: &[("sleeps", sleeps), ("reference_sleeps", raw_sleeps)],
    }
    .report();
}

/// Runs the measurement, and counts the sleeps of a thread of either process per message.
fn counting_sleeps(other: &Process, rounds: Rounds, measure: impl FnOnce() -> Figures) -> (Figures, f64) {
    let sleeps = || process::sleeps() + other.sleeps();
    let before = sleeps();
    let figures = measure();
    let messages = 2 * (rounds.warm_up + rounds.counted);
    (figures, (sleeps() - before) as f64 / f64::from(messages))
}

fn between_nodes(at: At, thread: Thread, rounds: Rounds, pinning: Pinning) -> (Figures, f64) {
    let role = format!("echo {} {} {}", thread.name(), pinning.name(), at.host(2));
    let echo = Process::start(&role);
    let (ping, figures) = ping::ping(rounds);
    let node = thread.node("ping", at).app(thread.place(ping)).start().expect("a node");
    let seen = counting_sleeps(&echo, rounds, || figures.recv_timeout(DEADLINE).expect("the rounds end"));
    node.stop();
    seen
}

/// The node that echoes, until its input ends.
pub(crate) fn echo(thread: Thread, at: At) {
    let _node = thread.node("echo", at).app(thread.place(ping::echo())).start().expect("a node");
    print_ready();
    await_end();
}

/// The same between two processes by bare sockets.
fn raw(rounds: Rounds, pinning: Pinning) -> (Figures, f64) {
    let (ours, theirs) = stream::tcp_pair();
    let echo = Process::start_on(&format!("raw_echo {} {}", rounds.bytes, pinning.name()), theirs.into());
    counting_sleeps(&echo, rounds, || stream::round_trips(ours, rounds))
}
