//! The plan of a seed: the nodes, the network, and the events with their times.

use std::time::Duration;

use sinew_model::facts::Trouble;
use sinew_ndl::core::Host;
use sinew_sim::{Chance, Clock, Quality};

use super::world::BEGIN;

/// Faults of a crowd; one partition is a million cuts among 1,000 nodes.
const FAULTS_OF_A_CROWD: usize = 20;

/// The way in which nodes find each other.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Finding {
    /// By the multicast group.
    Group,
    /// By lists of addresses, without multicast.
    Seeds,
    /// By mDNS, which reports a node once, when it starts.
    Mdns,
}

/// An event; nodes are counted from 0.
#[derive(Clone, Copy, Debug)]
pub(super) enum Step {
    Start {
        node: usize,
        elsewhere: bool,
    },
    Kill {
        node: usize,
        refuses: bool,
    },
    Leave {
        node: usize,
    },
    RestartShell {
        node: usize,
    },
    Stall {
        node: usize,
        lasts: Duration,
    },
    /// In one network, or in all.
    Cut {
        from: usize,
        to: usize,
        network: Option<usize>,
    },
    Mend {
        from: usize,
        to: usize,
        network: Option<usize>,
    },
    /// Datagrams from one to the other are lost, and nothing else.
    Muffle {
        from: usize,
        to: usize,
    },
    Unmuffle {
        from: usize,
        to: usize,
    },
    /// An application of the node stalls, or resumes.
    Trouble {
        node: usize,
        trouble: Option<Trouble>,
    },
    Heal,
}

/// The whole plan of a seed.
#[derive(Clone, Debug)]
pub(super) struct Plan {
    pub(super) seed: u64,
    pub(super) nodes: usize,
    pub(super) period: Duration,
    pub(super) missed_max: u32,
    /// A node that all others watch at another pace, with that pace.
    pub(super) watched: Option<(usize, Duration, u32)>,
    pub(super) finding: Finding,
    /// Whether GNCL's connections deliver where the network is not cut.
    pub(super) connections: bool,
    /// Networks in which each node has an address.
    pub(super) networks: usize,
    /// Each host has one further address that all others have, too, like that of a container bridge, and each node
    /// announces its GNCL there. This is the response of the own host to a connection attempt there.
    pub(super) shared: Option<Host>,
    pub(super) quality: Quality,
    /// Maximum delay of the timer of a node that is not stalled.
    pub(super) lateness: Duration,
    /// Minimum delay of each timer.
    pub(super) always_late: Duration,
    pub(super) clocks: Vec<Clock>,
    /// The events, in order of time.
    pub(super) steps: Vec<(Duration, Step)>,
    pub(super) end: Duration,
}

impl Plan {
    pub(super) fn of(seed: u64) -> Self {
        let mut chance = Chance::new(seed);
        let period = Duration::from_millis(chance.of(&[10, 50, 500]));
        let nodes = if chance.happens(30) { 12 + chance.index(13) } else { 3 + chance.index(4) };
        let finding = chance.of(&[Finding::Group, Finding::Group, Finding::Seeds, Finding::Mdns]);
        let missed_max = chance.of(&[2, 3, 3, 5]);
        let mut plan = Self {
            seed,
            nodes,
            period,
            missed_max,
            watched: None,
            finding,
            connections: false,
            networks: 1,
            // Derived from the seed alone, so nothing else of the plan changes.
            shared: [None, Some(Host::Refuses), Some(Host::Accepts)][(seed % 3) as usize],
            quality: quality(&mut chance, period),
            lateness: chance.of(&[Duration::ZERO, period / 50, period / 4]),
            // Derived from the seed alone, too.
            always_late: always_late(seed, period),
            clocks: (0..nodes).map(|_| clock(&mut chance)).collect(),
            steps: Vec::new(),
            end: Duration::ZERO,
        };
        plan.watch(&mut chance);
        let heals = period * (12 + u32::try_from(chance.below(12)).expect("below 12"));
        plan.starts(&mut chance);
        for _ in 0..chance.below(7) {
            plan.fault(&mut chance, heals);
        }
        plan.connect(&mut chance, heals);
        plan.multiply(&mut chance, heals);
        plan.troubles(&mut chance, heals);
        plan.steps.push((heals, Step::Heal));
        plan.steps.sort_by_key(|(at, _)| *at);
        // An address without an answer is queried at least every 16 periods.
        let found_again = if finding == Finding::Mdns { 18 } else { 3 };
        // A loss takes longer for a node that is watched more slowly.
        let watched = plan
            .watched
            .map_or(Duration::ZERO, |(_, period, missed_max)| plan.silence_max(period, missed_max) + period);
        let loss = watched.max(plan.silence_max(period, missed_max) + period);
        plan.end = heals + plan.quality.late_max + loss + (period + plan.always_late) * found_again;
        plan
    }

    /// Returns the longest silence of a member watched at this pace before it is lost. This is the bound. A node with a
    /// timer that is always late by more than half a period stretches each period to four of its cycles, plus its three
    /// grace periods.
    pub(super) fn silence_max(&self, period: Duration, missed_max: u32) -> Duration {
        if self.always_late <= period / 2 {
            // Grace periods: each is more than twice as long as the previous one, and none is longer than the delay of
            // a timer.
            return period * (missed_max + 1) + (self.lateness + self.always_late) * 5;
        }
        let late = self.always_late + self.lateness;
        (period + late) * 4 * (missed_max + 1) + (period / 2 + late) * 3
    }

    /// Returns a plan for many nodes that find each other through the group, with so many faults that several happen at
    /// a time.
    pub(super) fn crowd(seed: u64, nodes: usize) -> Self {
        let mut chance = Chance::new(seed);
        let period = Duration::from_millis(500);
        let mut quality = quality(&mut chance, period);
        // With more loss than this, every node rightly loses many others all the time.
        quality.lost_per_mille = quality.lost_per_mille.min(100);
        quality.late_max = period;
        let mut plan = Self {
            seed,
            nodes,
            period,
            missed_max: 3,
            watched: None,
            finding: Finding::Group,
            connections: chance.happens(700),
            networks: 1,
            shared: None,
            quality,
            lateness: chance.of(&[Duration::ZERO, period / 50]),
            always_late: Duration::ZERO,
            clocks: (0..nodes).map(|_| clock(&mut chance)).collect(),
            steps: Vec::new(),
            end: Duration::ZERO,
        };
        let heals = period * 8;
        plan.starts(&mut chance);
        for _ in 0..FAULTS_OF_A_CROWD {
            plan.fault(&mut chance, heals);
        }
        plan.troubles(&mut chance, heals);
        plan.steps.push((heals, Step::Heal));
        plan.steps.sort_by_key(|(at, _)| *at);
        plan.end = heals + plan.quality.late_max + period * (plan.missed_max + 2 + 3);
        plan
    }

    /// Gives one node a pace of its own, in some plans: up to five times that of the others, or a third of it.
    fn watch(&mut self, chance: &mut Chance) {
        if !chance.happens(400) {
            return;
        }
        let pace = chance.of(&[self.period / 5, self.period / 2, self.period * 3]);
        self.watched = Some((chance.index(self.nodes), pace, chance.of(&[2, 3, 5])));
        self.lateness = self.lateness.min(pace / 4);
    }

    /// Lets connections deliver, in most plans. In some of these, datagrams between some nodes are lost, one way or
    /// both.
    fn connect(&mut self, chance: &mut Chance, heals: Duration) {
        self.connections = chance.happens(700);
        if !self.connections {
            return;
        }
        for _ in 0..chance.below(3) {
            let (from, to) = (chance.index(self.nodes), chance.index(self.nodes));
            let begins = chance.between(self.period, heals);
            let ends = (begins + chance.between(self.period * 3, self.period * 12)).min(heals);
            let ways = if chance.happens(500) { &[(from, to)][..] } else { &[(from, to), (to, from)] };
            for (from, to) in ways.iter().copied() {
                self.steps.push((begins, Step::Muffle { from, to }));
                self.steps.push((ends, Step::Unmuffle { from, to }));
            }
        }
    }

    /// Adds networks, in some plans: each node has an address in each. Networks fail one by one, between two nodes or
    /// around one, one way or both, for good or repeatedly.
    fn multiply(&mut self, chance: &mut Chance, heals: Duration) {
        if !chance.happens(300) {
            return;
        }
        self.networks = 2 + chance.index(2);
        for _ in 0..1 + chance.below(4) {
            let network = Some(chance.index(self.networks));
            let (one, both_ways) = (chance.index(self.nodes), chance.happens(600));
            let others = if chance.happens(500) { 0..self.nodes } else { one..one + 1 };
            let others: Vec<_> =
                others.map(|other| (other + 1) % self.nodes).filter(|other| *other != one).collect();
            let mut at = chance.between(self.period, heals);
            let (down, up) = (self.period / 2 + self.period * chance.of(&[0, 3, 8]), self.period / 3);
            for _ in 0..chance.of(&[1, 1, 4]) {
                let end = (at + down).min(heals);
                for other in others.iter().copied() {
                    self.cut_between(at, end, (one, other), network);
                    if both_ways {
                        self.cut_between(at, end, (other, one), network);
                    }
                }
                at = (end + up).min(heals);
            }
        }
    }

    /// Stalls applications for a time, or for good, in some plans.
    fn troubles(&mut self, chance: &mut Chance, heals: Duration) {
        for _ in 0..chance.below(4) {
            let node = chance.index(self.nodes);
            let mut at = chance.between(self.period, heals);
            for trouble in [Trouble::Stalled, Trouble::Down] {
                self.steps.push((at, Step::Trouble { node, trouble: Some(trouble) }));
                at = chance.between(at, heals);
            }
            if chance.happens(700) {
                self.steps.push((at, Step::Trouble { node, trouble: None }));
            }
        }
    }

    fn cut_between(
        &mut self,
        begins: Duration,
        ends: Duration,
        (from, to): (usize, usize),
        network: Option<usize>,
    ) {
        self.steps.push((begins, Step::Cut { from, to, network }));
        self.steps.push((ends, Step::Mend { from, to, network }));
    }

    fn starts(&mut self, chance: &mut Chance) {
        let spread = if chance.happens(500) { Duration::ZERO } else { self.period * 3 };
        for node in 0..self.nodes {
            let at = chance.between(Duration::ZERO, spread);
            self.steps.push((at, Step::Start { node, elsewhere: false }));
        }
    }

    fn fault(&mut self, chance: &mut Chance, heals: Duration) {
        let node = chance.index(self.nodes);
        let begins = chance.between(self.period, heals);
        let ends = (begins + chance.between(self.period / 10, self.period * 9)).min(heals);
        // No node passes on its known nodes: two that are both at unlisted addresses could not meet.
        let elsewhere = chance.happens(300) && self.finding != Finding::Seeds;
        let start = Step::Start { node, elsewhere };
        let mut happens = |at, what| self.steps.push((at, what));
        match chance.below(11) {
            0 | 1 => happens(begins, Step::Stall { node, lasts: ends - begins }),
            2 => {
                happens(begins, Step::Kill { node, refuses: chance.happens(300) });
                happens(ends, start);
            }
            3 => happens(begins, Step::Kill { node, refuses: chance.happens(300) }),
            4 => happens(begins, Step::Leave { node }),
            5 => {
                happens(begins, Step::Leave { node });
                happens(ends, start);
            }
            6 => happens(begins, Step::RestartShell { node }),
            9 => {
                // At the address of its former incarnation, while the answers of that one are in flight.
                happens(begins, Step::Kill { node, refuses: false });
                let again = (begins + chance.between(Duration::ZERO, self.period)).min(heals);
                happens(again, Step::Start { node, elsewhere: false });
            }
            7 => self.one_way(chance.index(self.nodes), node, begins, ends),
            8 => self.part(chance, begins, ends),
            _ => self.flap(chance.index(self.nodes), node, begins, ends),
        }
    }

    fn one_way(&mut self, from: usize, to: usize, begins: Duration, ends: Duration) {
        self.cut_between(begins, ends, (from, to), None);
    }

    /// Partitions the nodes for a time, in one direction or both.
    fn part(&mut self, chance: &mut Chance, begins: Duration, ends: Duration) {
        let (side, both_ways) = (chance.draw(), chance.happens(500));
        let is_there = |node: usize| side >> (node % 64) & 1 == 1;
        for from in 0..self.nodes {
            for to in 0..self.nodes {
                if is_there(from) && !is_there(to) || both_ways && !is_there(from) && is_there(to) {
                    self.one_way(from, to, begins, ends);
                }
            }
        }
    }

    fn flap(&mut self, from: usize, to: usize, begins: Duration, ends: Duration) {
        let mut at = begins;
        while at < ends {
            let up = at + self.period / 2;
            self.one_way(from, to, at, up.min(ends));
            self.one_way(to, from, at, up.min(ends));
            at = up + self.period / 3;
        }
    }
}

fn quality(chance: &mut Chance, period: Duration) -> Quality {
    Quality {
        lost_per_mille: chance.of(&[0, 0, 10, 100, 300]),
        doubled_per_mille: chance.of(&[0, 10, 200]),
        delay_max: chance.of(&[Duration::from_micros(200), period / 20, period / 3]),
        late_per_mille: chance.of(&[0, 0, 20, 200]),
        late_max: chance.of(&[period, period * 6]),
        ..Quality::GOOD
    }
}

/// Returns 0.6 or 1.2 periods in an eighth of all plans, like a process without real-time priority on a host where
/// others have it.
fn always_late(seed: u64, period: Duration) -> Duration {
    match seed % 16 {
        5 => period * 6 / 10,
        13 => period * 12 / 10,
        _ => Duration::ZERO,
    }
}

fn clock(chance: &mut Chance) -> Clock {
    let signed = |number: u64, most: u64| number.cast_signed() - most.cast_signed();
    let ahead_ns = signed(chance.below(200_000_000_001), 100_000_000_000);
    Clock::new(BEGIN, ahead_ns, signed(chance.below(199), 99))
}
