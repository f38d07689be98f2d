//! The cases: the end, the payload, the CPUs, the pace and the reference; and the two processes of each.

use std::{
    os::{fd::OwnedFd, unix::net::UnixStream},
    process::{Child, Command, Stdio},
};

use sinew_figures::{Beside, End as Side, Figures, Pinning};
use sinew_shm::bare::{End, Waiting, memory};

use crate::{bare, ours, pace::Pace, stream};

/// The environment variable that makes this program the echoing end.
pub(crate) const ROLE: &str = "SINEW_RING_ROLE";

/// How messages travel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Kind {
    Futex,
    EventFd,
    Socket,
    Spin,
    Adaptive,
    BareFutex,
    BarePoll,
    UnixStream,
}

impl Kind {
    const OURS: [Self; 5] = [Self::Futex, Self::EventFd, Self::Socket, Self::Spin, Self::Adaptive];
    const ALL: [Self; 8] = [
        Self::Futex,
        Self::EventFd,
        Self::Socket,
        Self::Spin,
        Self::Adaptive,
        Self::BareFutex,
        Self::BarePoll,
        Self::UnixStream,
    ];

    const fn name(self) -> &'static str {
        match self {
            Self::Futex => "shm_futex",
            Self::EventFd => "shm_eventfd",
            Self::Socket => "shm_socket",
            Self::Spin => "shm_spin",
            Self::Adaptive => "shm_adaptive",
            Self::BareFutex => "bare_futex",
            Self::BarePoll => "bare_poll",
            Self::UnixStream => "raw_unix_stream",
        }
    }

    const fn references(self) -> &'static [Self] {
        match self {
            Self::Futex => &[Self::BareFutex, Self::UnixStream],
            Self::EventFd => &[Self::BareFutex],
            Self::Socket => &[Self::UnixStream],
            Self::Spin | Self::Adaptive => &[Self::BarePoll],
            Self::BareFutex | Self::BarePoll | Self::UnixStream => &[],
        }
    }

    /// How the ends of the bare ring wait.
    const fn waiting(self) -> Waiting {
        if self.spins() { Waiting::Poll } else { Waiting::Futex }
    }

    /// Whether an end polls without sleeping: it then needs the other end on another CPU.
    const fn spins(self) -> bool {
        matches!(self, Self::Spin | Self::Adaptive | Self::BarePoll)
    }
}

/// One line of the output.
#[derive(Clone, Copy)]
pub(crate) struct Case {
    kind: Kind,
    reference: Kind,
    payload_bytes: usize,
    pinning: Pinning,
    pace: Pace,
}

impl Case {
    pub(crate) fn name(&self) -> String {
        let Self { kind, reference, payload_bytes, pinning, pace } = self;
        let (kind, reference) = (kind.name(), reference.name());
        format!("{kind} {reference} {payload_bytes}B {} {}", pinning.name(), pace.name())
    }
}

pub(crate) fn all() -> impl Iterator<Item = Case> {
    let places = [Pinning::OneCpu, Pinning::OneCpuEach].into_iter();
    let paces = [Pace::BackToBack, Pace::EveryMillisecond];
    places
        .flat_map(move |pinning| paces.map(|pace| (pinning, pace)))
        .flat_map(|(pinning, pace)| [8, 64, 1000, 65_536].map(|bytes| (pinning, pace, bytes)))
        // At a pace of one millisecond the payload hardly matters; one size is enough.
        .filter(|(_, pace, bytes)| *pace == Pace::BackToBack || *bytes == 1000)
        .flat_map(|(pinning, pace, payload_bytes)| {
            let pairs =
                Kind::OURS.into_iter().flat_map(|kind| kind.references().iter().map(move |r| (kind, *r)));
            pairs.map(move |(kind, reference)| Case { kind, reference, payload_bytes, pinning, pace })
        })
        .filter(|case| !(case.kind.spins() && case.pinning == Pinning::OneCpu))
}

pub(crate) fn run(case: Case) {
    let Case { kind, reference, payload_bytes, pinning, pace } = case;
    let raw = figures(reference, case);
    let seen = figures(kind, case);
    Beside {
        bench: "ring",
        case: kind.name(),
        payload_bytes,
        pinning: pinning.name(),
        pace: pace.name(),
        seen: &seen,
        reference: reference.name(),
        raw: &raw,
        counts: &[],
    }
    .report();
}

fn figures(kind: Kind, case: Case) -> Figures {
    case.pinning.pin(Side::Measuring);
    let (socket, theirs) = UnixStream::pair().expect("a pair of sockets");
    let (bytes, pace) = (case.payload_bytes, case.pace);
    match kind {
        Kind::BareFutex | Kind::BarePoll => {
            let memory = memory(bytes);
            let end = End::first(&memory, bytes, kind.waiting());
            let _echo = Echo::start(kind, case, memory);
            bare::measure(end, bytes, pace)
        }
        Kind::UnixStream => {
            let _echo = Echo::start(kind, case, theirs.into());
            stream::measure(socket, bytes, pace)
        }
        Kind::Futex | Kind::EventFd | Kind::Socket | Kind::Spin | Kind::Adaptive => {
            let _echo = Echo::start(kind, case, theirs.into());
            ours::measure(kind, &socket, bytes, pace)
        }
    }
}

/// The echoing end, in a process of its own, with the socket or the memory as its input.
pub(crate) fn echo(role: &str) {
    let words: Vec<&str> = role.split(' ').collect();
    let number =
        |index: usize| words[index].parse::<usize>().expect("a number that this program wrote itself");
    let kind = Kind::ALL.into_iter().find(|kind| kind.name() == words[0]);
    let (kind, bytes) = (kind.expect("a name that this program wrote itself"), number(1));
    Pinning::named(words[2]).pin(Side::Echoing);
    match kind {
        Kind::BareFutex | Kind::BarePoll => {
            bare::echo(End::second(rustix::stdio::stdin(), bytes, kind.waiting()), bytes);
        }
        Kind::UnixStream => stream::echo(bytes),
        Kind::Futex | Kind::EventFd | Kind::Socket | Kind::Spin | Kind::Adaptive => ours::echo(kind, bytes),
    }
}

/// Another process of this program; dropping it kills the process.
struct Echo(Child);

impl Echo {
    fn start(kind: Kind, case: Case, input: OwnedFd) -> Self {
        let program = std::env::current_exe().expect("this program has a path");
        let role = format!("{} {} {}", kind.name(), case.payload_bytes, case.pinning.name());
        let child = Command::new(program)
            .env(ROLE, role)
            .stdin(Stdio::from(input))
            .spawn()
            .expect("a process for the other end");
        Self(child)
    }
}

impl Drop for Echo {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}
