//! The destination and the source address of a dial.

use std::{
    cmp::Reverse,
    net::{IpAddr, Ipv6Addr, SocketAddr},
};

/// The destination of a dial, and the local source address; `None`: the system chooses.
#[derive(Clone, Copy, Debug)]
pub(crate) struct DialAddresses {
    pub(crate) to: SocketAddr,
    pub(crate) from: Option<IpAddr>,
    /// Maximum segment length, if a limit is known.
    pub(crate) segment_max: Option<u32>,
}

impl DialAddresses {
    /// Selects the addresses of a dial. The source is the one of `paths`, this node's announced addresses, in
    /// the destination's network. The system would choose a temporary IPv6 address (RFC 8981), and the peer
    /// would see a connection from an unknown address. If no path is in that network, or for IPv4, the system
    /// chooses.
    pub(crate) fn select(to: SocketAddr, paths: &[SocketAddr]) -> Self {
        let from = match to {
            SocketAddr::V6(to) if !to.ip().is_unicast_link_local() && !to.ip().is_loopback() => {
                // Length of the common prefix. A network may be smaller than its first 64 bits, for example
                // one per link.
                let shared = |ip: &Ipv6Addr| (ip.to_bits() ^ to.ip().to_bits()).leading_zeros();
                let nearest = paths.iter().filter_map(|path| match path {
                    SocketAddr::V6(path) => Some((shared(path.ip()), *path.ip())),
                    SocketAddr::V4(_) => None,
                });
                let mut nearest: Vec<_> = nearest.filter(|(shared, _)| *shared >= 64).collect();
                nearest.sort_unstable_by_key(|(shared, _)| Reverse(*shared));
                match nearest[..] {
                    [(_, ip)] => Some(IpAddr::from(ip)),
                    [(first, ip), (second, _), ..] if first > second => Some(IpAddr::from(ip)),
                    // Of two equally near addresses the system knows which one is routed there.
                    _ => None,
                }
            }
            SocketAddr::V6(_) | SocketAddr::V4(_) => None,
        };
        Self { to, from, segment_max: None }
    }
}
