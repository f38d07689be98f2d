//! Several cores that exchange lists over links that break, nodes that restart, applications that come and go in any
//! order: nobody starts before what it requires has run; after quiet, everybody whose requirements can be met runs, who waits is told why, and
//! all nodes say the same. Faults that are planted into what cores are told, and what becomes of their orders, must be found.

mod judge;

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use proptest::{
    prelude::*,
    strategy::ValueTree,
    test_runner::{RngAlgorithm, TestRng, TestRunner},
};
use sinew_runtime::app::Requirement;

use super::*;
use crate::ndl::LossReason;

const NODES: usize = 3;
/// Each node may have these applications; names are `node.app`.
const APPS: usize = 3;
/// An application of each node that watches the directory.
const WATCHER: usize = 99;

/// Tries within which each planted fault must be found.
const TRIES_FOR_A_FAULT: u32 = 1_000;

/// A fault in what a core is told, or in what becomes of what it orders.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Fault {
    /// An application is told to be ready when it is registered.
    ReadyTooEarly,
    /// That an application failed is not told.
    FailureNotTold,
    /// That an application is not to be there any more is not told.
    EndNotTold,
    /// One list in three is lost on a link that stands.
    ListLost,
    /// One release in three is not carried out.
    ReleaseLost,
    /// An application is released as soon as it is registered.
    ReleasedAtOnce,
    /// Watchers of the directory are not told who has gone.
    GoneNotTold,
    /// Who waits is given no reason.
    ReasonsKept,
}

impl Fault {
    const ALL: [Self; 8] = [
        Self::ReadyTooEarly,
        Self::FailureNotTold,
        Self::EndNotTold,
        Self::ListLost,
        Self::ReleaseLost,
        Self::ReleasedAtOnce,
        Self::GoneNotTold,
        Self::ReasonsKept,
    ];
}

#[derive(Clone, Debug)]
enum Step {
    Register { node: usize, app: usize, requires: Vec<Wanted> },
    Start { node: usize, app: usize },
    Fail { node: usize, app: usize },
    Unregister { node: usize, app: usize },
    Cut { link: usize },
    Restore { link: usize },
    Lose { link: usize },
    Restart { node: usize },
    Deliver { link: usize, count: usize },
    Pass { millis: u64 },
}

/// A requirement of any form.
#[derive(Clone, Debug, PartialEq)]
enum Wanted {
    /// At least so many of these applications.
    AtLeast { count: usize, of: BTreeSet<usize> },
    /// At least so many of this node's.
    OfNode { count: usize, node: usize },
}

fn any_wanted() -> impl Strategy<Value = Wanted> {
    let of = |sizes| proptest::collection::btree_set(0..NODES * APPS, sizes);
    prop_oneof![
        3 => of(1..2).prop_map(|of| Wanted::AtLeast { count: 1, of }),
        1 => of(2..4).prop_map(|of| Wanted::AtLeast { count: 1, of }),
        1 => of(2..4).prop_map(|of| Wanted::AtLeast { count: 2, of }),
        1 => (1usize..3, 0..NODES).prop_map(|(count, node)| Wanted::OfNode { count, node }),
    ]
}

impl Wanted {
    /// What an application may require so that there is no circle: those with a smaller number than its own.
    fn below(self, index: usize) -> Option<Self> {
        match self {
            Self::AtLeast { count, of } => {
                let of: BTreeSet<usize> = of.into_iter().filter(|wanted| *wanted < index).collect();
                (of.len() >= count).then_some(Self::AtLeast { count, of })
            }
            Self::OfNode { count, node } => {
                ((node + 1) * APPS <= index).then_some(Self::OfNode { count, node })
            }
        }
    }

    fn requirement(&self) -> Requirement {
        match self {
            Self::AtLeast { count, of } => Requirement::at_least(*count, of.iter().map(|index| name(*index))),
            Self::OfNode { count, node } => Requirement::at_least(*count, [format!("{node}.*")]),
        }
    }

    /// The judge's own reading of it.
    fn is_met_by(&self, is_there: impl Fn(usize) -> bool) -> bool {
        match self {
            Self::AtLeast { count, of } => of.iter().filter(|index| is_there(**index)).count() >= *count,
            Self::OfNode { count, node } => {
                (node * APPS..(node + 1) * APPS).filter(|index| is_there(*index)).count() >= *count
            }
        }
    }
}

fn any_step() -> impl Strategy<Value = Step> {
    let pair = (0..NODES, 0..APPS);
    let requires = proptest::collection::vec(any_wanted(), 0..4);
    let link = 0..NODES;
    prop_oneof![
        4 => (pair.clone(), requires).prop_map(|((node, app), requires)| Step::Register { node, app, requires }),
        6 => pair.clone().prop_map(|(node, app)| Step::Start { node, app }),
        2 => pair.clone().prop_map(|(node, app)| Step::Fail { node, app }),
        1 => pair.prop_map(|(node, app)| Step::Unregister { node, app }),
        1 => link.clone().prop_map(|link| Step::Cut { link }),
        2 => link.clone().prop_map(|link| Step::Restore { link }),
        1 => link.clone().prop_map(|link| Step::Lose { link }),
        1 => (0..NODES).prop_map(|node| Step::Restart { node }),
        6 => (link, 1usize..4).prop_map(|(link, count)| Step::Deliver { link, count }),
        2 => (1u64..3_000).prop_map(|millis| Step::Pass { millis }),
    ]
}

/// An application as its own node's root sees it.
#[derive(Clone, Debug, PartialEq)]
struct Life {
    requires: Vec<Wanted>,
    released: u32,
    running: bool,
}

struct World {
    now: Time,
    cores: Vec<Core>,
    incarnations: Vec<u64>,
    apps: Vec<BTreeMap<usize, Life>>,
    up: Vec<bool>,
    /// Lists on their way, by link and direction.
    flying: BTreeMap<(usize, bool), VecDeque<Bytes>>,
    /// What an application of each node knows of the directory, by what it was told and took.
    views: Vec<BTreeMap<(String, Tid), bool>>,
    told: u64,
    takes_all: bool,
    /// Applications that have run in any life.
    has_run: BTreeSet<usize>,
    fault: Option<Fault>,
    /// Orders that a fault may strike.
    struck: u64,
    violations: Vec<String>,
}

/// The two ends of a link.
const fn ends(link: usize) -> (usize, usize) {
    (link, (link + 1) % NODES)
}

fn address(node: usize) -> NodeAddress {
    NodeAddress::new(0x7f00_0001 + node as u32)
}

fn name(index: usize) -> String {
    format!("{}.{}", index / APPS, index % APPS)
}

fn app_address(app: usize) -> AppAddress {
    AppAddress::fixed(app as u32).unwrap()
}

impl World {
    fn new(fault: Option<Fault>) -> Self {
        let mut world = Self {
            now: Time::from_nanos(1),
            cores: Vec::new(),
            incarnations: vec![1; NODES],
            apps: vec![BTreeMap::new(); NODES],
            up: vec![false; NODES],
            flying: BTreeMap::new(),
            views: vec![BTreeMap::new(); NODES],
            told: 0,
            takes_all: false,
            has_run: BTreeSet::new(),
            fault,
            struck: 0,
            violations: Vec::new(),
        };
        world.cores = (0..NODES).map(|node| world.new_core(node)).collect();
        (0..NODES).for_each(|node| world.watch(node));
        world
    }

    /// An application without a name wants to hear of the directory.
    fn watch(&mut self, node: usize) {
        self.views[node].clear();
        let app = app_address(WATCHER);
        self.tell(node, Input::AppChanged(AppFact::Registered { app, name: None, requires: Vec::new() }));
        self.tell(node, Input::AppChanged(AppFact::Ready { app }));
        self.tell(node, Input::DirectoryWanted { app });
    }

    /// It takes two of three events, and in the end all.
    fn told_of_directory(&mut self, node: usize, event: DirectoryEvent) {
        self.told += 1;
        if self.told.is_multiple_of(3) && !self.takes_all {
            return self.cores[node]
                .handle(self.now, Input::DirectoryNotTaken { app: app_address(WATCHER), event });
        }
        match event {
            DirectoryEvent::Is(entry) => drop(self.views[node].insert((entry.name, entry.tid), entry.ready)),
            DirectoryEvent::Gone { .. } if self.fault == Some(Fault::GoneNotTold) => {}
            DirectoryEvent::Gone { name, tid } => drop(self.views[node].remove(&(name, tid))),
        }
    }

    fn new_core(&self, node: usize) -> Core {
        Core::new(&NodeConfig::new("n"), address(node), Incarnation(self.incarnations[node]))
    }

    fn tell(&mut self, node: usize, input: Input) {
        self.cores[node].handle(self.now, input);
        while let Some(output) = self.cores[node].poll() {
            self.carry_out(node, output);
        }
    }

    /// Whether a fault strikes now: one time in three.
    fn strikes(&mut self, fault: Fault) -> bool {
        self.struck += u64::from(self.fault == Some(fault));
        self.fault == Some(fault) && self.struck.is_multiple_of(3)
    }

    fn violate(&mut self, is_so: bool, words: impl FnOnce() -> String) {
        self.violations.extend(judge::require(is_so, words).err());
    }

    fn carry_out(&mut self, node: usize, output: Output) {
        match output {
            Output::Release { app } if app == app_address(WATCHER) => {}
            Output::Release { .. } if self.strikes(Fault::ReleaseLost) => {}
            Output::Publish { .. } if self.strikes(Fault::ListLost) => {}
            Output::Release { app } => self.released(node, app),
            Output::TellDirectory { event, .. } => self.told_of_directory(node, event),
            Output::Publish { to, list } => {
                let to = (to.bits() - address(0).bits()) as usize;
                let link = (0..NODES).find(|link| [(node, to), (to, node)].contains(&ends(*link))).unwrap();
                assert!(self.up[link], "a list was sent over a link that is down");
                self.flying.entry((link, ends(link).0 == node)).or_default().push_back(list);
            }
            Output::Tell { app, event, .. } => {
                let released = self.life(node, app).1.released;
                self.violate(released == 1, || format!("told before it was released: {event:?}"));
            }
            Output::Refused { cause, detail } => panic!("refused because of {cause}: {detail}"),
            Output::PublishArrivals { .. }
            | Output::AnswerBarrier { .. }
            | Output::RouteGroups { .. }
            | Output::Cycle { .. }
            | Output::Overdue(_)
            | Output::SameName { .. } => {}
        }
    }

    fn life(&mut self, node: usize, app: AppAddress) -> (usize, &mut Life) {
        let index = (0..APPS).find(|index| app_address(*index) == app).unwrap();
        (index, self.apps[node].get_mut(&index).expect("a release for who is not registered"))
    }

    /// No release before all is ready, and one for each life.
    fn released(&mut self, node: usize, app: AppAddress) {
        let ready: BTreeSet<String> = self.cores[node]
            .directory()
            .into_iter()
            .filter(|entry| entry.ready)
            .map(|entry| entry.name)
            .collect();
        let (index, life) = self.life(node, app);
        life.released += 1;
        let (released, requires) = (life.released, life.requires.clone());
        let who = name(node * APPS + index);
        self.violate(released == 1, || format!("{who} is released twice in one life"));
        for wanted in requires {
            let is_met = wanted.is_met_by(|index| ready.contains(&name(index)));
            self.violate(is_met, || {
                format!("{who} is released early: {wanted:?} is not met, as its node sees it")
            });
            // What was heard last may be out of date, and was so once.
            let has_been = wanted.is_met_by(|index| self.has_run.contains(&index));
            self.violate(has_been, || format!("{who} is released early: {wanted:?} has never run"));
        }
    }

    fn step(&mut self, step: Step) {
        match step {
            Step::Register { node, app, requires } => self.register(node, app, requires),
            Step::Start { node, app } => self.start(node, app),
            Step::Fail { node, app } => {
                if let Some(life) = self.apps[node].get_mut(&app) {
                    // One that waits goes on waiting in the same life.
                    if life.released == 1 {
                        (life.released, life.running) = (0, false);
                    }
                    if self.fault != Some(Fault::FailureNotTold) {
                        self.tell(node, Input::AppChanged(AppFact::Down { app: app_address(app) }));
                    }
                }
            }
            Step::Unregister { node, app } => {
                self.apps[node].remove(&app);
                if self.fault == Some(Fault::EndNotTold) {
                    return;
                }
                self.tell(node, Input::AppChanged(AppFact::Unregistered { app: app_address(app) }));
            }
            Step::Cut { link } => self.cut(link),
            Step::Restore { link } => self.restore(link),
            Step::Lose { link } => {
                self.cut(link);
                let why = LossReason::LinkDown;
                self.tell_ends(link, |node, incarnation| {
                    Input::MembershipChanged(MembershipFact::NodeLost { node, incarnation, why })
                });
            }
            Step::Restart { node } => self.restart(node),
            Step::Deliver { link, count } => {
                for _ in 0..count {
                    self.deliver(link, true);
                    self.deliver(link, false);
                }
            }
            Step::Pass { millis } => self.pass(Duration::from_millis(millis)),
        }
    }

    fn register(&mut self, node: usize, app: usize, wanted: Vec<Wanted>) {
        // Requirements point to smaller numbers only, so that there is no cycle.
        let index = node * APPS + app;
        let mut requires: Vec<Wanted> = wanted.into_iter().filter_map(|wanted| wanted.below(index)).collect();
        requires.dedup();
        // Told again, it is no new life.
        if self.apps[node].get(&app).is_none_or(|life| life.requires != requires) {
            let life = Life { requires: requires.clone(), released: 0, running: false };
            self.apps[node].insert(app, life);
        }
        let requires = requires.iter().map(|wanted| wanted.requirement().to_string()).collect();
        let address = app_address(app);
        let fact = AppFact::Registered { app: address, name: Some(name(index)), requires };
        self.tell(node, Input::AppChanged(fact));
        if self.fault == Some(Fault::ReadyTooEarly) {
            self.tell(node, Input::AppChanged(AppFact::Ready { app: address }));
        }
        if self.fault == Some(Fault::ReleasedAtOnce) && self.apps[node][&app].released == 0 {
            self.released(node, address);
        }
    }

    fn start(&mut self, node: usize, app: usize) {
        if let Some(life) = self.apps[node].get_mut(&app)
            && life.released == 1
            && !life.running
        {
            life.running = true;
            self.has_run.insert(node * APPS + app);
            self.tell(node, Input::AppChanged(AppFact::Ready { app: app_address(app) }));
        }
    }

    fn tell_ends(&mut self, link: usize, input: impl Fn(NodeAddress, Incarnation) -> Input) {
        let (a, b) = ends(link);
        for (node, peer) in [(a, b), (b, a)] {
            self.tell(node, input(address(peer), Incarnation(self.incarnations[peer])));
        }
    }

    fn cut(&mut self, link: usize) {
        if std::mem::take(&mut self.up[link]) {
            self.flying.retain(|(other, _), _| *other != link);
            self.tell_ends(link, |node, incarnation| {
                Input::LinkChanged(LinkFact::LinkBroken { node, incarnation })
            });
        }
    }

    fn restore(&mut self, link: usize) {
        if !std::mem::replace(&mut self.up[link], true) {
            self.tell_ends(link, |node, incarnation| {
                Input::LinkChanged(LinkFact::LinkUp { node, incarnation })
            });
        }
    }

    fn restart(&mut self, node: usize) {
        for link in (0..NODES).filter(|link| ends(*link).0 == node || ends(*link).1 == node) {
            self.cut(link);
        }
        self.incarnations[node] += 1;
        self.apps[node].clear();
        self.cores[node] = self.new_core(node);
        self.watch(node);
    }

    fn deliver(&mut self, link: usize, forward: bool) -> bool {
        let Some(payload) = self.flying.get_mut(&(link, forward)).and_then(VecDeque::pop_front) else {
            return false;
        };
        let (a, b) = ends(link);
        let (from, to) = if forward { (a, b) } else { (b, a) };
        self.tell(to, Input::ListReceived { from: address(from), payload });
        true
    }

    fn pass(&mut self, time: Duration) {
        self.now = self.now + time;
        for node in 0..NODES {
            self.tell(node, Input::TimePassed);
        }
    }

    /// Heals every link and lets everything happen that can.
    fn settle(&mut self) {
        (0..NODES).for_each(|link| self.restore(link));
        self.takes_all = true;
        for _ in 0..NODES * APPS + 2 {
            self.pass(barrier::RETRY);
            for link in 0..NODES {
                while self.deliver(link, true) || self.deliver(link, false) {}
            }
            for index in 0..NODES * APPS {
                self.start(index / APPS, index % APPS);
            }
        }
    }
}

/// What happens; what is found to be wrong.
fn play(steps: Vec<Step>, fault: Option<Fault>) -> Result<(), String> {
    let mut world = World::new(fault);
    steps.into_iter().for_each(|step| world.step(step));
    world.settle();
    match world.violations.first() {
        Some(violation) => Err(violation.clone()),
        None => world.verdict(),
    }
}

fn any_steps() -> impl Strategy<Value = Vec<Step>> {
    proptest::collection::vec(any_step(), 0..80)
}

proptest! {
    #[test]
    fn after_quiet_all_who_can_run_do_and_all_nodes_agree(steps in any_steps()) {
        prop_assert_eq!(play(steps, None), Ok(()));
    }
}

#[test]
fn each_planted_fault_is_found() {
    for fault in Fault::ALL {
        let random = TestRng::deterministic_rng(RngAlgorithm::ChaCha);
        let mut runner = TestRunner::new_with_rng(ProptestConfig::default(), random);
        let mut tries = 0..TRIES_FOR_A_FAULT;
        let found = tries.find_map(|number| {
            let steps = any_steps().new_tree(&mut runner).expect("nothing is filtered").current();
            Some((number, play(steps, Some(fault)).err()?))
        });
        let Some((number, words)) = found else {
            panic!("{fault:?} is not found in {TRIES_FOR_A_FAULT} tries");
        };
        println!("{fault:?}: try {number}: {words}");
    }
}
