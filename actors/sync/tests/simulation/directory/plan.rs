//! The plan of a seed: the number of nodes, and the events of nodes and applications.

use super::*;

/// In one seed of this many there are more nodes than [`FEW`].
const CROWDS: u64 = 30;
/// The maximum number of nodes in most seeds.
const FEW: usize = 8;
/// The maximum number of nodes in any seed.
const MANY: usize = 30;
/// The smallest number of nodes that can disagree about a third one.
const LEAST: usize = 3;

/// Two nodes.
pub(super) type Ends = (usize, usize);

/// The nodes that consider another one lost.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Loss {
    /// None: only the link breaks.
    None,
    /// The first end considers the second one lost, and not the reverse.
    OneWay,
    Both,
}

/// The clock of a host when its node starts again.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Clock {
    /// Later than before.
    GoesOn,
    /// Earlier than ever: the next incarnation seems to be a former one.
    BeginsAnew,
}

#[derive(Clone, Debug)]
pub(super) enum Step {
    Register {
        node: usize,
        slot: usize,
        requires: Vec<Wanted>,
    },
    Start {
        node: usize,
        slot: usize,
    },
    /// The application reaches the only phase.
    Reach {
        node: usize,
        slot: usize,
    },
    Fail {
        node: usize,
        slot: usize,
    },
    Unregister {
        node: usize,
        slot: usize,
    },
    Cut {
        ends: Ends,
        loss: Loss,
    },
    Restore {
        ends: Ends,
    },
    /// The first end is notified that the second one is present, before a link carries anything.
    Find {
        ends: Ends,
    },
    /// Every link between two sides is cut; the side of a node is a bit of this.
    Part {
        side: u64,
        loss: Loss,
    },
    /// All links of a node are restored.
    Join {
        node: usize,
    },
    Restart {
        node: usize,
        clock: Clock,
    },
    /// The node sends GOODBYE, and starts again.
    Leave {
        node: usize,
    },
    Pause {
        node: usize,
    },
    Resume {
        node: usize,
    },
    /// A node is notified of its broken links.
    ReportBreaks {
        node: usize,
    },
    /// The queue from the first to the second was full: a list is lost.
    Drop {
        ends: Ends,
    },
    Deliver {
        ends: Ends,
        count: usize,
    },
    /// A node receives this many lists of each other one.
    Receive {
        node: usize,
        count: usize,
    },
    Pass {
        millis: u64,
    },
}

/// The state of an application in its present life.
#[derive(Clone, Copy, Debug, Default, PartialEq, PartialOrd, Eq, Ord)]
pub(super) enum AppState {
    #[default]
    NotRunning,
    Running,
    /// It runs, and has reached the phase.
    PhaseReached,
}

/// A requirement of any form.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Wanted {
    /// At least this many of these applications.
    AtLeast { count: usize, of: BTreeSet<usize> },
    /// At least this many of this node's applications.
    OfNode { count: usize, node: usize },
    /// This many with the name that several nodes use.
    Shared { count: usize },
    /// An application that has reached the phase.
    Reached { of: usize },
    /// An optional one, with its wait limit in milliseconds.
    Optional { of: usize, millis: u64 },
}

impl Wanted {
    /// Returns the part of it that an application may require without a cycle: applications with smaller
    /// numbers, and those of the shared name, which require none.
    pub(super) fn below(self, index: usize) -> Option<Self> {
        if index % SLOTS == SHARED {
            return None;
        }
        match self {
            Self::AtLeast { count, of } => {
                let of: BTreeSet<usize> = of.into_iter().filter(|wanted| *wanted < index).collect();
                (of.len() >= count).then_some(Self::AtLeast { count, of })
            }
            Self::OfNode { count, node } => {
                ((node + 1) * SLOTS <= index).then_some(Self::OfNode { count, node })
            }
            Self::Shared { count } => Some(Self::Shared { count }),
            Self::Reached { of } | Self::Optional { of, .. } => (of < index).then_some(self),
        }
    }

    /// Returns the wait limit, if the requirement is optional.
    pub(super) const fn wait_limit(&self) -> Option<Duration> {
        match self {
            Self::Optional { millis, .. } => Some(Duration::from_millis(*millis)),
            Self::AtLeast { .. } | Self::OfNode { .. } | Self::Shared { .. } | Self::Reached { .. } => None,
        }
    }

    pub(super) fn requirement(&self) -> Requirement {
        match self {
            Self::AtLeast { count, of } => Requirement::at_least(*count, of.iter().map(|index| name(*index))),
            Self::OfNode { count, node } => Requirement::at_least(*count, [format!("{node}.*")]),
            Self::Shared { count } => Requirement::at_least(*count, [name(SHARED)]),
            Self::Reached { of } => Requirement::name(name(*of)).at(PHASE),
            Self::Optional { of, millis } => {
                Requirement::name(name(*of)).or_after(Duration::from_millis(*millis))
            }
        }
    }

    /// Returns whether it is met among this many nodes, by the judge's own reading. `state` returns the state
    /// of an application; an absent one is [`AppState::NotRunning`].
    pub(super) fn is_met_by(&self, nodes: usize, state: impl Fn(usize) -> AppState) -> bool {
        let is_there = |index: usize| state(index) >= AppState::Running;
        match self {
            Self::AtLeast { count, of } => of.iter().filter(|index| is_there(**index)).count() >= *count,
            Self::OfNode { count, node } => {
                (0..APPS).filter(|app| is_there(node * SLOTS + app)).count() >= *count
            }
            Self::Shared { count } => {
                (0..nodes).filter(|node| is_there(node * SLOTS + SHARED)).count() >= *count
            }
            Self::Reached { of } => state(*of) == AppState::PhaseReached,
            Self::Optional { of, .. } => is_there(*of),
        }
    }
}

/// The whole plan of a seed.
#[derive(Clone, Debug)]
pub(super) struct Plan {
    pub(super) seed: u64,
    pub(super) nodes: usize,
    pub(super) steps: Vec<Step>,
}

impl Plan {
    /// Draws a plan, with the set number of nodes or one from the seed.
    pub(super) fn of(seed: u64, nodes: Option<usize>) -> Self {
        let mut chance = fastrand::Rng::with_seed(seed);
        let most = if chance.u64(..CROWDS) == 0 { FEW + 1..=MANY } else { LEAST..=FEW };
        let own = chance.usize(most);
        let mut draw = Draw { nodes: nodes.unwrap_or(own), chance };
        let nodes = draw.nodes;
        // All start at the same moment, or meet one by one.
        let joined = if draw.chance.bool() { nodes } else { 0 };
        let mut steps: Vec<Step> = (0..joined).map(|node| Step::Join { node }).collect();
        let more = draw.chance.usize(..20 + 20 * nodes);
        steps.extend((0..more).map(|_| draw.step()));
        Self { seed, nodes, steps }
    }
}

/// Random numbers among this many nodes.
struct Draw {
    nodes: usize,
    chance: fastrand::Rng,
}

impl Draw {
    fn step(&mut self) -> Step {
        let (node, slot, ends) = (self.node(), self.chance.usize(..SLOTS), self.ends());
        match self.chance.usize(..38) {
            0..4 => Step::Register { node, slot, requires: self.requires() },
            4..10 => Step::Start { node, slot },
            10..12 => Step::Fail { node, slot },
            12 => Step::Unregister { node, slot },
            13 => Step::Cut { ends, loss: Loss::None },
            14 => Step::Cut { ends, loss: self.loss() },
            15..17 => Step::Restore { ends },
            17 => Step::Part { side: self.chance.u64(..), loss: self.loss() },
            18..20 => Step::Join { node },
            20 if self.chance.bool() => Step::Leave { node },
            20 => {
                let clock = if self.chance.usize(..4) == 0 { Clock::BeginsAnew } else { Clock::GoesOn };
                Step::Restart { node, clock }
            }
            21 => Step::Pause { node },
            22 => Step::Resume { node },
            23 => Step::ReportBreaks { node },
            24 => Step::Drop { ends },
            25..29 => Step::Deliver { ends, count: self.chance.usize(1..4) },
            29..32 => Step::Receive { node, count: self.chance.usize(1..4) },
            32..34 => Step::Find { ends },
            34..36 => Step::Reach { node, slot },
            _ => Step::Pass { millis: self.chance.u64(1..3_000) },
        }
    }

    fn node(&mut self) -> usize {
        self.chance.usize(..self.nodes)
    }

    fn ends(&mut self) -> Ends {
        let one = self.node();
        (one, (one + self.chance.usize(1..self.nodes)) % self.nodes)
    }

    fn loss(&mut self) -> Loss {
        [Loss::None, Loss::OneWay, Loss::Both][self.chance.usize(..3)]
    }

    fn requires(&mut self) -> Vec<Wanted> {
        let count = self.chance.usize(..4);
        (0..count).map(|_| self.wanted()).collect()
    }

    fn wanted(&mut self) -> Wanted {
        match self.chance.usize(..9) {
            0..3 => Wanted::AtLeast { count: 1, of: self.some(1) },
            3 => Wanted::AtLeast { count: 1, of: self.some(3) },
            4 => Wanted::AtLeast { count: 2, of: self.some(3) },
            5 => Wanted::OfNode { count: self.chance.usize(1..3), node: self.node() },
            6 => Wanted::Reached { of: self.one() },
            7 => Wanted::Optional { of: self.one(), millis: self.chance.u64(1..=WAIT_LIMIT_MAX) },
            _ => Wanted::Shared { count: self.chance.usize(1..3) },
        }
    }

    /// Returns one to `most` applications with names of their own.
    fn some(&mut self, most: usize) -> BTreeSet<usize> {
        (0..most).map(|_| self.one()).collect()
    }

    fn one(&mut self) -> usize {
        self.node() * SLOTS + self.chance.usize(..APPS)
    }
}
