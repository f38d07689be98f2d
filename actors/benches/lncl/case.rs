//! The cases: transport, measurement, CPUs and counts; and the roles of the participating processes.

use std::process::ExitCode;

use sinew_figures::{Alone, Beside, End, Figures, Pace, Pinning, Rounds, process};

use crate::{
    crowds::{self, Flood},
    ends::{self, Memory},
    mesh, raw, tasks,
};

/// The environment variable that makes a run short.
const SHORT: &str = "SINEW_LNCL_SHORT";
/// The mean of the paper's Table 1, in microseconds.
const PAPER_MEAN_US: f64 = 46.2;

/// How messages travel between the two applications.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Way {
    /// A unix socket from each to the node.
    Socket,
    /// Rings from each to the node.
    Ring,
    /// As an endpoint that asks for nothing: a direct link to a frequent peer.
    Default,
    /// Rings from each to the other, once they are introduced.
    Direct,
    /// The same, the applications looking before they sleep.
    DirectSpin,
    /// As `Ring`, the applications being tasks of tokio.
    TaskRing,
    /// As `Direct`, the same.
    TaskDirect,
}

impl Way {
    const ALL: [Self; 7] = [
        Self::Socket,
        Self::Ring,
        Self::Default,
        Self::Direct,
        Self::DirectSpin,
        Self::TaskRing,
        Self::TaskDirect,
    ];

    const fn name(self) -> &'static str {
        match self {
            Self::Socket => "socket",
            Self::Ring => "ring",
            Self::Default => "default",
            Self::Direct => "direct",
            Self::DirectSpin => "direct_spin",
            Self::TaskRing => "task_ring",
            Self::TaskDirect => "task_direct",
        }
    }

    const fn references(self) -> &'static [Reference] {
        match self {
            Self::Socket | Self::Ring | Self::Default | Self::Direct | Self::TaskRing | Self::TaskDirect => {
                &[Reference::BareFutex, Reference::UnixStream]
            }
            Self::DirectSpin => &[Reference::BarePoll],
        }
    }

    /// An endpoint that polls without sleeping needs a different CPU than its peer.
    const fn spins(self) -> bool {
        match self {
            Self::Socket | Self::Ring | Self::Default | Self::Direct | Self::TaskRing | Self::TaskDirect => {
                false
            }
            Self::DirectSpin => true,
        }
    }

    /// Whether the applications are tasks: then there are round trips only.
    const fn is_of_tasks(self) -> bool {
        match self {
            Self::Socket | Self::Ring | Self::Default | Self::Direct | Self::DirectSpin => false,
            Self::TaskRing | Self::TaskDirect => true,
        }
    }
}

/// The reference of a transport.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Reference {
    BareFutex,
    BarePoll,
    UnixStream,
}

impl Reference {
    const ALL: [Self; 3] = [Self::BareFutex, Self::BarePoll, Self::UnixStream];

    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::BareFutex => "bare_futex",
            Self::BarePoll => "bare_poll",
            Self::UnixStream => "raw_unix_stream",
        }
    }
}

/// A measurement.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum What {
    RoundTrips {
        bytes: usize,
        pace: Pace,
    },
    /// Round trips of payloads written in the ring, beside payloads copied into it.
    Loan {
        bytes: usize,
    },
    TableOne,
    /// The same with the receiver in C++.
    TableOneCpp,
    FanIn,
    Flood,
    /// Round trips of Control beside a flood of Bulk to the same receiver.
    Commands,
    /// 64 addresses that all send to all others.
    Mesh,
}

/// A case: one transport, one measurement, one CPU assignment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Case {
    way: Way,
    what: What,
    pinning: Pinning,
}

/// Every case, or those of a short run.
pub(crate) fn all(is_short: bool) -> impl Iterator<Item = Case> {
    let back_to_back = |bytes| What::RoundTrips { bytes, pace: Pace::BackToBack };
    let paced = |bytes| What::RoundTrips { bytes, pace: Pace::EveryMillisecond };
    let mut things = vec![
        back_to_back(1000),
        paced(1000),
        What::TableOne,
        What::FanIn,
        What::Flood,
        What::Commands,
        What::Mesh,
    ];
    if std::env::var_os(ends::CPP_ECHO).is_some() {
        things.push(What::TableOneCpp);
    }
    things.extend([65_536, 1 << 20].map(|bytes| What::Loan { bytes }));
    if !is_short {
        let others = [8, 64, 65_536, 1 << 20];
        things.extend(others.map(back_to_back).into_iter().chain(others.map(paced)));
    }
    Pinning::ALL
        .into_iter()
        .flat_map(|pinning| Way::ALL.map(|way| (way, pinning)))
        .filter(|(way, pinning)| !(way.spins() && *pinning == Pinning::OneCpu))
        .flat_map(move |(way, pinning)| {
            things.clone().into_iter().map(move |what| Case { way, what, pinning })
        })
        .filter(|case| !case.way.is_of_tasks() || matches!(case.what, What::RoundTrips { .. }))
        // An endpoint that spins needs a CPU of its own.
        .filter(|case| !(case.what == What::Mesh && (case.way.spins() || case.pinning != Pinning::Anywhere)))
        // A socket lends nothing.
        .filter(|case| !(matches!(case.what, What::Loan { .. }) && case.way == Way::Socket))
        // The C++ case exists for the default transport only.
        .filter(|case| case.what != What::TableOneCpp || case.way == Way::Ring)
}

impl Case {
    pub(crate) fn name(&self) -> String {
        let (way, pinning) = (self.way.name(), self.pinning.name());
        match self.what {
            What::RoundTrips { bytes, pace } => format!("{way}-{bytes}B-{}-{pinning}", pace.name()),
            What::Loan { bytes } => format!("{way}-{bytes}B-loan-{pinning}"),
            What::TableOne => format!("{way}-table_1-{pinning}"),
            What::TableOneCpp => format!("{way}-table_1_cpp-{pinning}"),
            What::FanIn => format!("{way}-fan_in-{pinning}"),
            What::Flood => format!("{way}-flood-{pinning}"),
            What::Commands => format!("{way}-commands-{pinning}"),
            What::Mesh => format!("{way}-mesh-{pinning}"),
        }
    }

    /// Runs it in a process of its own. Returns whether that went well.
    pub(crate) fn run(self, is_short: bool) -> bool {
        let role = format!("measure {}", self.name());
        let mut command = process::command(&role);
        if is_short {
            command.env(SHORT, "1");
        }
        let is_well = process::has_run(command);
        if !is_well {
            eprintln!("{} failed", self.name());
        }
        is_well
    }

    fn measure(self, is_short: bool) {
        self.pinning.pin(End::Measuring);
        match self.what {
            What::RoundTrips { bytes, pace } => self.round_trips(bytes, pace, is_short),
            What::Loan { bytes } => self.loan(bytes, is_short),
            What::TableOne => self.table_one("table_1", "echo"),
            What::TableOneCpp => self.table_one("table_1_cpp", "cpp_echo"),
            What::FanIn => self.fan_in(if is_short { 150 } else { 1_500 }),
            What::Flood => self.flood(if is_short { 20_480 } else { 204_800 }),
            What::Mesh => self.mesh(if is_short { 20 } else { 200 }),
            What::Commands => self.commands(if is_short { 1_000 } else { 10_000 }),
        }
    }

    fn round_trips(self, bytes: usize, pace: Pace, is_short: bool) {
        let rounds = Rounds::of(bytes, pace, is_short);
        let raws: Vec<_> = (self.way.references().iter())
            .map(|reference| (reference.name(), raw::round_trips(*reference, bytes, rounds, self.pinning)))
            .collect();
        let seen = if self.way.is_of_tasks() {
            tasks::round_trips(self.way, bytes, rounds, self.pinning)
        } else {
            ends::round_trips(self.way, bytes, rounds, self.pinning)
        };
        for (reference, raw) in &raws {
            Beside {
                bench: "lncl",
                case: self.way.name(),
                payload_bytes: bytes,
                pinning: self.pinning.name(),
                pace: pace.name(),
                seen: &seen,
                reference,
                raw,
                counts: &[],
            }
            .report();
        }
    }

    fn loan(self, bytes: usize, is_short: bool) {
        let rounds = Rounds::of(bytes, Pace::BackToBack, is_short);
        let (copied, _) = ends::loans(self.way, Memory::Copied, bytes, rounds, self.pinning);
        let (seen, is_in_place) = ends::loans(self.way, Memory::Lent, bytes, rounds, self.pinning);
        if !is_in_place {
            return eprintln!("{} {bytes}: it fits no ring of this way, and was copied", self.way.name());
        }
        Beside {
            bench: "lncl",
            case: &format!("{}_loan", self.way.name()),
            payload_bytes: bytes,
            pinning: self.pinning.name(),
            pace: Pace::BackToBack.name(),
            seen: &seen,
            reference: "the same copied",
            raw: &copied,
            counts: &[],
        }
        .report();
    }

    fn table_one(self, table: &str, echo: &str) {
        let raws: Vec<_> = (self.way.references().iter())
            .map(|reference| (reference.name(), raw::table_one(*reference, self.pinning)))
            .collect();
        let seen = ends::table_one(self.way, self.pinning, echo);
        for (reference, raw) in &raws {
            Beside {
                bench: "lncl",
                case: &format!("{}_{table}", self.way.name()),
                payload_bytes: crowds::PACKET,
                pinning: self.pinning.name(),
                pace: Pace::BackToBack.name(),
                seen: &seen.figures,
                reference,
                raw: &raw.figures,
                counts: &[
                    ("mean_us", seen.mean_us()),
                    ("first_us", seen.first_us()),
                    ("reference_mean_us", raw.mean_us()),
                    ("reference_first_us", raw.first_us()),
                    ("ratio_mean", seen.mean_us() / raw.mean_us()),
                    ("paper_mean_us", PAPER_MEAN_US),
                ],
            }
            .report();
        }
    }

    fn fan_in(self, packets: u64) {
        let raw = raw::fan_in(packets, self.pinning);
        let (seen, lost) = crowds::fan_in(self.way, packets, self.pinning);
        Beside {
            bench: "lncl",
            case: &format!("{}_fan_in", self.way.name()),
            payload_bytes: crowds::PACKET,
            pinning: self.pinning.name(),
            pace: "8 at 1khz",
            seen: &seen,
            reference: "raw_unix_stream",
            raw: &raw,
            counts: &[],
        }
        .report();
        assert_eq!(lost, 0, "packets that never came");
    }

    fn flood(self, packets: u64) {
        let raw = raw::flood(packets, self.pinning);
        let (windows, seen) = crowds::flood(self.way, packets, self.pinning);
        let counts = [
            ("messages_per_second", seen as u64),
            ("raw_unix_stream_per_second", raw as u64),
            ("percent_of_raw", (100.0 * seen / raw) as u64),
        ];
        self.report("32 sent to answered", &windows, &counts);
    }

    fn commands(self, rounds: u64) {
        let raw = crowds::commands(self.way, Flood::None, rounds, self.pinning);
        let seen = crowds::commands(self.way, Flood::Bulk, rounds, self.pinning);
        let [raw_p99, p99] = [&raw, &seen].map(|figures| figures.p99().as_secs_f64() * 1e6);
        Beside {
            bench: "lncl",
            case: &format!("{}_commands_beside_bulk", self.way.name()),
            payload_bytes: crowds::COMMAND_BYTES,
            pinning: self.pinning.name(),
            pace: Pace::EveryMillisecond.name(),
            seen: &seen,
            reference: "the same without Bulk",
            raw: &raw,
            counts: &[("reference_p99_us", raw_p99), ("ratio_p99", p99 / raw_p99)],
        }
        .report();
    }

    fn mesh(self, rounds: usize) {
        let per_second = mesh::measure(self.way, rounds, self.pinning);
        let counts = [("messages_per_second", per_second as u64)];
        self.report("none", &Figures::new(), &counts);
    }

    fn report(self, figure: &str, seen: &Figures, counts: &[(&str, u64)]) {
        Alone { bench: "lncl", case: &self.name(), figure, seen, counts }.report();
    }
}

/// Runs the role that another process of this program assigned to this one.
pub(crate) fn play(role: &str) -> ExitCode {
    let words: Vec<&str> = role.split(' ').collect();
    match words[..] {
        ["measure", name] => {
            let is_short = std::env::var_os(SHORT).is_some();
            let case = all(is_short).find(|case| case.name() == name);
            case.expect("a name that this program wrote itself").measure(is_short);
        }
        ["node", pinning, socket, ring_bytes] => {
            raw::pin(pinning, End::Other);
            ends::node(socket, number(ring_bytes) as usize);
        }
        ["echo", way, pinning, socket] => {
            raw::pin(pinning, End::Echoing);
            match way_named(way) {
                way if way.is_of_tasks() => tasks::echo(way, socket),
                way => ends::echo(way, Memory::Lent, socket),
            }
        }
        ["echo_copied", way, pinning, socket] => {
            raw::pin(pinning, End::Echoing);
            ends::echo(way_named(way), Memory::Copied, socket);
        }
        ["cpp_echo", _, pinning, socket] => {
            raw::pin(pinning, End::Echoing);
            ends::become_cpp_echo(socket);
        }
        ["sink", way, pinning, socket] => {
            raw::pin(pinning, End::Echoing);
            crowds::sink(way_named(way), socket);
        }
        ["commanded", way, pinning, socket] => {
            raw::pin(pinning, End::Echoing);
            crowds::answer_commands(way_named(way), socket);
        }
        ["mesh", way, pinning, socket, index, rounds] => {
            raw::pin(pinning, End::Other);
            mesh::take_part(way_named(way), socket, number(index) as usize, number(rounds) as usize);
        }
        ["sender", way, pinning, socket, packets] => {
            raw::pin(pinning, End::Other);
            crowds::send(way_named(way), socket, number(packets));
        }
        ["raw_echo", reference, bytes, pinning] => {
            raw::pin(pinning, End::Echoing);
            raw::echo(reference_named(reference), number(bytes) as usize);
        }
        ["raw_aged_echo", reference, pinning] => {
            raw::pin(pinning, End::Echoing);
            raw::aged_echo(reference_named(reference));
        }
        ["raw_sink", pinning] => {
            raw::pin(pinning, End::Echoing);
            raw::sink();
        }
        ["raw_sender", packets, pinning] => {
            raw::pin(pinning, End::Other);
            raw::send(number(packets));
        }
        _ => {
            eprintln!("no such role: {role}");
            return ExitCode::FAILURE;
        }
    }
    ExitCode::SUCCESS
}

fn number(word: &str) -> u64 {
    word.parse().expect("a number that this program wrote itself")
}

fn way_named(name: &str) -> Way {
    Way::ALL.into_iter().find(|way| way.name() == name).expect("a name that this program wrote itself")
}

fn reference_named(name: &str) -> Reference {
    let found = Reference::ALL.into_iter().find(|reference| reference.name() == name);
    found.expect("a name that this program wrote itself")
}

/// Returns the text that starts another process in this role.
pub(crate) fn role(part: &str, way: Way, pinning: Pinning, socket: &str) -> String {
    format!("{part} {} {} {socket}", way.name(), pinning.name())
}
