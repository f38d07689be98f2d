//! The addresses that a node announces for its GNCL.

use std::net::{IpAddr, SocketAddr, SocketAddrV4};

use crate::State;

/// Returns the addresses at which GNCL of a node with these addresses is reachable: all its IPv4 listening
/// addresses, the preferred one first. The second value is its port at the IPv6 addresses, which NDL
/// announces as its own.
pub(super) fn announced(state: &State, here: &[SocketAddr]) -> (Vec<SocketAddrV4>, Option<u16>) {
    let port6 = state.ctx.listens.port6.get().copied();
    let Some(SocketAddr::V4(listens)) = state.ctx.listens.first.get().copied() else {
        return (Vec::new(), port6);
    };
    let mut all = if listens.ip().is_unspecified() {
        at_paths(here, listens.port())
    } else {
        let further = state.ctx.listens.further.get().into_iter().flatten();
        std::iter::once(&listens).chain(further).copied().collect()
    };
    if let Some(outer) = state.ctx.config.gncl.announce {
        all.splice(..all.len().min(1), [outer]);
    }
    (all, port6)
}

/// Returns the addresses of the paths, for a GNCL that listens at all addresses. The loopback address is
/// last: the nodes of this host use it when no other one is left. Nodes of other hosts would reach themselves
/// there, and ignore it. // spec: NDL-3.6
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
    fn loopback_beside_other_addresses_is_announced_last() {
        let here = ["127.0.0.1:7", "10.0.0.1:7", "[::1]:7", "10.1.0.1:7"].map(|here| here.parse().unwrap());
        let words = at_paths(&here, 5_000).into_iter().map(|at| at.to_string()).collect::<Vec<_>>();
        assert_eq!(words, ["10.0.0.1:5000", "10.1.0.1:5000", "127.0.0.1:5000"]);
    }
}
