//! The cores, and what becomes of what they order.

use super::{apps::Life, judge::require, *};

/// Of each node; so large that clocks can begin anew.
const FIRST_LIFE: u64 = 1_000_000;

/// How often what happened, so that a quiet simulation is noticed.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Seen(BTreeMap<&'static str, u64>);

impl Seen {
    const WHAT: [&'static str; 21] = [
        "nodes",
        "lists",
        "lists lost",
        "links cut",
        "breaks heard late",
        "losses one way",
        "losses",
        "parts",
        "restarts",
        "clocks anew",
        "goodbyes",
        "found without a link",
        "events handed over again",
        "pauses",
        "released",
        "done without",
        "phases reached",
        "lacks told",
        "not taken",
        "shared names",
        "crowds",
    ];

    pub(super) fn count(&mut self, what: &'static str, times: u64) {
        debug_assert!(Self::WHAT.contains(&what), "{what}");
        *self.0.entry(what).or_default() += times;
    }

    pub(super) fn add(&mut self, other: &Self) {
        other.0.iter().for_each(|(what, times)| self.count(what, *times));
    }

    pub(super) fn must_cover_everything(&self) {
        let is_tried = |what: &&str| self.0.get(what).is_some_and(|times| *times >= 3);
        assert!(Self::WHAT.iter().all(is_tried), "something was hardly tried: {self:?}");
    }
}

pub(super) struct World {
    pub(super) nodes: usize,
    pub(super) now: Time,
    pub(super) chance: fastrand::Rng,
    pub(super) cores: Vec<Core>,
    pub(super) incarnations: Vec<u64>,
    /// The earliest life of each node.
    pub(super) earliest: Vec<u64>,
    /// Which life of the second a node's link led to last.
    pub(super) met: BTreeMap<Ends, u64>,
    /// Which life of the second the first was told of last; none where it was told that this one is over.
    pub(super) present: BTreeMap<Ends, Option<u64>>,
    /// To which life of the second the first has a link, as it was told.
    pub(super) linked: BTreeMap<Ends, u64>,
    /// What the last list said that came over the present link: how far applications of the second have come, as the first was told.
    pub(super) heard: BTreeMap<Ends, BTreeMap<usize, Come>>,
    /// That list, also where the link has broken since.
    pub(super) former: BTreeMap<Ends, Bytes>,
    pub(super) apps: Vec<BTreeMap<usize, Life>>,
    /// Links that carry lists, the smaller end first.
    pub(super) up: BTreeSet<Ends>,
    /// Which life of the second was linked with the first, which has not heard yet that it is not any more.
    pub(super) unheard: BTreeMap<Ends, u64>,
    pub(super) paused: BTreeSet<usize>,
    /// Lists on their way, from and to.
    pub(super) flying: BTreeMap<Ends, VecDeque<Bytes>>,
    /// What an application of each node knows of the directory, by what it was told and took.
    pub(super) views: Vec<BTreeMap<(String, Tid), bool>>,
    told: u64,
    /// What cores were told, counted.
    events: u64,
    pub(super) takes_all: bool,
    /// How far applications have come in any life.
    pub(super) has_come: BTreeMap<usize, Come>,
    pub(super) fault: Option<Fault>,
    /// Orders that a fault may strike.
    struck: u64,
    /// The list that went last, from and to.
    pub(super) last: BTreeMap<Ends, Bytes>,
    /// The newest version that a node has heard of anybody.
    pub(super) newest: BTreeMap<usize, u64>,
    is_traced: bool,
    pub(super) seen: Seen,
    pub(super) violations: Vec<String>,
}

impl World {
    pub(super) fn new(plan: &Plan, fault: Option<Fault>, is_traced: bool) -> Self {
        let nodes = plan.nodes;
        let mut world = Self {
            nodes,
            now: Time::from_nanos(1),
            chance: fastrand::Rng::with_seed(!plan.seed),
            cores: Vec::new(),
            incarnations: vec![FIRST_LIFE; nodes],
            earliest: vec![FIRST_LIFE; nodes],
            met: BTreeMap::new(),
            present: BTreeMap::new(),
            linked: BTreeMap::new(),
            heard: BTreeMap::new(),
            former: BTreeMap::new(),
            apps: vec![BTreeMap::new(); nodes],
            up: BTreeSet::new(),
            unheard: BTreeMap::new(),
            paused: BTreeSet::new(),
            flying: BTreeMap::new(),
            views: vec![BTreeMap::new(); nodes],
            told: 0,
            events: 0,
            takes_all: false,
            has_come: BTreeMap::new(),
            fault,
            struck: 0,
            last: BTreeMap::new(),
            newest: BTreeMap::new(),
            is_traced,
            seen: Seen::default(),
            violations: Vec::new(),
        };
        world.seen.count("nodes", nodes as u64);
        world.seen.count("crowds", u64::from(nodes > 8));
        world.cores = (0..nodes).map(|node| world.new_core(node)).collect();
        (0..nodes).for_each(|node| world.watch(node));
        world
    }

    pub(super) fn say(&self, what: impl FnOnce() -> String) {
        if self.is_traced {
            println!("{:>9.3} ms  {}", self.now.as_nanos() as f64 / 1e6, what());
        }
    }

    /// All that happens. What is found to be wrong.
    pub(super) fn run(mut self, steps: Vec<Step>) -> (Vec<String>, Seen) {
        self.say(|| format!("{} nodes", self.nodes));
        steps.into_iter().for_each(|step| self.step(step));
        self.settle();
        if self.violations.is_empty() {
            self.violations.extend(self.verdict().err());
        }
        (self.violations, self.seen)
    }

    /// Whether an application there is told of the directory: on each node of a few, on some of many, for it is read whole for each change.
    pub(super) const fn is_watched(&self, node: usize) -> bool {
        node.is_multiple_of(self.nodes.div_ceil(8))
    }

    /// An application without a name wants to hear of the directory.
    pub(super) fn watch(&mut self, node: usize) {
        self.views[node].clear();
        if !self.is_watched(node) {
            return;
        }
        let app = app_address(WATCHER);
        self.tell(node, Input::AppChanged(AppFact::own_registered(app, None, Vec::new())));
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

    pub(super) fn new_core(&self, node: usize) -> Core {
        let mut config = NodeConfig::new("n");
        // Room for all others, and for nobody else.
        config.ndl.nodes_max = self.nodes - 1;
        Core::new(&config, address(node), Incarnation(self.incarnations[node]))
    }

    pub(super) fn tell(&mut self, node: usize, input: Input) {
        let peer = self.note_presence(node, &input);
        if !self.is_kept_back(&input) {
            self.handle(node, input);
        }
        if let Some(peer) = peer {
            self.judge_presence((node, peer));
        }
        self.carry_out_all(node);
    }

    /// Tells it something that is not so.
    pub(super) fn deceive(&mut self, node: usize, input: Input) {
        self.handle(node, input);
        self.carry_out_all(node);
    }

    fn carry_out_all(&mut self, node: usize) {
        let mut lists = 0;
        while let Some(output) = self.cores[node].poll() {
            lists += usize::from(matches!(output, Output::Publish { .. }));
            let is_lost = matches!(output, Output::Publish { .. })
                && lists > 2
                && self.fault == Some(Fault::TwoListsATurn);
            if !is_lost {
                self.carry_out(node, output);
            }
        }
    }

    /// Whether a fault keeps it from the node.
    fn is_kept_back(&mut self, input: &Input) -> bool {
        if matches!(input, Input::LinkChanged(LinkFact::LinkBroken { .. })) {
            self.strikes(Fault::BreakNotTold)
        } else if matches!(input, Input::MembershipChanged(MembershipFact::NodeLost { .. })) {
            self.strikes(Fault::LossNotTold)
        } else {
            false
        }
    }

    /// In one case of eight the sync manager fails with an order in hand, before it carries it out if it is one that is given once, and its successor
    /// is handed the same event.
    fn handle(&mut self, node: usize, input: Input) {
        self.events += 1;
        let place = (self.events, 1);
        let again = (self.chance.usize(..8) == 0).then(|| input.clone());
        self.cores[node].handle_once(self.now, place, input);
        let Some(again) = again else { return };
        self.seen.count("events handed over again", 1);
        // What is said once is lost with the actor, and given again.
        if let Some(output) = self.cores[node].poll().filter(|output| !output.is_said_once()) {
            self.carry_out(node, output);
        }
        self.cores[node].replaced(self.now);
        if self.fault == Some(Fault::HandledAgain) {
            self.cores[node].handle(self.now, again);
        } else {
            self.cores[node].handle_once(self.now, place, again);
        }
    }

    /// Whether a fault strikes now: one time in three.
    fn strikes(&mut self, fault: Fault) -> bool {
        self.struck += u64::from(self.fault == Some(fault));
        self.fault == Some(fault) && self.struck.is_multiple_of(3)
    }

    /// Whether there is no room for what is said once: one time in five, and not in the end.
    fn is_refused(&mut self) -> bool {
        let is_refused = !self.takes_all && self.chance.usize(..5) == 0;
        self.seen.count("not taken", u64::from(is_refused));
        is_refused
    }

    pub(super) fn violate(&mut self, is_so: bool, words: impl FnOnce() -> String) {
        self.violations.extend(require(is_so, words).err());
    }

    fn carry_out(&mut self, node: usize, output: Output) {
        match output {
            Output::Release { app } if app == app_address(WATCHER) => {}
            Output::Release { .. } if self.strikes(Fault::ReleaseLost) => {}
            Output::Release { app } if self.is_refused() => {
                self.cores[node].handle(self.now, Input::ReleaseNotTaken { app });
            }
            Output::Release { app } => self.released(node, app),
            Output::TellDirectory { event, .. } => self.told_of_directory(node, event),
            Output::Publish { to, list } => self.fly(node, to, list),
            Output::Tell { event: RequirementEvent::Met { .. }, .. } if self.strikes(Fault::MetNotTold) => {}
            Output::Tell {
                event: RequirementEvent::Lost { .. } | RequirementEvent::Without { .. }, ..
            } if self.strikes(Fault::LackNotTold) => {}
            Output::Tell { app, event, .. } if self.is_refused() => {
                let name = event.name().to_owned();
                self.cores[node].handle(self.now, Input::EventNotTaken { app, name });
            }
            Output::Tell { app, event, .. } => {
                self.seen.count("lacks told", u64::from(!matches!(event, RequirementEvent::Met { .. })));
                self.say(|| format!("{app} of node {node} is told {event:?}"));
                let life = self.life(node, app).1;
                let released = life.released;
                life.hear(event.clone());
                // That something is met again says nothing to who does not run yet.
                let is_early = released == 0 && !matches!(event, RequirementEvent::Met { .. });
                self.violate(!is_early, || format!("told before it was released: {event:?}"));
            }
            Output::Refused { cause, detail } => {
                self.violations.push(format!("node {node} refuses because of {cause}: {detail}"));
            }
            Output::PublishArrivals { .. }
            | Output::AnswerBarrier { .. }
            | Output::RouteGroups { .. }
            | Output::Cycle { .. }
            | Output::Overdue(_)
            | Output::Misspelt { .. }
            | Output::SameName { .. } => {}
        }
    }

    fn step(&mut self, step: Step) {
        self.say(|| format!("{step:?}"));
        match step {
            // Nothing of a process that is stopped goes on.
            Step::Register { node, .. }
            | Step::Start { node, .. }
            | Step::Reach { node, .. }
            | Step::Fail { node, .. }
            | Step::Unregister { node, .. }
            | Step::Leave { node }
            | Step::HearOfBreaks { node }
                if self.paused.contains(&node) => {}
            Step::Register { node, slot, requires } => self.register(node, slot, requires),
            Step::Start { node, slot } => drop(self.start(node, slot)),
            Step::Reach { node, slot } => drop(self.reach(node, slot)),
            Step::Fail { node, slot } => self.fail(node, slot),
            Step::Unregister { node, slot } => self.unregister(node, slot),
            Step::Cut { ends, loss } => self.cut(ends, loss),
            Step::Restore { ends } => self.restore(ends),
            Step::Find { ends } => self.find(ends),
            Step::Part { side, loss } => self.part(side, loss),
            Step::Join { node } => self.join(node),
            Step::Restart { node, clock } => self.restart(node, clock),
            Step::Leave { node } => self.leave(node),
            Step::Pause { node } => self.pause(node),
            Step::Resume { node } => drop(self.paused.remove(&node)),
            Step::HearOfBreaks { node } => self.hear_of_breaks(node),
            Step::Drop { ends } => {
                let lost = self.flying.get_mut(&ends).and_then(VecDeque::pop_front);
                self.seen.count("lists lost", u64::from(lost.is_some()));
            }
            Step::Deliver { ends: (one, other), count } => {
                for ends in [(one, other), (other, one)] {
                    for _ in 0..count {
                        self.deliver(ends);
                    }
                }
            }
            Step::Hear { node, count } => {
                for other in 0..self.nodes {
                    for _ in 0..count {
                        self.deliver((other, node));
                    }
                }
            }
            Step::Pass { millis } => self.pass(Duration::from_millis(millis)),
        }
    }

    pub(super) fn pass(&mut self, time: Duration) {
        self.now = self.now + time;
        for node in 0..self.nodes {
            if !self.paused.contains(&node) {
                self.tell(node, Input::TimePassed);
            }
        }
    }

    /// Heals everything and lets everything happen that can; twice, with time for what was lost to be said again.
    fn settle(&mut self) {
        self.say(|| "all is well from now on".to_owned());
        self.paused.clear();
        (0..self.nodes).for_each(|node| self.join(node));
        self.takes_all = true;
        self.come_to_rest();
        self.pass(peers::REPEAT);
        self.come_to_rest();
    }

    /// Until nothing has happened for as long as anything may take. Each round starts somebody, or ends what was begun.
    fn come_to_rest(&mut self) {
        let mut idle = Duration::ZERO;
        let longest = Duration::from_millis(PATIENCE_MAX).max(barrier::SILENCE);
        let rounds_each = longest.as_millis().div_ceil(barrier::RETRY.as_millis()) + 2;
        for _ in 0..(self.nodes * SLOTS + 20) as u128 * rounds_each {
            self.pass(barrier::RETRY);
            let is_heard = self.hear_all();
            let slots = (0..self.nodes).flat_map(|node| (0..SLOTS).map(move |slot| (node, slot)));
            let slots: Vec<_> = slots.collect();
            let started = slots.iter().filter(|(node, slot)| self.start(*node, *slot)).count();
            let reached = slots.iter().filter(|(node, slot)| self.reach(*node, *slot)).count();
            idle = if is_heard || started + reached > 0 { Duration::ZERO } else { idle + barrier::RETRY };
            if idle > longest {
                return;
            }
        }
        self.violations.push("it does not come to rest".to_owned());
    }
}
