//! The addresses of this host, and the seeds that are queried from them.
//!
//! An address that another host announces may lead to this host instead. A container's bridge has the same
//! address on each host that has one. It is announced if `ndl.interface` is `all`.

use std::{
    collections::{BTreeMap, BTreeSet},
    net::SocketAddr,
};

use sinew_model::{
    address::{host_at, seen_from},
    limits::PATHS_MAX,
};

use super::Place;

/// The addresses of this host, and the configured ones of others.
#[derive(Debug, Default)]
pub(super) struct LocalAddresses {
    /// Local UDP addresses, one for each path; empty before the first start.
    paths: Vec<SocketAddr>,
    /// All addresses of this host, as far as the interfaces are watched.
    all: BTreeSet<SocketAddr>,
    /// The interface name of each of them, for tools.
    names: BTreeMap<SocketAddr, String>,
    /// A path was removed after another one was added. A node that left meanwhile knows this node at the removed one.
    has_moved: bool,
    seeds: Vec<SocketAddr>,
}

impl LocalAddresses {
    pub(super) fn new(seeds: Vec<SocketAddr>) -> Self {
        Self { seeds, ..Self::default() }
    }

    /// Sets the local addresses for queries, and returns the new ones.
    pub(super) fn use_paths(&mut self, paths: &[SocketAddr]) -> Vec<SocketAddr> {
        let paths = &paths[..paths.len().min(PATHS_MAX)];
        let new: Vec<_> = paths.iter().copied().filter(|path| !self.paths.contains(path)).collect();
        self.has_moved |= self.paths.iter().any(|path| !paths.contains(path));
        self.paths = paths.to_vec();
        new
    }

    /// Returns whether a path was removed since the last call.
    pub(super) fn take_moved(&mut self) -> bool {
        std::mem::take(&mut self.has_moved)
    }

    pub(super) fn paths(&self) -> &[SocketAddr] {
        &self.paths
    }

    /// Returns whether `address` leads to this host.
    pub(super) fn has(&self, address: SocketAddr) -> bool {
        let host = host_at(address);
        let is_path = || self.paths.iter().any(|path| host_at(*path) == host);
        host.ip().is_loopback() || is_path() || self.all.contains(&host)
    }

    /// Sets all addresses of this host, used or not.
    pub(super) fn use_all(&mut self, all: &[SocketAddr]) {
        self.all = hosts(all);
    }

    /// Sets the interface names of the addresses of this host.
    pub(super) fn use_names(&mut self, names: BTreeMap<SocketAddr, String>) {
        self.names = names;
    }

    /// Returns the interface name of a local address, if the interfaces are watched.
    pub(super) fn interface_of(&self, path: SocketAddr) -> Option<&str> {
        self.names.get(&host_at(path)).map(String::as_str)
    }

    /// Returns whether exactly these addresses are known as this host's.
    pub(super) fn are(&self, all: &[SocketAddr]) -> bool {
        hosts(all) == self.all
    }

    /// Replaces the seeds. Returns whether they are other ones.
    pub(super) fn use_seeds(&mut self, seeds: Vec<SocketAddr>) -> bool {
        let are_others = !self.has_seeds(&seeds);
        self.seeds = seeds;
        are_others
    }

    pub(super) fn has_seeds(&self, seeds: &[SocketAddr]) -> bool {
        self.seeds == seeds
    }

    /// Returns the places of the seeds, without those at this node's own addresses.
    pub(super) fn seed_places(&self) -> impl Iterator<Item = Place> {
        let is_local = |seed: &SocketAddr| self.paths.iter().any(|path| *path == seen_from(*path, *seed));
        let seeds = self.seeds.iter().filter(move |seed| !is_local(seed));
        seeds.flat_map(|seed| self.places_of(*seed))
    }

    /// Returns the places from which to query an address: each usable local address. If there is none, one
    /// place remains, so that the system reports the error.
    pub(super) fn places_of(&self, there: SocketAddr) -> Vec<Place> {
        // A link-local address with a known link is only queried from that link.
        let is_meant = |here: &&SocketAddr| match there {
            SocketAddr::V6(there) if there.scope_id() != 0 => seen_from(**here, there.into()) == there.into(),
            SocketAddr::V4(_) | SocketAddr::V6(_) => true,
        };
        let places = || self.paths.iter().filter(is_meant).map(|here| Place::between(*here, there));
        let usable: Vec<_> = places().filter(Place::is_usable).collect();
        if usable.is_empty() { places().collect() } else { usable }
    }
}

fn hosts(all: &[SocketAddr]) -> BTreeSet<SocketAddr> {
    all.iter().copied().map(host_at).collect()
}
