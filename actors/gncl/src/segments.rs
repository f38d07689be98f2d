//! Limits of the TCP segment length, for peers to which packets of the system's length do not arrive.
//!
//! The system learns of such a path only from ICMP, unless `net.ipv4.tcp_mtu_probing` is on. Otherwise a
//! segment that is too long is sent again until the connection ends. This node therefore limits segments
//! itself. The limit is measured by datagrams ([`Lengths`](super::datagrams)), or is [`SAFE`] if connections
//! get no answer while their node answers NDL. A limit applies to connections created after it.

use std::{
    collections::BTreeMap,
    net::TcpListener,
    sync::{Arc, Mutex},
};

use sinew_runtime::{lock, tid::NodeAddress};
use socket2::SockRef;
use tokio::sync::Notify;

/// Limit of a path without a measurement. It is the packet that every IPv4 host accepts (576 bytes, RFC 1122,
/// section 3.3.2), less both headers with options and 8 bytes.
const SAFE: u32 = 488;
/// The IP headers are the same for both; the TCP header is 12 bytes longer than that of UDP.
const LONGER_HEADER: usize = 12;
/// The minimum that Linux accepts.
const LEAST: u32 = 88;

/// The limits by peer, at most one each.
#[derive(Debug, Default)]
pub(super) struct Segments {
    limits: Mutex<BTreeMap<NodeAddress, u32>>,
    /// Notified when a limit was set.
    pub(super) made: Arc<Notify>,
}

impl Segments {
    /// Returns the limit of connections to `node`.
    pub(super) fn limit(&self, node: NodeAddress) -> Option<u32> {
        lock(&self.limits).get(&node).copied()
    }

    /// Records that longer datagrams than this do not arrive at `node`; `None`: all do. spec: GNCL-19
    pub(super) fn measured(&self, node: NodeAddress, longest: Option<usize>) {
        let limit = longest.map(|longest| (longest.saturating_sub(LONGER_HEADER) as u32).max(LEAST));
        let before = {
            let mut limits = lock(&self.limits);
            match limit {
                Some(limit) => limits.insert(node, limit),
                None => limits.remove(&node),
            }
        };
        if limit.is_some_and(|limit| before.is_none_or(|before| limit < before)) {
            self.made.notify_one();
        }
    }

    /// Sets the safe limit for connections to `node` that get no answer, though the node answers. Returns
    /// whether the limit is new.
    pub(super) fn guess(&self, node: NodeAddress) -> bool {
        let mut limits = lock(&self.limits);
        let is_new = limits.get(&node).is_none_or(|limit| *limit > SAFE);
        if is_new {
            limits.insert(node, SAFE);
        }
        is_new
    }

    /// Removes the limit of a removed peer.
    pub(super) fn forget(&self, node: NodeAddress) {
        lock(&self.limits).remove(&node);
    }

    /// Limits the connections accepted from now on to the minimum of all limits, because the peer is not
    /// known at that time.
    pub(super) fn apply(&self, listeners: &[Arc<TcpListener>]) {
        let least = lock(&self.limits).values().copied().min().unwrap_or_default();
        for listener in listeners {
            // If the system refuses the value, connections keep their default.
            let _ = SockRef::from(&**listener).set_tcp_mss(least);
        }
    }
}

/// Whether a connection may send longer segments.
pub(super) fn is_longer(socket: &tokio::net::TcpStream, limit: u32) -> bool {
    SockRef::from(socket).tcp_mss().is_ok_and(|mss| mss > limit)
}

#[cfg(test)]
mod tests {
    use std::net::{Ipv4Addr, TcpStream};

    use super::*;

    const NODE: NodeAddress = NodeAddress::new(7);

    // spec: GNCL-19
    #[test]
    fn segments_are_limited_by_measurement_or_the_common_minimum() {
        let segments = Segments::default();
        assert_eq!(segments.limit(NODE), None);
        segments.measured(NODE, Some(972));
        assert_eq!(segments.limit(NODE), Some(960));
        assert!(segments.guess(NODE) && !segments.guess(NODE));
        assert_eq!(segments.limit(NODE), Some(SAFE));
        segments.measured(NODE, None);
        assert_eq!(segments.limit(NODE), None);
    }

    // spec: GNCL-19
    #[cfg(target_os = "linux")]
    #[test]
    fn connection_to_a_limited_listener_sends_no_longer_segments() {
        let listener = Arc::new(TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap());
        let segments = Segments::default();
        segments.measured(NODE, Some(512));
        segments.apply(std::slice::from_ref(&listener));
        let dialled = TcpStream::connect(listener.local_addr().unwrap()).unwrap();
        let (accepted, _) = listener.accept().unwrap();
        for end in [&dialled, &accepted] {
            assert!(SockRef::from(end).tcp_mss().unwrap() <= 500);
        }
        segments.measured(NODE, None);
        segments.apply(std::slice::from_ref(&listener));
        let dialled = TcpStream::connect(listener.local_addr().unwrap()).unwrap();
        assert!(SockRef::from(&dialled).tcp_mss().unwrap() > 500);
    }
}
