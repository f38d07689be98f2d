//! Simulates nodes that meet at barriers while links break and heal. Nodes are lost, restart and come back;
//! applications die and give up.
//!
//! A number, the seed, decides everything. The judge knows which applications really arrived and passed. Of
//! the core it uses only the inputs and the reports. Checked rules:
//! - A barrier never opens early, and no application waits where all parties are present.
//! - Each counted application passes, and after quiet all nodes report the same.
//! - No wait outlasts its deadline.
//! - An application that asked to be notified of a loss is notified in time, and no other one is.
//! - Each waiting application is given the missing parties, with the last state that its node received of each.
//!
//! In some seeds a node keeps few barriers only. In most seeds a second process comes up with a node's
//! address. In a third of the seeds applications reach phases, too. Each incarnation of a process has a clock
//! of its own, which agrees with no other one. Planted faults in the frames, the state and the inputs of
//! nodes must be found.
//!
//! | file | contents |
//! | --- | --- |
//! | `apps` | actions of applications |
//! | `clocks` | the clock of each process |
//! | `links` | links that break and heal, frames in flight over them, processes that come and go |
//! | `faults` | the planted faults |
//! | `time` | time that passes, with and without running processes |
//! | `judge` | the applications that may pass and those that must |
//! | `waits` | the end of each wait, and the reports about it meanwhile; `waits::phases` at phases |
//! | `inputs` | the inputs of each process |

mod apps;
mod clocks;
mod faults;
mod inputs;
mod judge;
mod links;
mod time;
mod waits;

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::LazyLock,
    time::Duration,
};

use apps::Stage;
use bytes::Bytes;
use clocks::Clocks;
use faults::Fault;
use judge::Judge;
use sinew_model::{
    barrier::{ArriveAtBarrier, BarrierAnswer, BarrierKind, OnPartyLoss},
    config::NodeConfig,
    directory::Absence,
    facts::{AppFact, LinkFact, LossReason, MembershipFact},
};
use sinew_runtime::{
    tid::{AppAddress, Incarnation, NodeAddress},
    time::Time,
};
use sinew_sim::{Chance, History, Hunt, Pipe, Seeds, number};
use sinew_sync::{
    arrivals::{Arrivals, Member},
    core::{BarrierKey, BarrierState, Core, Input, Output, Reason, Rendezvous},
    list::Name,
};

/// The seeds of an ordinary run; `docs/book/src/contributing/testing.md` has the commands.
const SEEDS: Seeds = Seeds {
    variable: "SINEW_SYNC_SEED",
    package: "sinew-sync",
    target: "--test simulation",
    test: "barriers::barrier_opens",
    count: if cfg!(debug_assertions) { 160 } else { 250 },
};
/// Sets the number of nodes, 3 and more, regardless of the seed.
const NODES_VARIABLE: &str = "SINEW_SYNC_NODES";
/// Seeds within which each planted fault must be found.
const SEEDS_FOR_A_FAULT: u64 = 1_000;
/// Steps of one seed with three or four nodes; with more nodes, proportionally more.
const STEPS: usize = 150;
const APPS: usize = 2;
/// The maximum number of nodes in most seeds.
const FEW_NODES: usize = 4;
/// The maximum number of barriers that a node keeps, in crowded seeds.
const FEW: usize = 4;
/// The number of never opening barriers that are used to fill that limit.
const OTHERS: usize = 3;
/// The number of a request that the judge ignores.
const UNJUDGED: u64 = u64::MAX;
/// The wait limit of an application that does not give up, in milliseconds.
const FOR_EVER_MS: u32 = 1_000_000_000;

/// The barriers: by names, by a count, by a pattern and a choice.
const BARRIERS: [(&str, &[&str]); 3] =
    [("named", &["0.0", "1.0", "2.0"]), ("counted", &["3 of *"]), ("chosen", &["2 of *.1", "0.0 | 1.0"])];

/// The phases: by names, and by a count. Each in the order of their texts.
const PHASES: [(&str, &[&str]); 2] = [("homed", &["0.0", "1.0", "2.0"]), ("armed", &["2 of *.1"])];

/// Nodes are the first processes; a duplicate of a node is a process with a higher index.
struct World {
    chance: Chance,
    /// The time of the simulation: no process knows it.
    now: Time,
    clocks: Clocks,
    /// The time since when every process has had time to read after a stall.
    rested: Time,
    cores: Vec<Core>,
    incarnations: Vec<u64>,
    /// The index of the node with the address of each process.
    homes: Vec<usize>,
    /// The number of incarnations of each node, including its duplicates.
    incarnation_counts: Vec<u64>,
    /// The process that is a duplicate of a node.
    duplicate: Option<usize>,
    /// Duplicates that have ended.
    ended: BTreeSet<usize>,
    /// The youngest incarnation of each node that sent a frame to a process.
    youngest: BTreeMap<(usize, usize), u64>,
    /// Links that carry messages, by their two ends, the smaller first.
    up: BTreeSet<(usize, usize)>,
    /// Ends that have not yet been notified that their link to this incarnation is down.
    unreported: BTreeSet<(usize, usize, u64)>,
    /// Frames in flight, by sender and receiver.
    flying: BTreeMap<(usize, usize), Pipe<(bool, Bytes)>>,
    judge: Judge,
    /// The stage of each application of each process.
    stages: BTreeMap<(usize, usize), Stage>,
    fault: Option<Fault>,
    /// The reason that a node gave first for a name, if the fault keeps it.
    reasons: BTreeMap<(usize, String), String>,
    /// The number of inputs of cores.
    events: u64,
    ever: BTreeMap<usize, Arrivals>,
    history: History,
    /// In this seed only links break, so no node misses a generation.
    is_calm: bool,
    /// In this seed a node keeps few barriers.
    is_crowded: bool,
    /// In this seed applications reach phases.
    has_phases: bool,
}

fn address(node: usize) -> NodeAddress {
    NodeAddress::new(0x7f00_0001 + node as u32)
}

fn app_address(app: usize) -> AppAddress {
    AppAddress::fixed(app as u32).unwrap()
}

fn name(node: usize, app: usize) -> String {
    format!("{node}.{app}")
}

/// Returns the name of a barrier that never opens.
fn other(number: usize) -> String {
    format!("other {number}")
}

fn key(barrier: usize) -> &'static BarrierKey {
    static KEYS: LazyLock<[BarrierKey; BARRIERS.len()]> = LazyLock::new(|| {
        BARRIERS.map(|(name, parties)| {
            let mut parties: Vec<String> = parties.iter().map(|party| (*party).to_owned()).collect();
            parties.sort();
            BarrierKey { name: Name::try_from(name.to_owned()).unwrap(), parties }
        })
    });
    &KEYS[barrier]
}

/// Returns the generation of each barrier in an input.
fn received_generations(input: &Input) -> Vec<u64> {
    let mut received = vec![0; BARRIERS.len()];
    let Input::ArrivalsReceived { payload, .. } = input else { return received };
    for published in Arrivals::parse(payload).unwrap().barriers {
        if let Some(barrier) = BARRIERS.iter().position(|(name, _)| *name == &*published.name) {
            received[barrier] = published.generation;
        }
    }
    received
}

impl World {
    fn new(seed: u64, fault: Option<Fault>, history: &History) -> Self {
        let mut chance = Chance::new(seed);
        let nodes = links::nodes(&mut chance);
        let mut world = Self {
            chance,
            now: Time::from_nanos(1),
            clocks: Clocks::new(seed),
            rested: Time::ZERO,
            cores: Vec::new(),
            incarnations: vec![1; nodes],
            homes: (0..nodes).collect(),
            incarnation_counts: vec![1; nodes],
            duplicate: None,
            ended: BTreeSet::new(),
            youngest: BTreeMap::new(),
            up: BTreeSet::new(),
            unreported: BTreeSet::new(),
            flying: BTreeMap::new(),
            judge: Judge::new(seed.is_multiple_of(4), seed % 4 == 1),
            stages: BTreeMap::new(),
            fault,
            reasons: BTreeMap::new(),
            events: 0,
            ever: BTreeMap::new(),
            history: history.clone(),
            is_calm: seed.is_multiple_of(4),
            is_crowded: seed % 4 == 1,
            has_phases: seed.is_multiple_of(3),
        };
        for node in 0..nodes {
            let core = world.new_core(node);
            world.cores.push(core);
        }
        for node in 0..nodes {
            world.populate(node);
        }
        world
    }

    /// Returns the number of nodes, without duplicates.
    fn nodes(&self) -> usize {
        self.incarnation_counts.len()
    }

    fn new_core(&mut self, process: usize) -> Core {
        self.clocks.begin(process, self.now);
        let incarnation = Incarnation(self.incarnations[process]);
        let mut core = Core::new(&NodeConfig::new("n"), address(self.homes[process]), incarnation);
        if self.is_crowded {
            core.rendezvous_mut().barriers_max = FEW;
        }
        core
    }

    fn note(&self, words: impl FnOnce() -> String) {
        self.history.note(self.now, words);
    }

    fn feed(&mut self, node: usize, input: Input) {
        let received = received_generations(&input);
        let before = self.generations(node);
        self.judge.waits.record_input(node, self.now, &input);
        self.handle(node, input);
        for (barrier, received) in received.into_iter().enumerate() {
            if let Some(known) = self.cores[node].rendezvous().barriers.get(key(barrier)) {
                let (generation, members) = (known.generation, known.members_of_last().collect());
                self.judge.opened(barrier, generation, &members);
                if generation > before[barrier].max(received) {
                    self.judge.opened_independently(barrier, generation, members);
                }
            }
        }
        while let Some(output) = self.cores[node].poll() {
            self.execute(node, output);
        }
        let statuses = self.statuses(node);
        self.judge.waits.check_report(node, &statuses);
    }

    /// Handles an input. In one case of eight the sync manager fails while it executes its first output, and
    /// its successor is handed the same event.
    fn handle(&mut self, node: usize, input: Input) {
        self.events += 1;
        let position = (self.events, 1);
        let again = self.chance.once_in(8).then(|| input.clone());
        let now = self.time_of(node, &input);
        self.cores[node].woken(now, 0);
        self.cores[node].handle_once(now, position, input);
        let Some(again) = again else { return };
        self.judge.seen.handed_again += 1;
        // An output that is sent only once is lost with the actor, and is produced again.
        if let Some(output) = self.cores[node].poll().filter(|output| !output.is_sent_once()) {
            self.execute(node, output);
        }
        let now = self.clock(node);
        self.cores[node].replaced(now);
        if self.fault == Some(Fault::HandledAgain) {
            self.cores[node].handle(now, again);
        } else {
            self.cores[node].handle_once(now, position, again);
        }
    }

    fn execute(&mut self, node: usize, output: Output) {
        match output {
            Output::Publish { to, list } => self.fly(node, to, (false, list)),
            Output::PublishArrivals { to, frame } => self.fly(node, to, (true, frame)),
            Output::AnswerBarrier { correlation: UNJUDGED, answer, .. } => {
                let is_right =
                    matches!(&answer, BarrierAnswer::Refused { why } if why.contains("which is the limit"));
                assert!(is_right, "{answer:?}");
                self.judge.seen.crowded_out += 1;
            }
            Output::AnswerBarrier { app, correlation, answer } => {
                let app = (0..APPS).find(|other| app_address(*other) == app).unwrap();
                let answer = self.reported_answer(node, answer);
                self.note(|| {
                    format!("{} of process {node} receives {answer:?}", name(self.homes[node], app))
                });
                if correlation != judge::ELSEWHERE {
                    self.judge.answered((node, app), correlation, &answer, &self.generations(node));
                }
            }
            Output::Refused { cause, detail } => panic!("refused because of {cause}: {detail}"),
            Output::Release { .. }
            | Output::NotifyDirectory { .. }
            | Output::Notify { .. }
            | Output::RouteGroups { .. }
            | Output::Cycle { .. }
            | Output::Overdue(_)
            | Output::Misspelt { .. }
            | Output::SameName { .. } => {}
        }
    }

    fn generations(&self, node: usize) -> Vec<u64> {
        (0..BARRIERS.len()).map(|barrier| self.generation(node, barrier)).collect()
    }

    fn generation(&self, node: usize, barrier: usize) -> u64 {
        self.cores[node].rendezvous().barriers.get(key(barrier)).map_or(0, |known| known.generation)
    }

    fn step(&mut self) {
        let (node, other) = (self.any_process(None), self.chance.index(APPS));
        let (app, other) = (other, self.any_process(Some(node)));
        let more = if self.nodes() > FEW_NODES { 8 } else { 0 };
        if self.has_phases && self.chance.once_in(3) {
            self.come_up();
        }
        match self.chance.index(48 + more) {
            0..=13 => self.arrive(node, app),
            14 if !self.is_calm => self.leave(node, app),
            15 if !self.is_calm => self.die(node, app),
            16 => self.cut(node, other, false),
            17 => self.cut(node, other, !self.is_calm),
            18..=20 => self.restore(node, other),
            21 if !self.is_calm => self.restart(node),
            22..=23 => self.report_breaks(),
            24..=36 => {
                for _ in 0..=self.chance.index(4) {
                    self.deliver(node, other);
                }
            }
            37 if !self.is_calm => self.start_duplicate(node),
            38 => self.end_duplicate(),
            39..=40 if self.is_crowded => self.arrive_elsewhere(node, app),
            41..=43 => self.begin(),
            48..=51 => self.join(node),
            52..=55 => self.deliver_all(node),
            _ => {
                let time = Duration::from_millis([1, 3, 10, 60, 700][self.chance.index(5)]);
                if self.chance.once_in(8) { self.stand_still(time) } else { self.pass(time) }
            }
        }
    }

    /// Returns a living process other than `but`.
    fn any_process(&mut self, but: Option<usize>) -> usize {
        let living: Vec<usize> = self.living().filter(|process| Some(*process) != but).collect();
        living[self.chance.index(living.len())]
    }

    fn living(&self) -> impl Iterator<Item = usize> {
        (0..self.cores.len()).filter(|process| !self.ended.contains(process))
    }

    /// Heals every link and delivers everything.
    fn settle(&mut self) {
        self.end_duplicate();
        for a in 0..self.nodes() {
            for b in a + 1..self.nodes() {
                self.restore(a, b);
            }
        }
        for _ in 0..30 {
            self.pass(Duration::from_millis(5));
            for from in 0..self.nodes() {
                for to in 0..self.nodes() {
                    while from != to && self.deliver(from, to) {}
                }
            }
        }
    }

    /// Runs all steps of a seed. Returns the findings of the judge.
    fn run(mut self) -> (Vec<String>, judge::Seen) {
        for _ in 0..STEPS * self.nodes().max(FEW_NODES) / FEW_NODES {
            self.step();
        }
        self.settle();
        let directories: Vec<_> = self.cores.iter().take(self.nodes()).map(Core::directory).collect();
        for (node, directory) in directories.iter().enumerate() {
            if *directory != directories[0] {
                self.judge
                    .violations
                    .push(format!("nodes 0 and {node} have different directories after quiet"));
            }
        }
        // A node that keeps few barriers may have no room for one that only others report.
        let is_known = |node: &usize, barrier| {
            !self.is_crowded || self.cores[*node].rendezvous().barriers.contains_key(key(barrier))
        };
        let of_barrier = |barrier| (0..self.nodes()).filter(move |node| is_known(node, barrier));
        let generations: Vec<Vec<u64>> = (0..BARRIERS.len())
            .map(|barrier| of_barrier(barrier).map(|node| self.generation(node, barrier)).collect())
            .collect();
        self.judge.all_is_quiet(&generations);
        // No wait with a deadline outlasts this.
        self.pass(Duration::from_secs(1));
        self.judge.verdict()
    }
}

/// Runs a seed. The error names the number of nodes, if it is set.
fn run(seed: u64, fault: Option<Fault>, history: &History) -> Result<judge::Seen, String> {
    let (violations, seen) = World::new(seed, fault, history).run();
    if violations.is_empty() {
        return Ok(seen);
    }
    let set = number(NODES_VARIABLE).map(|nodes| format!("{NODES_VARIABLE}={nodes}: ")).unwrap_or_default();
    Err(set + &violations.join("\n"))
}

#[test]
fn barrier_opens_exactly_when_all_are_present() {
    let mut seen = judge::Seen::default();
    SEEDS.run(|seed, history| {
        seen.add(&run(seed, None, history)?);
        Ok(())
    });
    let seeds = SEEDS.numbers().count() as u64;
    println!("{seeds} seeds: {seen:?}");
    if seeds >= SEEDS.count {
        seen.must_cover_everything();
    }
}

#[test]
fn same_seed_gives_the_same_run() {
    let again = || run(7, None, &History::off());
    assert_eq!(again(), again());
}

#[test]
fn each_planted_fault_is_found() {
    let (faults, within) = (&Fault::ALL, SEEDS_FOR_A_FAULT);
    let found_last = [(Fault::EarlierLeftOut, 100)];
    let hunt = Hunt { seeds: &SEEDS, faults, within, found_last: &found_last };
    hunt.run(|seed, fault, history| run(seed, fault, history).map(drop));
}
