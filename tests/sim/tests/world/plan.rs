//! The scenarios, and the plan of a seed.

use std::time::Duration;

use sinew_sim::{Chance, Clock, Quality};

use crate::world::BEGIN;

pub(crate) const NODES: usize = 5;
/// Time between two queries of NDL.
pub(crate) const PERIOD: Duration = Duration::from_millis(50);
/// Missed answers after which a node is lost.
pub(crate) const MISSED_MAX: u32 = 3;
/// Time at which all faults end.
const HEALS: Duration = Duration::from_millis(1_800);
/// Time for repairs: longer than the longest wait for a redial (1.2 s), than three PINGs and the time for
/// them (5 s), and than the period of lists (2 s).
const SETTLES: Duration = Duration::from_secs(6);

/// The scenario of a seed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Scenario {
    /// Nodes start in any order, under loss and partitions.
    Starts,
    /// Nodes die, leave, and return in a new incarnation; layers are restarted.
    Losses,
    /// The network is split in two, and heals.
    Partitions,
}

impl Scenario {
    pub(crate) fn of(seed: u64) -> Self {
        [Self::Starts, Self::Losses, Self::Partitions][(seed % 3) as usize]
    }
}

/// A layer that can be restarted.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Layer {
    Ndl,
    Gncl,
    Sync,
}

impl Layer {
    pub(crate) const ALL: [Self; 3] = [Self::Ndl, Self::Gncl, Self::Sync];
}

/// A planned event; nodes are counted from 0.
#[derive(Clone, Debug)]
pub(crate) enum Step {
    Start {
        node: usize,
    },
    /// The process ends. Its host refuses connections, or is silent until the node starts again.
    Kill {
        node: usize,
        host_dies: bool,
    },
    /// The node stops in order.
    Leave {
        node: usize,
    },
    /// One direction between two nodes is cut.
    Cut {
        from: usize,
        to: usize,
    },
    /// Both directions between these nodes and all others are cut.
    Part {
        these: Vec<usize>,
    },
    /// Datagrams from one to the other are lost; connections are not affected.
    Muffle {
        from: usize,
        to: usize,
    },
    /// Segments of the node's connections are slow, until it starts again.
    Slow {
        node: usize,
    },
    /// All connections between two nodes are cut, with some of the data in flight.
    Reset {
        one: usize,
        other: usize,
    },
    /// A firewall drops the connections of one node to the other, from now on.
    Firewall {
        from: usize,
        to: usize,
    },
    /// The host of a node gets another address, where its GNCL listens from now on. A port stands for the
    /// address.
    Move {
        node: usize,
    },
    RestartLayer {
        node: usize,
        layer: Layer,
    },
    /// An application fails, and is restarted.
    Fail {
        node: usize,
        app: usize,
    },
    /// All faults end.
    Heal,
    /// Each member that does not wait arrives at the barrier again.
    Meet,
}

/// The whole plan of a seed.
#[derive(Clone, Debug)]
pub(crate) struct Plan {
    pub(crate) seed: u64,
    pub(crate) scenario: Scenario,
    pub(crate) quality: Quality,
    pub(crate) clocks: Vec<Clock>,
    /// Longest time until a layer reads an event.
    pub(crate) read_max: Duration,
    /// Whether members stop waiting when a party is lost.
    pub(crate) fails_on_loss: bool,
    /// The base applications that each member requires, by node.
    pub(crate) requires: Vec<Vec<usize>>,
    pub(crate) steps: Vec<(Duration, Step)>,
    pub(crate) end: Duration,
}

impl Plan {
    pub(crate) fn of(seed: u64) -> Self {
        let mut chance = Chance::new(seed);
        let mut plan = Self {
            seed,
            scenario: Scenario::of(seed),
            quality: quality(&mut chance),
            clocks: (0..NODES).map(|_| clock(&mut chance)).collect(),
            read_max: Duration::from_millis(chance.of(&[1, 2, 20])),
            fails_on_loss: chance.happens(500),
            requires: (0..NODES).map(|_| requires(&mut chance)).collect(),
            steps: Vec::new(),
            end: HEALS + SETTLES,
        };
        plan.starts(&mut chance);
        match plan.scenario {
            Scenario::Starts => plan.disturb_starts(&mut chance),
            Scenario::Losses => plan.lose(&mut chance),
            Scenario::Partitions => plan.part(&mut chance),
        }
        plan.steps.push((HEALS, Step::Heal));
        plan.steps.push((HEALS + SETTLES * 2 / 3, Step::Meet));
        plan.steps.sort_by_key(|(at, _)| *at);
        plan
    }

    fn at(&mut self, millis: u64, step: Step) {
        self.steps.push((Duration::from_millis(millis), step));
    }

    fn starts(&mut self, chance: &mut Chance) {
        let mut order: Vec<usize> = (0..NODES).collect();
        chance.shuffle(&mut order);
        let spread = chance.of(&[1, 60, 250]);
        for (place, node) in order.into_iter().enumerate() {
            let at = place as u64 * spread + chance.below(20);
            self.at(at, Step::Start { node });
        }
    }

    fn disturb_starts(&mut self, chance: &mut Chance) {
        if chance.happens(600) {
            let these = some_nodes(chance);
            self.at(0, Step::Part { these });
        }
        for _ in 0..chance.below(4) {
            let (from, to) = two_nodes(chance);
            let at = chance.below(1_200);
            self.at(at, Step::Cut { from, to });
        }
        self.reset_some(chance, 3);
    }

    fn lose(&mut self, chance: &mut Chance) {
        let node = chance.index(NODES);
        let at = 900 + chance.below(300);
        let step = match chance.below(3) {
            0 => Step::Leave { node },
            kind => Step::Kill { node, host_dies: kind == 1 },
        };
        self.at(at, step);
        // Its last frames are in flight when it ends.
        self.at(at - 40, Step::Slow { node });
        self.at(at - 30, Step::Fail { node, app: 0 });
        self.at(at - 2 - chance.below(15), Step::Fail { node, app: 1 });
        if chance.happens(800) {
            // Also so soon that only its new incarnation tells others of the loss.
            let after = chance.of(&[5, 60, 300, 550]);
            self.at(at + after + chance.below(50), Step::Start { node });
        }
        if chance.happens(400) {
            let mover = chance.index(NODES);
            let moved = 700 + chance.below(400);
            for to in (0..NODES).filter(|to| *to != mover) {
                self.at(moved, Step::Firewall { from: mover, to });
            }
            self.at(moved, Step::Move { node: mover });
            for other in (0..NODES).filter(|other| *other != mover) {
                self.at(moved + 250, Step::Reset { one: mover, other });
            }
        }
        for _ in 0..chance.below(3) {
            let (node, layer) = (chance.index(NODES), chance.of(&Layer::ALL));
            let at = 400 + chance.below(1_300);
            self.at(at, Step::RestartLayer { node, layer });
        }
        if chance.happens(300) {
            // All of them at once: no node is dialled by one that knows it.
            let at = 400 + chance.below(1_000);
            for node in 0..NODES {
                self.at(at + chance.below(3), Step::RestartLayer { node, layer: Layer::Gncl });
            }
        }
        for _ in 0..chance.below(3) {
            let (node, app) = (chance.index(NODES), chance.index(3));
            let at = 500 + chance.below(1_200);
            self.at(at, Step::Fail { node, app });
        }
        if chance.happens(300) {
            let (from, to) = two_nodes(chance);
            let at = 850 + chance.below(500);
            self.at(at, Step::Muffle { from, to });
        }
        self.reset_some(chance, 2);
    }

    fn part(&mut self, chance: &mut Chance) {
        let these = some_nodes(chance);
        let at = 600 + chance.below(900);
        if chance.happens(700) {
            self.at(at, Step::Part { these });
        } else {
            // In one direction only.
            for from in &these {
                for to in (0..NODES).filter(|to| !these.contains(to)) {
                    self.at(at, Step::Cut { from: *from, to });
                }
            }
        }
        if chance.happens(300) {
            let (from, to) = two_nodes(chance);
            self.at(850 + chance.below(500), Step::Muffle { from, to });
        }
        self.reset_some(chance, 5);
    }

    fn reset_some(&mut self, chance: &mut Chance, most: u64) {
        for _ in 0..chance.below(most + 1) {
            let (one, other) = two_nodes(chance);
            let at = 300 + chance.below(1_400);
            self.at(at, Step::Reset { one, other });
        }
    }
}

fn two_nodes(chance: &mut Chance) -> (usize, usize) {
    let one = chance.index(NODES);
    (one, (one + 1 + chance.index(NODES - 1)) % NODES)
}

/// Returns one or two nodes.
fn some_nodes(chance: &mut Chance) -> Vec<usize> {
    let (one, other) = two_nodes(chance);
    if chance.happens(500) { vec![one] } else { vec![one, other] }
}

fn requires(chance: &mut Chance) -> Vec<usize> {
    let mut nodes: Vec<usize> = (0..NODES).collect();
    chance.shuffle(&mut nodes);
    nodes.truncate(1 + chance.index(3));
    nodes
}

fn quality(chance: &mut Chance) -> Quality {
    Quality {
        lost_per_mille: chance.of(&[0, 10, 60]),
        doubled_per_mille: chance.of(&[0, 50]),
        delay_max: Duration::from_millis(chance.of(&[1, 3, 8])),
        late_per_mille: chance.of(&[0, 20]),
        late_max: Duration::from_millis(40),
        ..Quality::GOOD
    }
}

fn clock(chance: &mut Chance) -> Clock {
    let second: u64 = 1_000_000_000;
    let ahead_ns = chance.below(200 * second).cast_signed() - 100 * second.cast_signed();
    let fast_ppm = chance.below(200).cast_signed() - 100;
    Clock::new(BEGIN, ahead_ns, fast_ppm)
}
