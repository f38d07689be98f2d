//! The paths from one process to another, their groups for comparison, and the roles of the processes.

use std::process::Stdio;

use sinew_figures::{
    Beside, End, Figures, Pace, Pinning, Rounds,
    process::command,
    results::{CaseResult, Recorder},
    stream,
};

use crate::{
    applications, flood, iceoryx2, raw,
    shared_memory::{self, Way},
    zenoh,
};

/// A path.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Path {
    BareFutex,
    BarePoll,
    UnixStream,
    Iceoryx2Event,
    Iceoryx2Poll,
    Endpoints(Way),
    Tcp,
    Zenoh,
    /// Applications of two nodes, each on its node's IO thread.
    NodesIo,
    /// The same, each on a thread of its own.
    NodesOwn,
}

/// Paths that are compared; the first one is the reference.
const WOKEN: &[Path] = &[
    Path::BareFutex,
    Path::UnixStream,
    Path::Iceoryx2Event,
    Path::Endpoints(Way::Default),
    Path::Endpoints(Way::Direct),
    Path::Endpoints(Way::Ring),
    Path::Endpoints(Way::TaskDirect),
    Path::Endpoints(Way::TaskRing),
];
const POLLED: &[Path] = &[Path::BarePoll, Path::Iceoryx2Poll, Path::Endpoints(Way::DirectSpin)];
const BETWEEN_NODES: &[Path] = &[Path::Tcp, Path::Zenoh, Path::NodesIo, Path::NodesOwn];

impl Path {
    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::BareFutex => "bare_futex",
            Self::BarePoll => "bare_poll",
            Self::UnixStream => "unix_stream",
            Self::Iceoryx2Event => "iceoryx2_event",
            Self::Iceoryx2Poll => "iceoryx2_poll",
            Self::Endpoints(way) => way.name(),
            Self::Tcp => "tcp",
            Self::Zenoh => "zenoh",
            Self::NodesIo => "sinew_nodes_io_thread",
            Self::NodesOwn => "sinew_nodes_own_thread",
        }
    }

    fn named(name: &str) -> Self {
        let mut all = [WOKEN, POLLED, BETWEEN_NODES].into_iter().flatten().copied();
        all.find(|path| path.name() == name).expect("a name that this program wrote itself")
    }

    fn measure(self, rounds: Rounds, pinning: Pinning) -> Figures {
        match self {
            Self::BareFutex | Self::BarePoll => raw::ring(self, rounds, pinning),
            Self::UnixStream => raw::unix(rounds, pinning),
            Self::Tcp => raw::tcp(rounds, pinning),
            Self::Iceoryx2Event | Self::Iceoryx2Poll => iceoryx2::measure(self, rounds, pinning),
            Self::Endpoints(way) => shared_memory::measure(way, rounds, pinning),
            Self::Zenoh => zenoh::measure(rounds, pinning),
            Self::NodesIo | Self::NodesOwn => applications::measure(self, rounds, pinning),
        }
    }

    /// Runs the other end until the measuring one ends this process. `at` is their rendezvous.
    fn echo(self, bytes: usize, at: &str) {
        match self {
            Self::BareFutex | Self::BarePoll => raw::echo_ring(self, bytes),
            Self::UnixStream | Self::Tcp => stream::echo(bytes),
            Self::Iceoryx2Event | Self::Iceoryx2Poll => iceoryx2::echo(self, bytes, at),
            Self::Endpoints(way) => shared_memory::echo(way, at),
            Self::Zenoh => zenoh::echo(at),
            Self::NodesIo | Self::NodesOwn => applications::echo(self, at),
        }
    }
}

/// Returns the text that starts another process as the other end of a path.
pub(crate) fn echo_role(path: Path, bytes: usize, pinning: Pinning, at: &str) -> String {
    format!("echo {} {bytes} {} {at}", path.name(), pinning.name())
}

/// Paths compared at one payload, pace and pinning.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Case {
    group: &'static str,
    paths: &'static [Path],
    bytes: usize,
    pace: Pace,
    pinning: Pinning,
}

/// Every case.
pub(crate) fn cases() -> impl Iterator<Item = Case> {
    let groups = [("woken", WOKEN), ("polled", POLLED), ("between_nodes", BETWEEN_NODES)];
    groups.into_iter().flat_map(|(group, paths)| {
        Pinning::ALL
            .into_iter()
            // A thread that polls without sleeping needs a different CPU than its peer.
            .filter(move |pinning| !(group == "polled" && *pinning == Pinning::OneCpu))
            .flat_map(move |pinning| Pace::ALL.map(|pace| (pinning, pace)))
            .flat_map(move |(pinning, pace)| {
                [8, 1000, 65_536].map(|bytes| Case { group, paths, bytes, pace, pinning })
            })
            .filter(|case| case.pace == Pace::BackToBack || case.bytes == 1000)
    })
}

impl Case {
    pub(crate) fn name(&self) -> String {
        format!("{}-{}B-{}-{}", self.group, self.bytes, self.pace.name(), self.pinning.name())
    }

    /// Measures each path, and prints and records its figures. Returns whether all went well.
    pub(crate) fn run(&self, is_short: bool, recorder: &mut Recorder) -> bool {
        let Some(raw) = self.measure(self.paths[0], is_short) else { return false };
        let mut is_well = true;
        for path in self.paths {
            let seen = if *path == self.paths[0] { None } else { Some(self.measure(*path, is_short)) };
            match seen {
                None => self.report(*path, &raw, &raw, recorder),
                Some(Some(seen)) => self.report(*path, &seen, &raw, recorder),
                Some(None) => is_well = false,
            }
        }
        is_well
    }

    fn measure(&self, path: Path, is_short: bool) -> Option<Figures> {
        let (name, pace, pinning) = (path.name(), self.pace.name(), self.pinning.name());
        let role = format!("measure {name} {} {pace} {pinning} {is_short}", self.bytes);
        let output = command(&role).stdin(Stdio::null()).stderr(Stdio::piped()).output().ok()?;
        let figures =
            str::from_utf8(&output.stdout).ok().and_then(Figures::taken).filter(|_| output.status.success());
        if figures.is_none() {
            eprintln!("{name} failed: {}", String::from_utf8_lossy(&output.stderr));
        }
        figures
    }

    fn report(&self, path: Path, seen: &Figures, raw: &Figures, recorder: &mut Recorder) {
        let (pace, cpus) = (self.pace.name(), self.pinning.name());
        recorder.add(CaseResult::of_times(path.name(), pace, cpus, self.bytes, seen));
        Beside {
            bench: "peers",
            case: path.name(),
            payload_bytes: self.bytes,
            pinning: cpus,
            pace,
            seen,
            reference: self.paths[0].name(),
            raw,
            counts: &[],
        }
        .report();
    }
}

/// Runs the role that another process of this program assigned to this one.
pub(crate) fn play(role: &str) {
    let words: Vec<&str> = role.split(' ').collect();
    match words[..] {
        ["measure", path, bytes, pace, pinning, is_short] => {
            let rounds = Rounds::of(number(bytes), Pace::named(pace), is_short == "true");
            let pinning = Pinning::named(pinning);
            pinning.pin(End::Measuring);
            Path::named(path).measure(rounds, pinning).hand_over();
        }
        ["echo", path, bytes, pinning, at] => {
            Pinning::named(pinning).pin(End::Echoing);
            Path::named(path).echo(number(bytes), at);
        }
        ["node", pinning, at] => {
            Pinning::named(pinning).pin(End::Other);
            shared_memory::node(at);
        }
        ["flood", path, pinning, packets] => {
            let pinning = Pinning::named(pinning);
            pinning.pin(End::Measuring);
            flood::measure(path, number(packets), pinning);
        }
        ["sink", path, pinning, packets, at] => {
            Pinning::named(pinning).pin(End::Echoing);
            flood::sink(path, number(packets), at);
        }
        _ => panic!("no such role: {role}"),
    }
}

fn number(word: &str) -> usize {
    word.parse().expect("a number that this program wrote itself")
}
