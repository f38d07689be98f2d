//! Which addresses this host has itself: what another host says of itself under one of them leads to this one.
//!
//! The bridge of a container has the same address on each host that has one, and is announced where `ndl.interface` is `all`.

use std::{collections::BTreeSet, net::SocketAddr};

use super::{Core, member::Member};
use crate::ndl::address::host_at;

/// Addresses of this host.
#[derive(Debug, Default)]
pub(super) struct Own {
    /// Those where this node's NDL answers.
    paths: Vec<SocketAddr>,
    /// All, as far as somebody looks.
    all: BTreeSet<SocketAddr>,
}

impl Own {
    pub(super) fn use_paths(&mut self, paths: &[SocketAddr]) {
        self.paths = paths.iter().copied().map(host_at).collect();
    }

    pub(super) fn has(&self, address: SocketAddr) -> bool {
        let host = host_at(address);
        host.ip().is_loopback() || self.paths.contains(&host) || self.all.contains(&host)
    }
}

impl Core {
    /// This host has these addresses, used or not.
    pub(crate) fn use_own(&mut self, own: &[SocketAddr]) {
        self.own.all = own.iter().copied().map(host_at).collect();
    }

    /// Whether these are known to be this host's already, and no others.
    pub(crate) fn has_own(&self, own: &[SocketAddr]) -> bool {
        own.iter().copied().map(host_at).collect::<BTreeSet<_>>() == self.own.all
    }
}

impl Member {
    /// Whether it answers from this host.
    fn is_here(&self, own: &Own) -> bool {
        self.routes.places().any(|place| own.has(place.there))
    }

    /// Whether it can be it that is reached there: this host has none of the addresses that another host has.
    pub(super) fn may_be_at(&self, own: &Own, address: SocketAddr) -> bool {
        !own.has(address) || self.is_here(own)
    }
}
