//! The cores, and the execution of their outputs.

use super::{apps::Life, judge::require, *};

/// The first incarnation of each node; so large that clocks can be reset.
const FIRST_INCARNATION: u64 = 1_000_000;

/// The situations that a run of all seeds must cover.
pub(super) const SITUATIONS: [&str; 21] = [
    "nodes",
    "lists",
    "lists lost",
    "links cut",
    "breaks reported late",
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
    "lacks reported",
    "rejected",
    "shared names",
    "crowds",
];

/// The cores of all nodes, and the true state around them.
pub(super) struct World {
    pub(super) nodes: usize,
    pub(super) now: Time,
    pub(super) chance: fastrand::Rng,
    pub(super) cores: Vec<Core>,
    pub(super) incarnations: Vec<u64>,
    /// The earliest incarnation of each node.
    pub(super) earliest: Vec<u64>,
    /// The incarnation of the second to which the link of the first led last.
    pub(super) met: BTreeMap<Ends, u64>,
    /// The incarnation of the second that the first was notified of last; `None` after it was notified of its
    /// end.
    pub(super) present: BTreeMap<Ends, Option<u64>>,
    /// The incarnation of the second to which the first has a link, by its inputs.
    pub(super) linked: BTreeMap<Ends, u64>,
    /// The contents of the last list over the present link: the states of the second's applications, as the
    /// first received them.
    pub(super) received: BTreeMap<Ends, BTreeMap<usize, AppState>>,
    /// That list, also where the link has broken since.
    pub(super) former: BTreeMap<Ends, Bytes>,
    pub(super) apps: Vec<BTreeMap<usize, Life>>,
    /// Links that carry lists, the smaller end first.
    pub(super) up: BTreeSet<Ends>,
    /// The incarnation of the second that was linked with the first, while the first has not been notified of
    /// the break.
    pub(super) unreported: BTreeMap<Ends, u64>,
    pub(super) paused: BTreeSet<usize>,
    /// Lists in flight, by sender and receiver.
    pub(super) flying: BTreeMap<Ends, Pipe<Bytes>>,
    /// The directory by the events that an application of each node received and accepted.
    pub(super) views: Vec<BTreeMap<(String, Tid), bool>>,
    notifications: u64,
    /// The number of inputs of cores.
    events: u64,
    pub(super) takes_all: bool,
    /// The furthest state of each application in any life.
    pub(super) furthest: BTreeMap<usize, AppState>,
    pub(super) fault: Option<Fault>,
    /// Outputs that a fault may affect.
    struck: u64,
    /// The last sent list, by sender and receiver.
    pub(super) last: BTreeMap<Ends, Bytes>,
    /// The newest version that a node has received from any other.
    pub(super) newest: BTreeMap<usize, u64>,
    history: History,
    pub(super) seen: Coverage,
    pub(super) violations: Vec<String>,
}

impl World {
    pub(super) fn new(plan: &Plan, fault: Option<Fault>, history: &History) -> Self {
        let nodes = plan.nodes;
        let mut world = Self {
            nodes,
            now: Time::from_nanos(1),
            chance: fastrand::Rng::with_seed(!plan.seed),
            cores: Vec::new(),
            incarnations: vec![FIRST_INCARNATION; nodes],
            earliest: vec![FIRST_INCARNATION; nodes],
            met: BTreeMap::new(),
            present: BTreeMap::new(),
            linked: BTreeMap::new(),
            received: BTreeMap::new(),
            former: BTreeMap::new(),
            apps: vec![BTreeMap::new(); nodes],
            up: BTreeSet::new(),
            unreported: BTreeMap::new(),
            paused: BTreeSet::new(),
            flying: BTreeMap::new(),
            views: vec![BTreeMap::new(); nodes],
            notifications: 0,
            events: 0,
            takes_all: false,
            furthest: BTreeMap::new(),
            fault,
            struck: 0,
            last: BTreeMap::new(),
            newest: BTreeMap::new(),
            history: history.clone(),
            seen: Coverage::default(),
            violations: Vec::new(),
        };
        world.seen.add("nodes", nodes as u64);
        world.seen.add("crowds", u64::from(nodes > 8));
        world.cores = (0..nodes).map(|node| world.new_core(node)).collect();
        (0..nodes).for_each(|node| world.watch(node));
        world
    }

    pub(super) fn note(&self, words: impl FnOnce() -> String) {
        self.history.note(self.now, words);
    }

    /// Runs all steps. Returns the counts of situations.
    ///
    /// # Errors
    /// Returns the violations, one a line.
    pub(super) fn run(mut self, steps: Vec<Step>) -> Result<Coverage, String> {
        self.note(|| format!("{} nodes", self.nodes));
        steps.into_iter().for_each(|step| self.step(step));
        self.settle();
        if self.violations.is_empty() {
            self.violations.extend(self.verdict().err());
        }
        if self.violations.is_empty() { Ok(self.seen) } else { Err(self.violations.join("\n")) }
    }

    /// Returns whether an application of the node subscribes to the directory: on each of a few nodes, on
    /// some of many, as the whole directory is read for each change.
    pub(super) const fn is_watched(&self, node: usize) -> bool {
        node.is_multiple_of(self.nodes.div_ceil(8))
    }

    /// Subscribes an application without a name to the directory.
    pub(super) fn watch(&mut self, node: usize) {
        self.views[node].clear();
        if !self.is_watched(node) {
            return;
        }
        let app = app_address(WATCHER);
        self.feed(node, Input::AppChanged(AppFact::own_registered(app, None, Vec::new())));
        self.feed(node, Input::AppChanged(AppFact::Ready { app }));
        self.feed(node, Input::DirectoryWanted { app });
    }

    /// Delivers an event to the subscriber. It accepts two of three events, and at the end all.
    fn directory_event(&mut self, node: usize, event: DirectoryEvent) {
        self.notifications += 1;
        if self.notifications.is_multiple_of(3) && !self.takes_all {
            return self.cores[node]
                .handle(self.now, Input::DirectoryRejected { app: app_address(WATCHER), event });
        }
        match event {
            DirectoryEvent::Is(entry) => drop(self.views[node].insert((entry.name, entry.tid), entry.ready)),
            DirectoryEvent::Gone { .. } if self.fault == Some(Fault::RemovalNotReported) => {}
            DirectoryEvent::Gone { name, tid } => drop(self.views[node].remove(&(name, tid))),
        }
    }

    pub(super) fn new_core(&self, node: usize) -> Core {
        let mut config = NodeConfig::new("n");
        // Room for all other nodes, and for no more.
        config.ndl.nodes_max = self.nodes - 1;
        Core::new(&config, address(node), Incarnation(self.incarnations[node]))
    }

    pub(super) fn feed(&mut self, node: usize, input: Input) {
        let peer = self.note_presence(node, &input);
        if !self.is_withheld(&input) {
            self.handle(node, input);
        }
        if let Some(peer) = peer {
            self.judge_presence((node, peer));
        }
        self.execute_all(node);
    }

    /// Delivers a false input.
    pub(super) fn feed_false(&mut self, node: usize, input: Input) {
        self.handle(node, input);
        self.execute_all(node);
    }

    fn execute_all(&mut self, node: usize) {
        let mut lists = 0;
        while let Some(output) = self.cores[node].poll() {
            lists += usize::from(matches!(output, Output::Publish { .. }));
            let is_lost = matches!(output, Output::Publish { .. })
                && lists > 2
                && self.fault == Some(Fault::TwoListsATurn);
            if !is_lost {
                self.execute(node, output);
            }
        }
    }

    /// Returns whether a fault withholds the input from the node.
    fn is_withheld(&mut self, input: &Input) -> bool {
        if matches!(input, Input::LinkChanged(LinkFact::LinkBroken { .. })) {
            self.strikes(Fault::BreakNotReported)
        } else if matches!(input, Input::MembershipChanged(MembershipFact::NodeLost { .. })) {
            self.strikes(Fault::LossNotReported)
        } else {
            false
        }
    }

    /// Handles an input. In one case of eight the sync manager fails while it executes an output, and its
    /// successor is handed the same event. An output that is sent only once is not executed before the
    /// failure.
    fn handle(&mut self, node: usize, input: Input) {
        self.events += 1;
        let position = (self.events, 1);
        let again = (self.chance.usize(..8) == 0).then(|| input.clone());
        self.cores[node].handle_once(self.now, position, input);
        let Some(again) = again else { return };
        self.seen.add("events handed over again", 1);
        // An output that is sent only once is lost with the actor, and is produced again.
        if let Some(output) = self.cores[node].poll().filter(|output| !output.is_sent_once()) {
            self.execute(node, output);
        }
        self.cores[node].replaced(self.now);
        self.cores[node].handle(self.now, Input::RoomMade);
        if self.fault == Some(Fault::HandledAgain) {
            self.cores[node].handle(self.now, again);
        } else {
            self.cores[node].handle_once(self.now, position, again);
        }
    }

    /// Returns whether a fault occurs now: one time in three.
    fn strikes(&mut self, fault: Fault) -> bool {
        self.struck += u64::from(self.fault == Some(fault));
        self.fault == Some(fault) && self.struck.is_multiple_of(3)
    }

    /// Returns whether an output that is sent only once finds no room: one time in five, and never at the
    /// end.
    fn is_refused(&mut self) -> bool {
        let is_refused = !self.takes_all && self.chance.usize(..5) == 0;
        self.seen.add("rejected", u64::from(is_refused));
        is_refused
    }

    pub(super) fn violate(&mut self, is_so: bool, words: impl FnOnce() -> String) {
        self.violations.extend(require(is_so, words).err());
    }

    fn execute(&mut self, node: usize, output: Output) {
        match output {
            Output::Release { app } if app == app_address(WATCHER) => {}
            Output::Release { .. } if self.strikes(Fault::ReleaseLost) => {}
            Output::Release { app } if self.is_refused() => {
                self.cores[node].handle(self.now, Input::ReleaseRejected { app });
            }
            Output::Release { app } => self.released(node, app),
            Output::NotifyDirectory { event, .. } => self.directory_event(node, event),
            Output::Publish { to, list } => self.fly(node, to, list),
            Output::Notify { event: RequirementEvent::Met { .. }, .. }
                if self.strikes(Fault::MetNotReported) => {}
            Output::Notify {
                event: RequirementEvent::Lost { .. } | RequirementEvent::Without { .. },
                ..
            } if self.strikes(Fault::LackNotReported) => {}
            Output::Notify { app, event, .. } if self.is_refused() => {
                let name = event.name().to_owned();
                self.cores[node].handle(self.now, Input::EventRejected { app, name });
            }
            Output::Notify { app, event, .. } => {
                self.seen.add("lacks reported", u64::from(!matches!(event, RequirementEvent::Met { .. })));
                self.note(|| format!("{app} of node {node} receives {event:?}"));
                let life = self.life(node, app).1;
                let released = life.released;
                life.record(event.clone());
                // A requirement that is met again is no news to an application that does not run yet.
                let is_early = released == 0 && !matches!(event, RequirementEvent::Met { .. });
                self.violate(!is_early, || format!("notified before it was released: {event:?}"));
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
        self.note(|| format!("{step:?}"));
        match step {
            // A stopped process executes nothing.
            Step::Register { node, .. }
            | Step::Start { node, .. }
            | Step::Reach { node, .. }
            | Step::Fail { node, .. }
            | Step::Unregister { node, .. }
            | Step::Leave { node }
            | Step::ReportBreaks { node }
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
            Step::ReportBreaks { node } => self.report_breaks(node),
            Step::Drop { ends } => {
                let lost = self.flying.get_mut(&ends).and_then(|pipe| pipe.receive(self.now));
                self.seen.add("lists lost", u64::from(lost.is_some()));
            }
            Step::Deliver { ends: (one, other), count } => {
                for ends in [(one, other), (other, one)] {
                    for _ in 0..count {
                        self.deliver(ends);
                    }
                }
            }
            Step::Receive { node, count } => {
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
                // The applications take what they have, and have room then.
                self.feed(node, Input::RoomMade);
                self.feed(node, Input::TimePassed);
            }
        }
    }

    /// Heals everything and lets every possible event happen; twice, with time for lost lists to be repeated.
    fn settle(&mut self) {
        self.note(|| "all is well from now on".to_owned());
        self.paused.clear();
        (0..self.nodes).for_each(|node| self.join(node));
        self.takes_all = true;
        self.come_to_rest();
        self.pass(REPEAT);
        self.come_to_rest();
    }

    /// Runs until nothing has happened for as long as any event may take. Each round starts an application,
    /// or completes a started action.
    fn come_to_rest(&mut self) {
        let mut idle = Duration::ZERO;
        let longest = Duration::from_millis(WAIT_LIMIT_MAX).max(UNREACHABLE_MAX);
        let rounds_each = longest.as_millis().div_ceil(RETRY.as_millis()) + 2;
        for _ in 0..(self.nodes * SLOTS + 20) as u128 * rounds_each {
            self.pass(RETRY);
            let is_delivered = self.deliver_all();
            let slots = (0..self.nodes).flat_map(|node| (0..SLOTS).map(move |slot| (node, slot)));
            let slots: Vec<_> = slots.collect();
            let started = slots.iter().filter(|(node, slot)| self.start(*node, *slot)).count();
            let reached = slots.iter().filter(|(node, slot)| self.reach(*node, *slot)).count();
            idle = if is_delivered || started + reached > 0 { Duration::ZERO } else { idle + RETRY };
            if idle > longest {
                return;
            }
        }
        self.violations.push("it does not come to rest".to_owned());
    }
}
