//! Where a node says that its GNCL listens.

use std::net::{IpAddr, SocketAddr, SocketAddrV4};

use crate::stores::Stores;

/// Where the others reach GNCL of a node that has these addresses: at all of IPv4 at which it listens, the one that is preferred first; and at
/// which port at those of IPv6, which NDL announces as its own.
pub(super) fn announced(stores: &Stores, here: &[SocketAddr]) -> (Vec<SocketAddrV4>, Option<u16>) {
    let port6 = stores.gncl_port6.get().copied();
    let Some(SocketAddr::V4(listens)) = stores.gncl_listen.get().copied() else { return (Vec::new(), port6) };
    let mut all = if listens.ip().is_unspecified() {
        at_paths(here, listens.port())
    } else {
        let further = stores.gncl_further.get().into_iter().flatten();
        std::iter::once(&listens).chain(further).copied().collect()
    };
    if let Some(outer) = stores.config.gncl.announce {
        all.splice(..all.len().min(1), [outer]);
    }
    (all, port6)
}

/// One that listens at all addresses takes connections at its paths. That of loopback comes last: the nodes of this host go on there when no
/// other one is left, and those of other hosts, who would find themselves there, leave it out. // spec: NDL-3.6
fn at_paths(here: &[SocketAddr], port: u16) -> Vec<SocketAddrV4> {
    let ips = here.iter().filter_map(|here| match here.ip() {
        IpAddr::V4(ip) => Some(ip),
        IpAddr::V6(_) => None,
    });
    let mut ips: Vec<_> = ips.collect();
    ips.sort_by_key(|ip| ip.is_loopback());
    ips.into_iter().map(|ip| SocketAddrV4::new(ip, port)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    // spec: NDL-3.6
    #[test]
    fn a_node_that_has_loopback_beside_others_says_so_behind_them() {
        let here = ["127.0.0.1:7", "10.0.0.1:7", "[::1]:7", "10.1.0.1:7"].map(|here| here.parse().unwrap());
        let words = at_paths(&here, 5_000).into_iter().map(|at| at.to_string()).collect::<Vec<_>>();
        assert_eq!(words, ["10.0.0.1:5000", "10.1.0.1:5000", "127.0.0.1:5000"]);
    }
}
