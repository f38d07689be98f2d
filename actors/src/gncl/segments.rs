//! How long segments of connections (TCP) may be, where packets of the length that the system takes vanish on the way to a peer.
//!
//! The system learns of such a way from ICMP alone, unless `net.ipv4.tcp_mtu_probing` is on: a segment that is too long is sent again until
//! the connection ends. So this node limits segments itself, from what datagrams have measured ([`Lengths`](super::datagrams)), or to
//! [`SAFE`] where connections say nothing while their node answers NDL. A limit counts for connections that are made after it.

use std::{
    collections::BTreeMap,
    net::TcpListener,
    sync::{Arc, Mutex},
};

use sinew_runtime::tid::NodeAddress;
use socket2::SockRef;
use tokio::sync::Notify;

use crate::stores::lock;

/// Of a way about which nothing was measured: what every host of IPv4 takes (576 bytes, RFC 1122, section 3.3.2), less both headers with
/// options and 8 bytes.
const SAFE: u32 = 488;
/// The headers of IP are the same for both; that of TCP is 12 bytes longer than that of UDP.
const LONGER_HEADER: usize = 12;
/// The least that Linux takes.
const LEAST: u32 = 88;

/// The limits, by peer: as many as there are peers at most.
#[derive(Debug, Default)]
pub(super) struct Segments {
    limits: Mutex<BTreeMap<NodeAddress, u32>>,
    /// Told when one was made.
    pub(super) made: Arc<Notify>,
}

impl Segments {
    /// The limit of connections to `node`.
    pub(super) fn limit(&self, node: NodeAddress) -> Option<u32> {
        lock(&self.limits).get(&node).copied()
    }

    /// Longer datagrams than this do not arrive at `node`; `None`: all do. spec: GNCL-19
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

    /// Connections to `node` say nothing, though it answers. Returns whether there is a limit that was not there.
    pub(super) fn guess(&self, node: NodeAddress) -> bool {
        let mut limits = lock(&self.limits);
        let is_new = limits.get(&node).is_none_or(|limit| *limit > SAFE);
        if is_new {
            limits.insert(node, SAFE);
        }
        is_new
    }

    /// The peer is gone.
    pub(super) fn forget(&self, node: NodeAddress) {
        lock(&self.limits).remove(&node);
    }

    /// Limits the connections that are accepted from now on to the least of all: it is not known before who makes one.
    pub(super) fn apply(&self, listeners: &[Arc<TcpListener>]) {
        let least = lock(&self.limits).values().copied().min().unwrap_or_default();
        for listener in listeners {
            // What the system does not take leaves connections as they are.
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
    fn a_connection_is_limited_by_what_was_measured_and_to_what_all_hosts_take_where_nothing_was() {
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
    fn who_connects_to_a_listener_with_a_limit_sends_no_longer_segments() {
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
