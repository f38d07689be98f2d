//! The networks between the nodes, and the datagrams in flight.

use std::{collections::BTreeSet, net::SocketAddr, rc::Rc, time::Duration};

use sinew_ndl::core::Cast;
use sinew_runtime::tid::NodeAddress;
use sinew_sim::{Chance, Network, Quality};

/// Returns the address of a node.
pub(super) fn node_address(node: usize) -> NodeAddress {
    NodeAddress::new(0x0a00_0001 + u32::try_from(node).expect("few nodes"))
}

/// The kind of a datagram, for the judge.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    Query,
    Answer(u64),
    Leave,
}

/// A datagram in flight; processes are counted from 0, in the order of their starts.
#[derive(Clone, Debug)]
pub(super) struct Flight {
    pub(super) sender: usize,
    pub(super) from: SocketAddr,
    pub(super) to: SocketAddr,
    pub(super) cast: Cast,
    pub(super) kind: Kind,
    pub(super) bytes: Rc<[u8]>,
}

/// The networks in which each node has an address. Nodes are counted from 0.
pub(super) struct Networks {
    all: Vec<Network<usize>>,
    /// Sender and receiver between which no datagram gets through.
    muffled: BTreeSet<(usize, usize)>,
}

impl Networks {
    pub(super) fn new(quality: Quality, networks: usize) -> Self {
        Self { all: vec![Network::new(quality); networks], muffled: BTreeSet::new() }
    }

    /// Cuts the path in one network, or in all.
    pub(super) fn cut(&mut self, from: usize, to: usize, network: Option<usize>) {
        self.chosen(network).iter_mut().for_each(|network| network.cut(from, to));
    }

    pub(super) fn mend(&mut self, from: usize, to: usize, network: Option<usize>) {
        self.chosen(network).iter_mut().for_each(|network| network.mend(from, to));
    }

    fn chosen(&mut self, network: Option<usize>) -> &mut [Network<usize>] {
        match network {
            Some(network) => &mut self.all[network..=network],
            None => &mut self.all,
        }
    }

    pub(super) fn muffle(&mut self, from: usize, to: usize) {
        self.muffled.insert((from, to));
    }

    pub(super) fn unmuffle(&mut self, from: usize, to: usize) {
        self.muffled.remove(&(from, to));
    }

    pub(super) fn heal(&mut self) {
        self.all.iter_mut().for_each(|network| network.heal(Quality::GOOD));
        self.muffled.clear();
    }

    /// Returns whether no network carries packets in both directions.
    pub(super) fn is_apart(&self, one: usize, other: usize) -> bool {
        self.all.iter().all(|network| network.is_apart(one, other))
    }

    /// Returns the delays after which a datagram arrives: none, one, or two.
    pub(super) fn arrivals(
        &self,
        chance: &mut Chance,
        (from, to): (usize, usize),
        network: usize,
    ) -> Vec<Duration> {
        if self.muffled.contains(&(from, to)) {
            return Vec::new();
        }
        self.all[network].arrivals(chance, from, to)
    }
}
