//! What becomes of a datagram: lost, late, twice, out of order, cut off.

use std::{collections::BTreeSet, net::SocketAddr, ops::Range, rc::Rc, time::Duration};

use super::{chance::Chance, plan::Quality};
use crate::ndl::core::Way;

/// Least time on the network.
const DELAY_MIN: Duration = Duration::from_micros(50);
/// What the network does when all is well again.
const HEALED: Quality = Quality {
    lost_per_mille: 0,
    twice_per_mille: 0,
    delay_max: Duration::from_micros(200),
    late_per_mille: 0,
    late_max: Duration::ZERO,
};

/// What a datagram is, for the judge.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum What {
    Query,
    Answer(u64),
    Leave,
}

/// A datagram under way; processes are counted from 0, in the order of their starts.
#[derive(Clone, Debug)]
pub(super) struct Flying {
    pub(super) sender: usize,
    pub(super) from: SocketAddr,
    pub(super) to: SocketAddr,
    pub(super) way: Way,
    pub(super) what: What,
    pub(super) bytes: Rc<[u8]>,
}

pub(super) struct Network {
    quality: Quality,
    networks: usize,
    /// From which node to which nothing gets through, in which network.
    cut: BTreeSet<(usize, usize, usize)>,
    /// From which to which no datagram does.
    muffled: BTreeSet<(usize, usize)>,
}

impl Network {
    pub(super) const fn new(quality: Quality, networks: usize) -> Self {
        Self { quality, networks, cut: BTreeSet::new(), muffled: BTreeSet::new() }
    }

    /// In one network, or in all.
    pub(super) fn cut(&mut self, from: usize, to: usize, network: Option<usize>) {
        let networks = self.those(network);
        self.cut.extend(networks.map(|network| (from, to, network)));
    }

    pub(super) fn mend(&mut self, from: usize, to: usize, network: Option<usize>) {
        for network in self.those(network) {
            self.cut.remove(&(from, to, network));
        }
    }

    fn those(&self, network: Option<usize>) -> Range<usize> {
        network.map_or(0..self.networks, |network| network..network + 1)
    }

    pub(super) fn muffle(&mut self, from: usize, to: usize) {
        self.muffled.insert((from, to));
    }

    pub(super) fn unmuffle(&mut self, from: usize, to: usize) {
        self.muffled.remove(&(from, to));
    }

    pub(super) fn heal(&mut self) {
        self.cut.clear();
        self.muffled.clear();
        self.quality = HEALED;
    }

    /// Whether in no network packets go both ways.
    pub(super) fn is_apart(&self, one: usize, other: usize) -> bool {
        let is_apart =
            |network| self.cut.contains(&(one, other, network)) || self.cut.contains(&(other, one, network));
        (0..self.networks).all(is_apart)
    }

    /// After which times a datagram arrives: not at all, once, or twice.
    pub(super) fn delays(
        &self,
        chance: &mut Chance,
        (from, to): (usize, usize),
        network: usize,
    ) -> Vec<Duration> {
        let quality = self.quality;
        let is_stopped = self.cut.contains(&(from, to, network)) || self.muffled.contains(&(from, to));
        if is_stopped || chance.happens(quality.lost_per_mille) {
            return Vec::new();
        }
        let copies = if chance.happens(quality.twice_per_mille) { 2 } else { 1 };
        (0..copies).map(|_| self.delay(chance)).collect()
    }

    fn delay(&self, chance: &mut Chance) -> Duration {
        let most = if chance.happens(self.quality.late_per_mille) {
            self.quality.late_max
        } else {
            self.quality.delay_max
        };
        chance.between(DELAY_MIN, most)
    }
}
