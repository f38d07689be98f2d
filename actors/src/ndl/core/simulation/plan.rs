//! What a seed says: the nodes, the network, and what happens to them when.

use std::time::Duration;

use super::chance::Chance;
use crate::ndl::{Trouble, core::Host};

/// Faults of a crowd; one that parts it is a million cuts among 1,000.
const FAULTS_OF_A_CROWD: usize = 20;

/// How nodes find each other.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Finding {
    /// By the multicast group.
    Group,
    /// By lists of addresses, without multicast.
    Seeds,
    /// By mDNS, which tells of a node once, when it starts.
    Mdns,
}

/// What the network does to datagrams.
#[derive(Clone, Copy, Debug)]
pub(super) struct Quality {
    pub(super) lost_per_mille: u64,
    pub(super) twice_per_mille: u64,
    pub(super) delay_max: Duration,
    pub(super) late_per_mille: u64,
    pub(super) late_max: Duration,
}

/// A host's clock.
#[derive(Clone, Copy, Debug)]
pub(super) struct Clock {
    pub(super) ahead_ns: i64,
    pub(super) fast_ppm: i64,
}

/// Something that happens; nodes are counted from 0.
#[derive(Clone, Copy, Debug)]
pub(super) enum Happening {
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
    /// Datagrams are lost from one to the other, and nothing else.
    Muffle {
        from: usize,
        to: usize,
    },
    Unmuffle {
        from: usize,
        to: usize,
    },
    /// An application of it does not get on, or does again.
    Trouble {
        node: usize,
        trouble: Option<Trouble>,
    },
    Heal,
}

/// All that a seed says.
#[derive(Clone, Debug)]
pub(super) struct Plan {
    pub(super) seed: u64,
    pub(super) nodes: usize,
    pub(super) period: Duration,
    pub(super) missed_max: u32,
    /// A node that all others watch at another pace, and that.
    pub(super) watched: Option<(usize, Duration, u32)>,
    pub(super) finding: Finding,
    /// Whether GNCL's connections deliver where the network is not cut.
    pub(super) connections: bool,
    /// Networks in which each node has an address.
    pub(super) networks: usize,
    /// Each host has one further address that all others have, too, as that of a bridge for containers, and each node says that its GNCL is
    /// there: what one's own host says to whoever tries it.
    pub(super) shared: Option<Host>,
    pub(super) quality: Quality,
    /// How late a timer wakes a node that is not stalled, at most.
    pub(super) lateness: Duration,
    /// How late each does at least.
    pub(super) always_late: Duration,
    pub(super) clocks: Vec<Clock>,
    /// When what happens, in order of time.
    pub(super) happenings: Vec<(Duration, Happening)>,
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
            // Of the seed alone, so that nothing else of it changes.
            shared: [None, Some(Host::Refuses), Some(Host::Accepts)][(seed % 3) as usize],
            quality: quality(&mut chance, period),
            lateness: chance.of(&[Duration::ZERO, period / 50, period / 4]),
            // Of the seed alone, too.
            always_late: always_late(seed, period),
            clocks: (0..nodes).map(|_| clock(&mut chance)).collect(),
            happenings: Vec::new(),
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
        plan.happenings.push((heals, Happening::Heal));
        plan.happenings.sort_by_key(|(at, _)| *at);
        // An address where nobody answered is asked every 16 periods at last.
        let found_again = if finding == Finding::Mdns { 18 } else { 3 };
        // A loss takes longer of a node that is watched more slowly.
        let watched = plan
            .watched
            .map_or(Duration::ZERO, |(_, period, missed_max)| plan.silence_max(period, missed_max) + period);
        let loss = watched.max(plan.silence_max(period, missed_max) + period);
        plan.end = heals + plan.quality.late_max + loss + (period + plan.always_late) * found_again;
        plan
    }

    /// How long a member that is watched so is silent before it is lost, at most: the bound, which those who are always late by more than half a
    /// period stretch to four of their cycles for each, and their three respites.
    pub(super) fn silence_max(&self, period: Duration, missed_max: u32) -> Duration {
        if self.always_late <= period / 2 {
            // Respites: each is more than twice as long as the one before, and none is longer than a timer was late.
            return period * (missed_max + 1) + (self.lateness + self.always_late) * 5;
        }
        let late = self.always_late + self.lateness;
        (period + late) * 4 * (missed_max + 1) + (period / 2 + late) * 3
    }

    /// Many nodes that find each other through the group, and so many faults that several happen at a time.
    pub(super) fn crowd(seed: u64, nodes: usize) -> Self {
        let mut chance = Chance::new(seed);
        let period = Duration::from_millis(500);
        let mut quality = quality(&mut chance, period);
        // More than this, and everybody loses many others all the time, rightly.
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
            happenings: Vec::new(),
            end: Duration::ZERO,
        };
        let heals = period * 8;
        plan.starts(&mut chance);
        for _ in 0..FAULTS_OF_A_CROWD {
            plan.fault(&mut chance, heals);
        }
        plan.troubles(&mut chance, heals);
        plan.happenings.push((heals, Happening::Heal));
        plan.happenings.sort_by_key(|(at, _)| *at);
        plan.end = heals + plan.quality.late_max + period * (plan.missed_max + 2 + 3);
        plan
    }

    /// One node has a pace of its own, in some plans: up to five times that of the others, or a third of it.
    fn watch(&mut self, chance: &mut Chance) {
        if !chance.happens(400) {
            return;
        }
        let pace = chance.of(&[self.period / 5, self.period / 2, self.period * 3]);
        self.watched = Some((chance.index(self.nodes), pace, chance.of(&[2, 3, 5])));
        self.lateness = self.lateness.min(pace / 4);
    }

    /// Connections deliver, in most plans; in some of these datagrams do not, between some nodes, one way or both.
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
                self.happenings.push((begins, Happening::Muffle { from, to }));
                self.happenings.push((ends, Happening::Unmuffle { from, to }));
            }
        }
    }

    /// Several networks, in some plans: each node has an address in each, and networks fail one by one, between two nodes or around one,
    /// one way or both, for good or again and again.
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

    /// Applications do not get on for a time, or for good, in some plans.
    fn troubles(&mut self, chance: &mut Chance, heals: Duration) {
        for _ in 0..chance.below(4) {
            let node = chance.index(self.nodes);
            let mut at = chance.between(self.period, heals);
            for trouble in [Trouble::Stalled, Trouble::Down] {
                self.happenings.push((at, Happening::Trouble { node, trouble: Some(trouble) }));
                at = chance.between(at, heals);
            }
            if chance.happens(700) {
                self.happenings.push((at, Happening::Trouble { node, trouble: None }));
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
        self.happenings.push((begins, Happening::Cut { from, to, network }));
        self.happenings.push((ends, Happening::Mend { from, to, network }));
    }

    fn starts(&mut self, chance: &mut Chance) {
        let spread = if chance.happens(500) { Duration::ZERO } else { self.period * 3 };
        for node in 0..self.nodes {
            let at = chance.between(Duration::ZERO, spread);
            self.happenings.push((at, Happening::Start { node, elsewhere: false }));
        }
    }

    fn fault(&mut self, chance: &mut Chance, heals: Duration) {
        let node = chance.index(self.nodes);
        let begins = chance.between(self.period, heals);
        let ends = (begins + chance.between(self.period / 10, self.period * 9)).min(heals);
        // Nobody passes on whom it knows: two that are both where no list has them could not meet.
        let elsewhere = chance.happens(300) && self.finding != Finding::Seeds;
        let start = Happening::Start { node, elsewhere };
        let mut happens = |at, what| self.happenings.push((at, what));
        match chance.below(11) {
            0 | 1 => happens(begins, Happening::Stall { node, lasts: ends - begins }),
            2 => {
                happens(begins, Happening::Kill { node, refuses: chance.happens(300) });
                happens(ends, start);
            }
            3 => happens(begins, Happening::Kill { node, refuses: chance.happens(300) }),
            4 => happens(begins, Happening::Leave { node }),
            5 => {
                happens(begins, Happening::Leave { node });
                happens(ends, start);
            }
            6 => happens(begins, Happening::RestartShell { node }),
            9 => {
                // In its former life's place, while that one's answers are under way.
                happens(begins, Happening::Kill { node, refuses: false });
                let again = (begins + chance.between(Duration::ZERO, self.period)).min(heals);
                happens(again, Happening::Start { node, elsewhere: false });
            }
            7 => self.one_way(chance.index(self.nodes), node, begins, ends),
            8 => self.part(chance, begins, ends),
            _ => self.flap(chance.index(self.nodes), node, begins, ends),
        }
    }

    fn one_way(&mut self, from: usize, to: usize, begins: Duration, ends: Duration) {
        self.cut_between(begins, ends, (from, to), None);
    }

    /// Some cannot hear the others for a time, or neither side the other.
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
        twice_per_mille: chance.of(&[0, 10, 200]),
        delay_max: chance.of(&[Duration::from_micros(200), period / 20, period / 3]),
        late_per_mille: chance.of(&[0, 0, 20, 200]),
        late_max: chance.of(&[period, period * 6]),
    }
}

/// In an eighth of all plans by 0.6 or by 1.2 periods, as one that has no right to real time on a host that others have to themselves.
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
    Clock { ahead_ns, fast_ppm: signed(chance.below(199), 99) }
}
