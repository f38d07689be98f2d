//! The claim: 8 processes with 64 addresses, and applications of the node, send each other messages while
//! processes are killed. Every message has exactly one true fate.

use sinew_runtime::lock;
use sinew_testkit::NodeProcess;
use std::{
    fmt,
    sync::{Arc, Mutex},
    time::{Duration, Instant},
};

use sinew::audit::Audit;

use super::{
    FixtureLimits, NodeFixture,
    entry::{Entry, Poster},
    fate_tracker::{Account, Fate, FateTracker},
    poster::{CAPACITY, POSTERS},
};
use sinew_testkit::{random::SeededRandom, until};

/// Posters in the node's own process, in addition to those in processes of their own.
const RESIDENTS: Poster = 8;

/// The parameters of a run.
#[derive(Clone, Debug)]
pub struct Plan {
    /// Number of processes, each with 8 addresses.
    pub processes: Poster,
    /// Number of kills.
    pub kills: u32,
    /// Mean time between two kills.
    pub spacing: Duration,
    /// Maximum time that a poster waits for messages before it sends again.
    pub pause: Duration,
    /// Seed of the kills and of all messages.
    pub seed: u64,
}

/// The results.
#[derive(Debug)]
pub struct Report {
    /// The fates of the messages.
    pub account: Account,
    seconds: f64,
    seed: u64,
    refused: u64,
    /// The node's own audit of all messages, at the end.
    pub audit: Audit,
}

impl Report {
    /// Returns whether the law held, in the history and in the node's own counters, and every kind of message
    /// occurred.
    #[must_use]
    pub fn holds(&self) -> bool {
        self.audit.missing() == 0
            && self.account.holds()
            && self.account.of(Fate::Delivered) > 0
            && self.account.confirmed_delivered > 0
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { account, seconds, seed, refused, audit } = self;
        let rate = account.sent() as f64 / seconds;
        writeln!(
            f,
            "seed {seed}: {} messages in {seconds:.1} s, {rate:.0} a second; the node refused {refused}",
            account.sent()
        )?;
        write!(f, "{account}")?;
        // The lines per application are of interest only if messages are missing.
        if audit.missing() > 0 {
            write!(f, "\n{audit}")
        } else {
            write!(f, "\nthe audit explains every message")
        }
    }
}

type Shared = Arc<Mutex<FateTracker>>;

/// The processes, each with its incarnation number.
struct Scenario {
    plan: Plan,
    fixture: NodeFixture,
    tracker: Shared,
    processes: Vec<(u32, Option<NodeProcess>)>,
}

impl Scenario {
    fn new(plan: Plan) -> Self {
        let limits = FixtureLimits { mailbox_capacity: CAPACITY, payload_max: 1 << 20, clients_max: 256 };
        let (tracker, first) = (Shared::default(), plan.processes * POSTERS);
        let arguments =
            [u64::from(first), u64::from(first + RESIDENTS), plan.seed].map(|number| number.to_string());
        let residents = tracker.clone();
        let fixture = NodeFixture::with_residents(limits, &arguments, move |line| note(&residents, 1, line));
        let processes = (0..plan.processes).map(|_| (0, None)).collect();
        let mut scenario = Self { plan, fixture, tracker, processes };
        (0..scenario.plan.processes).for_each(|process| scenario.start(process));
        scenario
    }

    fn start(&mut self, process: Poster) {
        let Plan { processes, seed, pause, .. } = self.plan;
        let place = &mut self.processes[usize::from(process)];
        place.0 += 1;
        let (incarnation, tracker) = (place.0, self.tracker.clone());
        let all = processes * POSTERS + RESIDENTS;
        let arguments = [u64::from(process), incarnation.into(), all.into(), seed, pause.as_millis() as u64];
        let arguments = arguments.map(|number| number.to_string());
        let take = move |line: &str| {
            note(&tracker, incarnation, line);
            true
        };
        place.1 = Some(self.fixture.start_with("poster", &arguments.each_ref().map(|word| &**word), take));
    }

    fn kill(&mut self, process: Poster) {
        let place = &mut self.processes[usize::from(process)];
        let was_alive = place.1.take().expect("it was started").kill();
        let mut tracker = lock(&self.tracker);
        if !was_alive {
            let why = Entry::Broken("its process ended by itself".to_owned());
            tracker.note(process * POSTERS, place.0, why);
        }
        posters_of(process).for_each(|poster| tracker.killed(poster, place.0));
    }

    /// Returns whether every poster has its address.
    fn is_up(&self) -> bool {
        let tracker = lock(&self.tracker);
        (0..).zip(&self.processes).all(|(process, (incarnation, _))| {
            posters_of(process).all(|poster| tracker.is_up(poster, *incarnation))
        })
    }

    fn kill_some(&mut self) {
        let mut random = SeededRandom::new(self.plan.seed);
        for _ in 0..self.plan.kills {
            std::thread::sleep(random.time_below(self.plan.spacing * 2));
            let process = random.below(self.plan.processes.into()) as Poster;
            self.kill(process);
            self.start(process);
        }
        until("every poster has its address", || self.is_up().then_some(()));
        // Messages sent while all posters are up must reach all of them.
        std::thread::sleep(self.plan.spacing);
    }

    fn come_to_rest(&mut self) {
        for (_, process) in &mut self.processes {
            process.as_mut().expect("it was started").send_line("quiet");
        }
        self.fixture.quiet();
        until("the posters send no more", || lock(&self.tracker).is_quiet().then_some(()));
        // Messages still in flight after the deadline show up in the report.
        let end = Instant::now() + sinew_testkit::DEADLINE;
        while lock(&self.tracker).account().of(Fate::InFlight) > 0 && Instant::now() < end {
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    fn end(self) -> NodeFixture {
        for (_, process) in self.processes {
            let status = process.expect("it was started").stop();
            assert!(status.success(), "a poster ended with {status}");
        }
        self.fixture
    }
}

fn posters_of(process: Poster) -> std::ops::Range<Poster> {
    process * POSTERS..(process + 1) * POSTERS
}

fn note(tracker: &Shared, incarnation: u32, line: &str) {
    let (poster, entry) = line.split_once(' ').unwrap_or((line, ""));
    let (poster, entry): (Poster, Entry) = match (poster.parse(), entry.parse()) {
        (Ok(poster), Ok(entry)) => (poster, entry),
        (poster, entry) => panic!("{line:?}: {poster:?} {entry:?}"),
    };
    lock(tracker).note(poster, incarnation, entry);
}

/// Lets the processes send, kills them at random, and accounts for all messages.
///
/// # Panics
/// If a process does not start, or messages do not come to rest.
#[must_use]
pub fn run(plan: Plan) -> Report {
    let (seed, began) = (plan.seed, Instant::now());
    let mut scenario = Scenario::new(plan);
    until("every poster has its address", || scenario.is_up().then_some(()));
    scenario.kill_some();
    scenario.come_to_rest();
    let tracker = scenario.tracker.clone();
    let mut fixture = scenario.end();
    let refused = fixture.refused();
    let audit = fixture.audit();
    fixture.end();
    let account = lock(&tracker).account();
    Report { account, seconds: began.elapsed().as_secs_f64(), seed, refused, audit }
}
