//! What a seed says: how many nodes there are, and what happens to them and to their applications.

use super::*;

/// Nodes in one seed of so many are more than [`FEW`].
const CROWDS: u64 = 30;
/// Nodes in most seeds, at most.
const FEW: usize = 8;
/// Nodes in any seed, at most.
const MANY: usize = 30;
/// The least that can disagree about a third one.
const LEAST: usize = 3;

/// Two nodes.
pub(super) type Ends = (usize, usize);

/// Who takes a node for lost.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Loss {
    /// Nobody: the link breaks, and that is all.
    Nobody,
    /// The first end the second one, and not the other way.
    OneWay,
    Both,
}

/// What a host's clock says when its node starts again.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Clock {
    /// Later than before.
    GoesOn,
    /// Earlier than ever: the next life seems to be a former one.
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
    /// It reaches the one phase that there is.
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
    /// The first end hears that the second one is there, before a link carries anything.
    Find {
        ends: Ends,
    },
    /// Every link between two sides is cut; the side of a node is a bit of this.
    Part {
        side: u64,
        loss: Loss,
    },
    /// All links of a node are there again.
    Join {
        node: usize,
    },
    Restart {
        node: usize,
        clock: Clock,
    },
    /// It says goodbye, and starts again.
    Leave {
        node: usize,
    },
    Pause {
        node: usize,
    },
    Resume {
        node: usize,
    },
    /// A node hears which of its links are broken.
    HearOfBreaks {
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
    /// A node takes so many lists of each other one.
    Hear {
        node: usize,
        count: usize,
    },
    Pass {
        millis: u64,
    },
}

/// How far an application has come in its present life.
#[derive(Clone, Copy, Debug, Default, PartialEq, PartialOrd, Eq, Ord)]
pub(super) enum Come {
    #[default]
    Nowhere,
    Running,
    /// It runs, and has reached the phase.
    Through,
}

/// A requirement of any form.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Wanted {
    /// At least so many of these applications.
    AtLeast { count: usize, of: BTreeSet<usize> },
    /// At least so many of this node's.
    OfNode { count: usize, node: usize },
    /// So many of the name that several nodes give.
    Shared { count: usize },
    /// An application that has reached the phase.
    Reached { of: usize },
    /// One that can be done without after so many milliseconds.
    Optional { of: usize, millis: u64 },
}

impl Wanted {
    /// What an application may require so that there is no circle: those with a smaller number than its own, and those of the shared name,
    /// which require nothing.
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

    /// How long it is waited for, if it can be done without.
    pub(super) const fn patience(&self) -> Option<Duration> {
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

    /// The judge's own reading of it, where there are so many nodes. How far an application has come is asked; one that is not there has come
    /// nowhere.
    pub(super) fn is_met_by(&self, nodes: usize, come: impl Fn(usize) -> Come) -> bool {
        let is_there = |index: usize| come(index) >= Come::Running;
        match self {
            Self::AtLeast { count, of } => of.iter().filter(|index| is_there(**index)).count() >= *count,
            Self::OfNode { count, node } => {
                (0..APPS).filter(|app| is_there(node * SLOTS + app)).count() >= *count
            }
            Self::Shared { count } => {
                (0..nodes).filter(|node| is_there(node * SLOTS + SHARED)).count() >= *count
            }
            Self::Reached { of } => come(*of) == Come::Through,
            Self::Optional { of, .. } => is_there(*of),
        }
    }
}

/// All that a seed says.
#[derive(Clone, Debug)]
pub(super) struct Plan {
    pub(super) seed: u64,
    pub(super) nodes: usize,
    pub(super) steps: Vec<Step>,
}

impl Plan {
    /// With so many nodes as are asked for, or as it says itself.
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

/// Chance among so many nodes.
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
            13 => Step::Cut { ends, loss: Loss::Nobody },
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
            23 => Step::HearOfBreaks { node },
            24 => Step::Drop { ends },
            25..29 => Step::Deliver { ends, count: self.chance.usize(1..4) },
            29..32 => Step::Hear { node, count: self.chance.usize(1..4) },
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
        [Loss::Nobody, Loss::OneWay, Loss::Both][self.chance.usize(..3)]
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
            7 => Wanted::Optional { of: self.one(), millis: self.chance.u64(1..=PATIENCE_MAX) },
            _ => Wanted::Shared { count: self.chance.usize(1..3) },
        }
    }

    /// One to so many applications with names of their own.
    fn some(&mut self, most: usize) -> BTreeSet<usize> {
        (0..most).map(|_| self.one()).collect()
    }

    fn one(&mut self) -> usize {
        self.node() * SLOTS + self.chance.usize(..APPS)
    }
}
