//! The treatment of datagrams: lost, late, duplicated, reordered, cut off.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::Duration,
};

use crate::Chance;

/// The treatment of a datagram by a link.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Quality {
    /// Lost datagrams of 1,000.
    pub lost_per_mille: u64,
    /// Datagrams of 1,000 that arrive twice.
    pub doubled_per_mille: u64,
    /// Minimum time on the link.
    pub delay_min: Duration,
    /// Maximum time on the link. A later datagram can overtake an earlier one if this exceeds `delay_min`.
    pub delay_max: Duration,
    /// Datagrams of 1,000 for which `late_max` is the maximum instead.
    pub late_per_mille: u64,
    /// Maximum time on the link of a late datagram.
    pub late_max: Duration,
}

impl Quality {
    /// A link without faults: 50 to 200 µs, as on a local network at rest.
    pub const GOOD: Self = Self {
        lost_per_mille: 0,
        doubled_per_mille: 0,
        delay_min: Duration::from_micros(50),
        delay_max: Duration::from_micros(200),
        late_per_mille: 0,
        late_max: Duration::ZERO,
    };
}

/// The links between all ends. Each direction is cut on its own.
#[derive(Clone, Debug)]
pub struct Network<N> {
    quality: Quality,
    qualities: BTreeMap<(N, N), Quality>,
    cut: BTreeSet<(N, N)>,
}

impl<N: Copy + Ord> Network<N> {
    /// Creates a network with links that all have this quality.
    #[must_use]
    pub const fn new(quality: Quality) -> Self {
        Self { quality, qualities: BTreeMap::new(), cut: BTreeSet::new() }
    }

    /// Sets the quality of one direction.
    pub fn set_quality(&mut self, from: N, to: N, quality: Quality) {
        self.qualities.insert((from, to), quality);
    }

    /// Cuts one direction: nothing that is sent from now on arrives.
    pub fn cut(&mut self, from: N, to: N) {
        self.cut.insert((from, to));
    }

    /// Ends the cut of one direction.
    pub fn mend(&mut self, from: N, to: N) {
        self.cut.remove(&(from, to));
    }

    /// Cuts both directions between each of these and each of the others.
    pub fn part(&mut self, these: &[N], others: &[N]) {
        for (one, other) in these.iter().flat_map(|one| others.iter().map(move |other| (*one, *other))) {
            self.cut.extend([(one, other), (other, one)]);
        }
    }

    /// Ends all cuts, and gives all links this quality.
    pub fn heal(&mut self, quality: Quality) {
        self.cut.clear();
        self.qualities.clear();
        self.quality = quality;
    }

    /// Returns whether this direction is cut.
    #[must_use]
    pub fn is_cut(&self, from: N, to: N) -> bool {
        self.cut.contains(&(from, to))
    }

    /// Returns whether a direction between both is cut: no connection is possible.
    #[must_use]
    pub fn is_apart(&self, one: N, other: N) -> bool {
        self.is_cut(one, other) || self.is_cut(other, one)
    }

    /// Returns the delays after which a datagram arrives: none, one, or two.
    pub fn arrivals(&self, chance: &mut Chance, from: N, to: N) -> Vec<Duration> {
        let quality = self.quality(from, to);
        if self.is_cut(from, to) || chance.happens(quality.lost_per_mille) {
            return Vec::new();
        }
        let copies = if chance.happens(quality.doubled_per_mille) { 2 } else { 1 };
        (0..copies).map(|_| self.delay(chance, from, to)).collect()
    }

    /// Returns the delay of a packet that arrives.
    pub fn delay(&self, chance: &mut Chance, from: N, to: N) -> Duration {
        let Quality { delay_min, delay_max, late_per_mille, late_max, .. } = self.quality(from, to);
        let most = if chance.happens(late_per_mille) { late_max } else { delay_max };
        chance.between(delay_min, most)
    }

    fn quality(&self, from: N, to: N) -> Quality {
        self.qualities.get(&(from, to)).copied().unwrap_or(self.quality)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cut_of_one_direction_leaves_the_other() {
        let mut network = Network::new(Quality::GOOD);
        let mut chance = Chance::new(3);
        network.cut('a', 'b');
        assert_eq!(network.arrivals(&mut chance, 'a', 'b'), []);
        assert_eq!(network.arrivals(&mut chance, 'b', 'a').len(), 1);
        assert!(network.is_apart('b', 'a'));
        network.part(&['a'], &['b', 'c']);
        network.mend('a', 'b');
        assert!(network.is_cut('b', 'a') && network.is_cut('a', 'c') && !network.is_cut('b', 'c'));
        network.heal(Quality::GOOD);
        assert!(!network.is_apart('a', 'b'));
    }

    #[test]
    fn quality_decides_loss_and_duplicates() {
        let mut chance = Chance::new(3);
        let mut network = Network::new(Quality { lost_per_mille: 1_000, ..Quality::GOOD });
        network.set_quality('b', 'a', Quality { doubled_per_mille: 1_000, ..Quality::GOOD });
        assert_eq!(network.arrivals(&mut chance, 'a', 'b'), []);
        assert_eq!(network.arrivals(&mut chance, 'b', 'a').len(), 2);
    }
}
