//! A simulated robot: nodes with one application each, a coordinator, delays, kills and cuts, all from one seed.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::Arc,
    time::Duration,
};

use super::{super::OwnPart, NEW, OLD, Steps, ms, steps, values};
use crate::{
    Coordinator, ParameterOutcome, ParameterVote, Participant, SetParameters, Step, TransactionVerdict, Tuner,
};

const LEAD: Duration = ms(100);
const WITHIN: Duration = ms(3_000);
/// Longest delay of a message. A result that goes through all nodes takes less than half of the lead.
const DELAY_MAX_US: u64 = 3_000;
/// Largest error of a node's measurement of the coordinator's clock, just below the legal one.
const CLOCK_ERROR: Duration = ms(12);
/// When the transaction begins.
const BEGIN: Duration = ms(100);
/// The coordinator, as a sender and receiver.
const COORDINATOR: usize = 99;

/// The faults of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Plan {
    Calm,
    /// Some nodes, perhaps all, are killed between the begin and the stated time, and restarted. One run in three kills
    /// the coordinator.
    Kills,
    /// A node is cut off. One run in three kills the coordinator.
    Cut,
}

impl Plan {
    /// Returns when the run ends: all repairs have ended, and the cut has for a second.
    const fn end(self) -> Duration {
        match self {
            Self::Calm => ms(1_000),
            Self::Kills => ms(4_000),
            Self::Cut => ms(6_500),
        }
    }
}

/// The generator SplitMix64.
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mixed = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        mixed ^ (mixed >> 31)
    }

    fn below(&mut self, end: u64) -> u64 {
        self.next() % end
    }

    fn between(&mut self, least: Duration, most: Duration) -> Duration {
        least + Duration::from_nanos(self.below((most - least).as_nanos() as u64 + 1))
    }
}

enum Content {
    Vote(ParameterVote),
    /// A request, with the time at which it was sent on the common clock.
    Ask(u32, SetParameters, Duration),
    Reply(u32, Result<ParameterOutcome, String>),
}

enum Event {
    Deliver { from: usize, to: usize, content: Content },
    Tick { node: usize, incarnation: u32 },
    Timer(usize),
    Kill(usize),
    Restart(usize),
    Cut(usize),
    Join(usize),
    Coordinate,
    AskedTooLong(u32),
}

struct Node {
    tuner: Option<Tuner<u32>>,
    steps: Arc<Steps>,
    incarnation: u32,
    /// Its clock minus the common one.
    ahead: Duration,
    /// Its measured clock of the coordinator is late by this, minus [`CLOCK_ERROR`].
    late: Duration,
    period: Duration,
    ticks: u64,
    /// When its timer fires, on the common clock.
    timer: Option<Duration>,
    is_cut: bool,
    /// The values that its loop has read, with the time on the common clock.
    read: Vec<(Duration, i64)>,
}

pub(super) struct World {
    seed: u64,
    random: Random,
    now: Duration,
    events: BTreeMap<(Duration, u64), Event>,
    count: u64,
    nodes: Vec<Node>,
    coordinator: Option<Coordinator>,
    asked: u32,
    /// The last arrival from one to another: messages do not overtake each other.
    arrivals: BTreeMap<(usize, usize), Duration>,
    killed: BTreeSet<usize>,
    is_coordinator_killed: bool,
    verdict: Option<TransactionVerdict>,
}

impl World {
    pub(super) fn run(seed: u64, plan: Plan) -> Self {
        let mut world = Self::new(seed);
        world.plan_faults(plan);
        while let Some(((at, _), event)) = world.events.pop_first() {
            if at > plan.end() {
                break;
            }
            world.now = at;
            world.handle(event);
        }
        world
    }

    fn new(seed: u64) -> Self {
        let mut random = Random(seed);
        let count = 2 + random.below(4) as usize;
        let mut nodes = Vec::new();
        for _ in 0..count {
            let ahead = random.between(ms(0), Duration::from_secs(9));
            let late = random.between(ms(0), CLOCK_ERROR * 2);
            let period = random.between(ms(5), ms(20));
            let (tuner, steps, incarnation, ticks) = (None, steps(), 0, 0);
            let (timer, is_cut, read) = (None, false, Vec::new());
            nodes.push(Node { tuner, steps, incarnation, ahead, late, period, ticks, timer, is_cut, read });
        }
        let mut world = Self {
            seed,
            random,
            now: ms(0),
            events: BTreeMap::new(),
            count: 0,
            nodes,
            coordinator: None,
            asked: 0,
            arrivals: BTreeMap::new(),
            killed: BTreeSet::new(),
            is_coordinator_killed: false,
            verdict: None,
        };
        for node in 0..count {
            world.start(node);
        }
        let named = |tid: usize| Participant { tid: tid as u64, app: format!("app-{tid}") };
        let sets = (0..count).map(|node| (named(node), values(NEW))).collect();
        let begun = Coordinator::begin(COORDINATOR as u64, sets, (LEAD, WITHIN), BEGIN);
        world.coordinator = Some(begun.expect("it is legal"));
        world.push(BEGIN, Event::Coordinate);
        world
    }

    fn plan_faults(&mut self, plan: Plan) {
        let count = self.nodes.len() as u64;
        if plan == Plan::Calm {
            return;
        }
        if self.random.below(3) == 0 {
            let at = self.random.between(BEGIN, BEGIN + LEAD);
            self.push(at, Event::Kill(COORDINATOR));
        }
        let victims = if plan == Plan::Kills { 1 + self.random.below(count) } else { 1 };
        for _ in 0..victims {
            let victim = self.random.below(count) as usize;
            // Most in the first milliseconds, when the acceptances are sent.
            let until = if self.random.below(4) == 0 { LEAD } else { LEAD / 4 };
            let at = self.random.between(BEGIN, BEGIN + until - ms(1));
            let (begin, end, longest) = match plan {
                Plan::Calm | Plan::Kills => (Event::Kill(victim), Event::Restart(victim), ms(500)),
                Plan::Cut => (Event::Cut(victim), Event::Join(victim), ms(5_000)),
            };
            self.push(at, begin);
            let back = at + self.random.between(ms(20), longest);
            self.push(back, end);
        }
    }

    fn push(&mut self, at: Duration, event: Event) {
        self.count += 1;
        self.events.insert((at, self.count), event);
    }

    /// Starts an incarnation, with the parameters at their defaults.
    fn start(&mut self, index: usize) {
        let now = self.now;
        let node = &mut self.nodes[index];
        node.incarnation += 1;
        node.steps = steps();
        node.timer = None;
        node.tuner = Some(Tuner::new(node.steps.clone(), now + node.ahead));
        let (incarnation, period) = (node.incarnation, node.period);
        let first = now + self.random.between(ms(0), period);
        self.push(first, Event::Tick { node: index, incarnation });
    }

    fn handle(&mut self, event: Event) {
        match event {
            Event::Deliver { from, to, content } => self.deliver(from, to, content),
            Event::Tick { node, incarnation } => self.tick(node, incarnation),
            Event::Timer(index) => self.fire(index),
            Event::Kill(COORDINATOR) => {
                self.is_coordinator_killed = true;
                self.coordinator = None;
                self.lose_messages_of(COORDINATOR);
            }
            Event::Kill(node) => {
                self.killed.insert(node);
                self.nodes[node].tuner = None;
                self.lose_messages_of(node);
            }
            Event::Restart(node) => {
                if self.nodes[node].tuner.is_none() {
                    self.start(node);
                }
            }
            Event::Cut(node) => self.nodes[node].is_cut = true,
            Event::Join(node) => self.nodes[node].is_cut = false,
            Event::Coordinate => self.coordinate(),
            Event::AskedTooLong(number) => self.reply(number, Err("no answer".to_owned())),
        }
    }

    /// Loses messages of a killed process that are on their way: to each receiver all, none, or the last ones.
    fn lose_messages_of(&mut self, killed: usize) {
        let latest = self.now + Duration::from_micros(DELAY_MAX_US);
        let mut until = BTreeMap::new();
        for receiver in (0..self.nodes.len()).chain([COORDINATOR]) {
            let last = match self.random.below(3) {
                0 => self.now,
                1 => latest,
                _ => self.random.between(self.now, latest),
            };
            until.insert(receiver, last);
        }
        self.events.retain(|(at, _), event| {
            !matches!(event, Event::Deliver { from, to, .. } if *from == killed && *at > until[to])
        });
    }

    fn is_apart(&self, one: usize, other: usize) -> bool {
        let is_cut = |index: usize| self.nodes.get(index).is_some_and(|node| node.is_cut);
        is_cut(one) != is_cut(other)
    }

    fn send(&mut self, from: usize, to: usize, content: Content) {
        let delay = Duration::from_micros(50 + self.random.below(DELAY_MAX_US - 50));
        let last = self.arrivals.entry((from, to)).or_default();
        let at = (self.now + delay).max(*last);
        *last = at;
        self.push(at, Event::Deliver { from, to, content });
    }

    fn deliver(&mut self, from: usize, to: usize, content: Content) {
        if self.is_apart(from, to) {
            return;
        }
        let own = self.nodes.get(to).map_or(ms(0), |node| self.now + node.ahead);
        match content {
            Content::Reply(number, reply) => self.reply(number, reply),
            Content::Vote(vote) => {
                if let Some(tuner) = &mut self.nodes[to].tuner {
                    tuner.on_vote(own, from as u64, vote);
                }
                self.flush(to);
            }
            Content::Ask(number, set, sent) => {
                let reply = self.answer(to, &set, (sent, own));
                self.send(to, from, Content::Reply(number, reply));
                self.flush(to);
            }
        }
    }

    /// Returns the reply of an application to a request.
    fn answer(
        &mut self,
        index: usize,
        set: &SetParameters,
        (sent, own): (Duration, Duration),
    ) -> Result<ParameterOutcome, String> {
        let Node { tuner, ahead, late, .. } = &mut self.nodes[index];
        let tuner = tuner.as_mut().ok_or_else(|| "it has ended".to_owned())?;
        let reply = match set {
            SetParameters::Prepare(transaction) => {
                let measured = (sent + *ahead + *late).saturating_sub(CLOCK_ERROR);
                tuner.prepare(
                    transaction,
                    OwnPart { tid: index as u64, has_ticks: true },
                    Some((measured, CLOCK_ERROR)),
                    own,
                )
            }
            SetParameters::Conclude(id) => Ok(tuner.outcome_of(*id, own)),
            // Answered before its tick, which comes in any case: nothing is killed after the stated time.
            SetParameters::Values(values) => {
                let applied = ParameterOutcome::Applied { tick: 1, at_ns: 1, values: values.clone() };
                tuner.stage(set, (1, own + ms(1_000)), true).map(|()| applied).map_err(|(_, why)| why)
            }
            SetParameters::Undo => panic!("nothing is undone"),
        };
        Ok(reply.unwrap_or_else(|why| ParameterOutcome::from(&why)))
    }

    fn tick(&mut self, index: usize, incarnation: u32) {
        let now = self.now;
        let node = &mut self.nodes[index];
        let Some(tuner) = node.tuner.as_mut().filter(|_| node.incarnation == incarnation) else { return };
        node.ticks += 1;
        tuner.tick((node.ticks, node.period), now + node.ahead, |_, _| {});
        node.read.push((now, node.steps.0.get()));
        let period = node.period;
        self.push(now + period, Event::Tick { node: index, incarnation });
        self.flush(index);
    }

    fn fire(&mut self, index: usize) {
        let now = self.now;
        let node = &mut self.nodes[index];
        // Only the last one that was set counts.
        if node.timer.take_if(|at| *at <= now).is_some()
            && let Some(tuner) = &mut node.tuner
        {
            tuner.expire(now + node.ahead, |_, _| {});
            self.flush(index);
        }
    }

    /// Sends the tuner's messages, and sets its timer.
    fn flush(&mut self, index: usize) {
        let now = self.now;
        let node = &mut self.nodes[index];
        let Some(tuner) = &mut node.tuner else { return };
        let votes: Vec<_> = std::iter::from_fn(|| tuner.take_vote()).collect();
        let wake = tuner.next_deadline().map(|at| at.saturating_sub(node.ahead).max(now));
        if let Some(at) = wake
            && node.timer.is_none_or(|set| at < set)
        {
            node.timer = Some(at);
            self.push(at, Event::Timer(index));
        }
        for (to, vote) in votes {
            self.send(index, to as usize, Content::Vote(vote));
        }
    }

    fn coordinate(&mut self) {
        let now = self.now;
        let Some(coordinator) = &mut self.coordinator else { return };
        match coordinator.next(now) {
            Step::Ask { index, set, within } => {
                self.asked += 1;
                let number = self.asked;
                self.push(now + within, Event::AskedTooLong(number));
                self.send(COORDINATOR, index, Content::Ask(number, set, now));
            }
            Step::Wait(until) => self.push(until, Event::Coordinate),
            Step::Done => self.verdict = self.coordinator.take().map(|ended| ended.report().verdict),
        }
    }

    /// Takes the first reply to the last request; another one is too late.
    fn reply(&mut self, number: u32, reply: Result<ParameterOutcome, String>) {
        if let Some(coordinator) = self.coordinator.as_mut().filter(|_| number == self.asked) {
            self.asked += 1;
            coordinator.answered(reply);
            self.coordinate();
        }
    }

    pub(super) const fn verdict(&self) -> Option<TransactionVerdict> {
        self.verdict
    }

    /// Checks the loops of the nodes that were never killed: none has read a new value before the stated time, and
    /// after it all have read new ones alone, or old ones alone. Within the error of the clocks they may differ.
    pub(super) fn judge_survivors(&self) {
        let mut read = BTreeSet::new();
        for (index, node) in self.nodes.iter().enumerate().filter(|(index, _)| !self.killed.contains(index)) {
            let is_early = |(at, value): &(Duration, i64)| *at < BEGIN + LEAD - CLOCK_ERROR && *value != OLD;
            assert!(!node.read.iter().any(is_early), "seed {}: node {index} is early", self.seed);
            let after = node.read.iter().filter(|(at, _)| *at >= BEGIN + LEAD + CLOCK_ERROR);
            read.extend(after.map(|(_, value)| *value));
        }
        assert!(read.len() <= 1, "seed {}: the loops of living nodes have read {read:?}", self.seed);
    }

    /// Checks that all have the same value at the end. Where the coordinator was killed, restarted ones are left out:
    /// they have their defaults.
    pub(super) fn judge_end(&self) {
        let is_judged = |index: &usize| !self.is_coordinator_killed || !self.killed.contains(index);
        let nodes = self.nodes.iter().enumerate().filter(|(index, _)| is_judged(index));
        let values: BTreeSet<i64> = nodes.map(|(_, node)| node.steps.0.get()).collect();
        assert!(values.len() <= 1, "seed {}: {values:?} at the end, {:?}", self.seed, self.verdict);
    }

    /// Checks that the coordinator's answer is true of each node at the end, if there is one.
    pub(super) fn judge_answer(&self) {
        let Some(verdict) = self.verdict else { return };
        let expected = match verdict {
            TransactionVerdict::All | TransactionVerdict::Repaired => Some(NEW),
            TransactionVerdict::None => Some(OLD),
            TransactionVerdict::Mixed => None,
        };
        let values: Vec<i64> = self.nodes.iter().map(|node| node.steps.0.get()).collect();
        let is_true = values.iter().all(|value| Some(*value) == expected);
        assert!(is_true, "seed {}: the answer is {verdict:?}, and the values are {values:?}", self.seed);
    }

    /// Returns whether the loops of two nodes have read different values after the stated time, on all clocks.
    pub(super) fn was_mixed(&self) -> bool {
        let since = BEGIN + LEAD + CLOCK_ERROR;
        let read = self.nodes.iter().flat_map(|node| node.read.iter().filter(move |(at, _)| *at >= since));
        read.map(|(_, value)| *value).collect::<BTreeSet<_>>().len() > 1
    }
}
