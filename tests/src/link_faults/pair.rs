//! Both nodes with the faulty network between them, as their scenario sees them.

use sinew_runtime::lock;
use sinew_testkit::NodeProcess;
use std::{
    net::{Ipv4Addr, SocketAddr},
    num::NonZeroU32,
    sync::{Arc, Mutex},
    time::{Duration, Instant},
};

use rustix::process::Signal;
use sinew::{
    Class,
    audit::{Audit, Place},
};

use super::{
    CLASSES, Plan,
    node::wall_seconds,
    pacer::share,
    progress::{self, Progress},
    report::Gap,
    trouble::Trouble,
    wall_clock::{self, JUMP, WallClock},
};
use crate::role;
use sinew_testkit::{
    DEADLINE, TestDirectory,
    history::{Fault, History, Party, Station, Verdict},
    network::{Counts, Cut, FaultyNetwork, Listener, Side},
    preload::Preload,
    unique, until,
};

/// The node that sends most.
const FIRST: Station = 1;
/// The other node.
const SECOND: Station = 2;

/// The listeners of the network: to the second node's GNCL, to the first's, to the second's NDL, and to both
/// GNCLs' datagrams, at the indices of the first two.
const TO_SECOND: usize = 0;
const TO_FIRST: usize = 1;
const TO_SECOND_UDP: usize = 2;
const TO_SECOND_STREAM: usize = 3;
const TO_FIRST_STREAM: usize = 4;
/// Maximum wait for a message behind a full queue that is carried piece by piece.
const BACKLOG_WITHIN: Duration = DEADLINE.saturating_mul(10);
/// Interval between two checks of the progress.
const LOOK: Duration = Duration::from_millis(1);
/// The port of GNCL, at an address that only this run has.
const PORT: u16 = 6_912;

type Shared = Arc<Mutex<History>>;

/// One of the nodes, in its current incarnation.
struct Member {
    station: Station,
    incarnation: u32,
    interface: Ipv4Addr,
    process: NodeProcess,
    /// Its wall clock, if it has one of its own.
    clock: Option<WallClock>,
}

pub(super) struct Pair {
    plan: Plan,
    network: FaultyNetwork,
    history: Shared,
    members: [Member; 2],
    directory: TestDirectory,
    /// The library for settable wall clocks, if they are needed.
    clocks: Option<Preload>,
    progress: Progress,
}

impl Pair {
    /// Starts the nodes and the traffic.
    pub(super) fn start(plan: &Plan) -> Self {
        let listen = SocketAddr::from(([127, 0, 0, 1], 0));
        let [second, first] = [(); 2].map(|()| SocketAddr::from((own_interface(), PORT)));
        let listener = |side, listen, datagrams| Listener { side, listen, datagrams };
        let listeners = [
            listener(Side::Right, second, false),
            listener(Side::Left, first, false),
            listener(Side::Right, listen, true),
            listener(Side::Right, second, true),
            listener(Side::Left, first, true),
        ];
        let network = FaultyNetwork::start(&listeners, plan.seed).expect("ports on loopback");
        for side in [Side::Left, Side::Right] {
            network.change(side, |faults| {
                faults.one_flip_in = plan.one_flip_in.and_then(NonZeroU32::new);
            });
        }
        let (history, directory) = (Shared::default(), TestDirectory::new());
        let sets_clocks =
            plan.troubles.iter().any(|one| matches!(one, Trouble::ClockOn | Trouble::ClockBack));
        let clocks = sets_clocks.then(|| wall_clock::library(&directory.join("")));
        let members = [FIRST, SECOND].map(|station| {
            let interface = own_interface();
            start((station, 1), interface, (plan, &network), (&history, &directory, clocks.as_ref()))
        });
        let progress = Progress::begin(plan.faults);
        let mut pair = Self { plan: plan.clone(), network, history, members, directory, clocks, progress };
        [FIRST, SECOND].into_iter().for_each(|station| pair.begin(station));
        pair.wait_for_flow();
        pair
    }

    fn member(&mut self, station: Station) -> &mut Member {
        &mut self.members[usize::from(station - FIRST)]
    }

    fn party(&self, station: Station) -> Party {
        Party { station, incarnation: self.members[usize::from(station - FIRST)].incarnation }
    }

    /// Starts the traffic from `station` as soon as it sees the other.
    fn begin(&mut self, station: Station) {
        let rate = if station == FIRST { self.plan.rate } else { self.plan.back_rate };
        self.member(station).process.send_line(&format!("rate {rate}"));
    }

    /// The last number of this class received from `from`.
    fn last_got(&self, (from, to, class): (Station, Station, Class)) -> u64 {
        lock(&self.history).last_got(self.party(from), to, class)
    }

    /// Waits until messages sent after this call arrive, both ways: at the second node those of each class,
    /// so that its [gaps](Self::gaps) are over.
    ///
    /// Sent messages are noted with a small delay. The numbers in flight at the call are fewer than the
    /// margin added here.
    pub(super) fn wait_for_flow(&mut self) {
        let there = CLASSES.map(|class| (FIRST, SECOND, class));
        for way @ (from, to, class) in there.into_iter().chain([(SECOND, FIRST, Class::Bulk)]) {
            let rate = if from == FIRST { self.plan.rate } else { self.plan.back_rate };
            if rate > 0 {
                let party = self.party(from);
                let under_way = (rate as f64 * share(class) / 200.0) as u64;
                let upto = lock(&self.history).last_sent(party, to, class) + under_way + 1;
                self.wait_to_get(upto, way);
            }
        }
    }

    /// Waits until this number has arrived, as long as any messages arrive. If connections end faster than
    /// they carry the traffic (as with many flipped bits on a busy host), a full queue precedes it.
    fn wait_to_get(&mut self, upto: u64, way: (Station, Station, Class)) {
        let (began, (from, to, class)) = (Instant::now(), way);
        let (mut got, mut since, mut network) = (self.last_got(way), began, self.network.counts());
        while got < upto {
            let now = self.last_got(way);
            if now > got {
                (got, since, network) = (now, Instant::now(), self.network.counts());
            }
            assert!(
                since.elapsed() < DEADLINE && began.elapsed() < BACKLOG_WITHIN,
                "{class:?} from {from} to {to}, {got} was got {:?} ago, and {upto} is waited for since {:?}; the network then and now:\n{network:?}\n{:?}",
                since.elapsed(),
                began.elapsed(),
                self.network.counts()
            );
            if self.progress.is_due(Instant::now()) {
                self.say_progress(&format!(
                    "number {upto} of {class:?} from {from} to {to}, since {:?}",
                    began.elapsed()
                ));
            }
            std::thread::sleep(LOOK);
        }
    }

    /// Records the next fault.
    pub(super) fn strikes(&mut self, trouble: Trouble) {
        self.progress.strikes(trouble);
    }

    /// Prints the progress of the run. It queries both nodes, so no other query may be pending.
    fn say_progress(&mut self, waits_for: &str) {
        let way = |from, to, rate| {
            let (history, party) = (lock(&self.history), self.party(from));
            let class = Class::Bulk;
            let (sent, got) = (history.last_sent(party, to, class), history.last_got(party, to, class));
            progress::Way { sent, got, rate }
        };
        let ways = [way(FIRST, SECOND, self.plan.rate), way(SECOND, FIRST, self.plan.back_rate)];
        let queues = [FIRST, SECOND].map(|station| (station, self.member(station).ask("queues")));
        eprintln!("{}", self.progress.line(Instant::now(), ways, waits_for, &queues));
    }

    /// The longest times without a message at the second node since the last call, or since its start.
    pub(super) fn gaps(&mut self) -> Gap {
        let nanos = self.member(SECOND).ask("gap");
        let gaps: Vec<_> = nanos.split_whitespace().map(|nanos| nanos.parse().expect("a number")).collect();
        let [all, each @ ..] = <[u64; 4]>::try_from(gaps).expect("one of all, and one of each class");
        Gap { all: Duration::from_nanos(all), each: each.map(Duration::from_nanos) }
    }

    /// Injects a fault, and returns when it is over.
    pub(super) fn suffer(&mut self, trouble: Trouble, hold: Duration) {
        match trouble {
            Trouble::Cut => self.cut(Cut::Reset),
            Trouble::Finish => self.cut(Cut::Finish),
            Trouble::PanicSender => drop(self.member(FIRST).ask_as("panic", "ready")),
            Trouble::PanicReceiver => drop(self.member(SECOND).ask_as("panic", "ready")),
            Trouble::Stall => self.hold(&[Side::Left, Side::Right], hold, |faults| faults.stalled = true),
            Trouble::PartThere => self.hold(&[Side::Right], hold, |faults| faults.parted = true),
            Trouble::PartBack => self.hold(&[Side::Left], hold, |faults| faults.parted = true),
            Trouble::Freeze => {
                self.member(SECOND).process.pause();
                std::thread::sleep(hold);
                self.member(SECOND).process.signal(Signal::CONT);
            }
            Trouble::KillReceiver => self.replace(SECOND),
            Trouble::KillSender => self.replace(FIRST),
            Trouble::ClockOn => self.set_clocks(JUMP),
            Trouble::ClockBack => self.set_clocks(-JUMP),
        }
    }

    /// Makes the wall clocks of both nodes jump, and waits until both have noticed.
    fn set_clocks(&mut self, jump: i64) {
        for member in &mut self.members {
            let clock = member.clock.as_mut().expect("it was made where clocks are to be set");
            clock.jump(jump);
            let right = wall_seconds().checked_add_signed(clock.off_by).expect("a day after 1970");
            let seen: u64 = member.ask("wall").parse().expect("a number");
            assert!(
                seen.abs_diff(right) <= DEADLINE.as_secs(),
                "the clock shows {seen} s, and was set to {right}"
            );
        }
    }

    fn cut(&self, how: Cut) {
        // A connection being established is not counted yet.
        until("there is a connection", || (self.network.counts().open > 0).then_some(()));
        let before = self.network.counts();
        self.network.cut(how);
        until("it is cut", || {
            let now = self.network.counts();
            (now.cut > before.cut || now.made > before.made).then_some(())
        });
    }

    fn hold(&self, sides: &[Side], hold: Duration, change: impl Fn(&mut sinew_testkit::network::Faults)) {
        sides.iter().for_each(|side| self.network.change(*side, &change));
        std::thread::sleep(hold);
        for side in sides {
            self.network.change(*side, |faults| (faults.stalled, faults.parted) = (false, false));
        }
    }

    /// Kills a node, and starts its next incarnation. As on a separate host, no process listens in between.
    fn replace(&mut self, station: Station) {
        let party = self.party(station);
        self.network.refuse(true);
        self.member(station).process.kill();
        lock(&self.history).killed(party);
        let interface = self.member(station).interface;
        let next = start(
            (station, party.incarnation + 1),
            interface,
            (&self.plan, &self.network),
            (&self.history, &self.directory, self.clocks.as_ref()),
        );
        *self.member(station) = next;
        self.network.refuse(false);
        self.begin(station);
    }

    /// Stops sending, waits until all messages have arrived, and returns the fates of all messages.
    pub(super) fn finish(mut self) -> (Verdict, Counts, Audit) {
        for side in [Side::Left, Side::Right] {
            self.network.change(side, |faults| faults.one_flip_in = None);
        }
        self.members.iter_mut().for_each(|member| member.process.send_line("quiet"));
        self.members.iter_mut().for_each(|member| drop(member.process.expect("quiet")));
        let end = Instant::now() + DEADLINE;
        let mut verdict = lock(&self.history).verdict();
        // A message in flight counts as lost until it arrives.
        while verdict.count(Fault::Lost) > 0 && Instant::now() < end {
            self.members.iter_mut().for_each(|member| member.process.send_line("report"));
            std::thread::sleep(Duration::from_millis(100));
            verdict = lock(&self.history).verdict();
        }
        let audit = self.audit_once_quiet();
        let network = self.network.counts();
        for member in self.members {
            let status = member.process.stop();
            assert!(status.success(), "node {} ended with {status}", member.station);
        }
        (verdict, network, audit)
    }

    /// The audit of both nodes, once no message waits other than the audit's own request and answer, which
    /// are Bulk. No Stream value may be in flight either: a value sent by datagram and superseded by a newer
    /// one counts as in flight until it expires.
    fn audit_once_quiet(&mut self) -> Audit {
        const OWN: u64 = 2;
        let first = self.member(FIRST);
        let end = Instant::now() + DEADLINE;
        loop {
            let audit: Audit = serde_json::from_str(&first.ask("audit")).expect("an audit");
            let values = audit
                .nodes
                .iter()
                .flat_map(|node| &node.entries)
                .filter(|entry| matches!(entry.place, Place::ToNode { class: Some(Class::Stream), .. }));
            let values: u64 = values.map(|entry| entry.account.unacknowledged).sum();
            if audit.nodes.len() == 2 && audit.total().waiting <= OWN && values == 0 {
                return audit;
            }
            assert!(
                Instant::now() < end,
                "for {DEADLINE:?} not both nodes answer, or messages wait or are under way:\n{audit}"
            );
            std::thread::sleep(Duration::from_millis(10));
        }
    }
}

/// A loopback address that no other test of this host has at the same time, except for a process with an id
/// that differs by a multiple of 4,096.
fn own_interface() -> Ipv4Addr {
    let [_, b, c, d] = unique().to_be_bytes();
    // Every such address is valid for a host: the network and broadcast addresses are not among them.
    Ipv4Addr::new(127, 64 | b & 63, c, d)
}

fn start(
    (station, incarnation): (Station, u32),
    interface: Ipv4Addr,
    (plan, network): (&Plan, &FaultyNetwork),
    (history, directory, clocks): (&Shared, &TestDirectory, Option<&Preload>),
) -> Member {
    let (announce, seeds) = if station == FIRST {
        (network.address(TO_FIRST), format!("[\"{}\"]", network.address(TO_SECOND_UDP)))
    } else {
        (network.address(TO_SECOND), "[]".to_owned())
    };
    let text = format!(
        "[node]\nname = \"node-{station}\"\nproject = \"link faults\"\nmailbox_capacity = 65536\n\
         [gncl]\nannounce = \"{announce}\"\nqueue_capacity = 65536\n\
         [ndl]\ninterface = \"{interface}\"\nmulticast = false\nmdns_port = false\nseeds = {seeds}\n\
         [supervision]\nlayer_restarts_max = 1000000\nlayer_window_ms = 10\n"
    );
    let path = directory.write(&format!("node-{station}.toml"), &text);
    let arguments =
        [u64::from(station), incarnation.into(), u64::from(FIRST + SECOND - station), plan.filling as u64];
    let mut command = role("link-node");
    command.arg(path).args(arguments.map(|number| number.to_string()));
    let (party, notes) = (Party { station, incarnation }, history.clone());
    let take = move |line: &str| {
        let note = line.parse();
        note.map(|note| lock(&notes).note(party, note)).is_ok()
    };
    // The clock of a new incarnation starts correct.
    let clock = clocks.map(|library| WallClock::new(library, &format!("clock-{station}-{incarnation}")));
    command.envs(clock.iter().flat_map(WallClock::environment));
    let mut process = NodeProcess::start_with(&format!("node {station}"), command, take);
    let places = process.expect("up");
    let member = Member { station, incarnation, interface, process, clock };
    let places: Vec<SocketAddr> =
        places.split_whitespace().map(|place| place.parse().expect("an address")).collect();
    if station == FIRST {
        network.set_destination(TO_FIRST, places[0]);
        // The port can stay the same, because no other process has this address.
        network.set_destination(TO_FIRST_STREAM, places[0]);
    } else {
        network.set_destination(TO_SECOND, places[0]);
        network.set_destination(TO_SECOND_STREAM, places[0]);
        network.set_destination(TO_SECOND_UDP, places[1]);
    }
    member
}

impl Member {
    fn ask(&mut self, question: &str) -> String {
        self.ask_as(question, question)
    }

    fn ask_as(&mut self, question: &str, answer: &str) -> String {
        self.process.send_line(question);
        self.process.expect(answer)
    }
}
