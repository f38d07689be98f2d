//! A dial of ours to a peer: all addresses that it announced, one shortly after the other, until one is reached. spec: GNCL-16

use std::{collections::VecDeque, net::SocketAddr, time::Duration};

use sinew_runtime::{tid::NodeAddress, time::Time};

use super::{ConnectionId, Core, Lane, LinkFact, Output, Stage};

/// Time before the next address is dialled beside those that have not answered: long for a network of a machine, and with the first wait
/// before a dial short enough that no requirement is lost over it (50 ms). RFC 8305 has no less than 10 ms.
pub(super) const STAGGER: Duration = Duration::from_millis(20);

/// The same where so many say nothing that a further one hardly will: the last one of as many as a node can announce (23, NDL-3.5) is dialled
/// 0.9 s after the first, before the time is over in which a link may be made again (NDL-4.3).
pub(super) const LATER: Duration = Duration::from_millis(50);
pub(super) const SILENT: usize = 8;

/// A dial on its way.
#[derive(Debug)]
pub(super) struct Dial {
    /// Connections that are being made, or the one that has been.
    attempts: Vec<(ConnectionId, SocketAddr)>,
    /// Addresses that were not dialled yet, the next one first.
    untried: VecDeque<SocketAddr>,
    /// When the next one is dialled, if nobody answers before; [`Time::MAX`] if there is none.
    pub(super) next_at: Time,
    /// At each address so far the peer's host has said that nobody listens there.
    is_refused: bool,
}

impl Dial {
    /// To these addresses, beginning with the one at `first`.
    fn to(addresses: &[SocketAddr], first: usize) -> Self {
        let mut untried: VecDeque<_> = addresses.iter().copied().collect();
        untried.rotate_left(first % addresses.len().max(1));
        Self { attempts: Vec::new(), untried, next_at: Time::MAX, is_refused: true }
    }

    /// The address at which this connection was made.
    pub(super) fn address_of(&self, connection: ConnectionId) -> Option<SocketAddr> {
        self.attempts.iter().find(|(attempt, _)| *attempt == connection).map(|(_, address)| *address)
    }

    pub(super) fn connections(&self) -> impl Iterator<Item = ConnectionId> {
        self.attempts.iter().map(|(connection, _)| *connection)
    }
}

impl Core {
    /// Dials a peer that has neither a link nor a dial on its way.
    pub(super) fn dial(&mut self, now: Time, node: NodeAddress) {
        let Some(peer) = self.peers.get_mut(&node) else { return };
        let Some(addresses) = &peer.wanted else { return };
        debug_assert!(peer.link.is_none() && peer.dial.is_none(), "one connection to a peer is enough");
        peer.dial = Some(Dial::to(addresses, peer.first));
        peer.redial_at = None;
        self.attempt(now, node);
    }

    /// Dials the next address, beside those before it.
    pub(super) fn attempt(&mut self, now: Time, node: NodeAddress) {
        let connection = self.open();
        let Some(dial) = self.peers.get_mut(&node).and_then(|peer| peer.dial.as_mut()) else { return };
        let Some(address) = dial.untried.pop_front() else { return };
        dial.attempts.push((connection, address));
        let stagger = if dial.attempts.len() < SILENT { STAGGER } else { LATER };
        dial.next_at = if dial.untried.is_empty() { Time::MAX } else { now + stagger };
        self.stage_for_handshake(now, connection, Stage::Dialling(node, Lane::Control));
        self.outputs.push_back(Output::Dial { connection, address });
    }

    /// An address was reached: the others are not needed.
    pub(super) fn reached(&mut self, node: NodeAddress, connection: ConnectionId) {
        let Some(dial) = self.peers.get_mut(&node).and_then(|peer| peer.dial.as_mut()) else { return };
        dial.untried.clear();
        dial.next_at = Time::MAX;
        let others: Vec<_> = dial.connections().filter(|other| *other != connection).collect();
        dial.attempts.retain(|(attempt, _)| *attempt == connection);
        self.give_up(others);
    }

    /// An address was not reached: the next one is dialled at once. With the last one the dial is over.
    pub(super) fn attempt_over(&mut self, now: Time, node: NodeAddress, failed: ConnectionId, refused: bool) {
        let Some(peer) = self.peers.get_mut(&node) else { return };
        let incarnation = peer.incarnation;
        let Some(dial) = peer.dial.as_mut() else { return };
        dial.attempts.retain(|(attempt, _)| *attempt != failed);
        dial.is_refused &= refused;
        if !dial.untried.is_empty() {
            return self.attempt(now, node);
        }
        if dial.attempts.is_empty() {
            if dial.is_refused {
                self.fact(LinkFact::DialRefused { node, incarnation });
            }
            self.dial_over(now, node);
        }
    }

    /// Whoever was reached has not become a link: the next dial begins with another address.
    pub(super) fn handshake_failed(&mut self, now: Time, node: NodeAddress) {
        if let Some(peer) = self.peers.get_mut(&node) {
            peer.first = peer.first.wrapping_add(1);
        }
        self.dial_over(now, node);
    }

    /// Whom a dial that is on its way is to reach, and where.
    pub(in crate::gncl) fn dialled(&self, connection: ConnectionId) -> Option<(NodeAddress, SocketAddr)> {
        let dials = self.peers.iter().filter_map(|(node, peer)| Some((*node, peer.dial.as_ref()?)));
        dials.into_iter().find_map(|(node, dial)| Some((node, dial.address_of(connection)?)))
    }

    /// Whose connection is dialled there.
    pub(in crate::gncl) fn node_dialled(&self, connection: ConnectionId) -> Option<NodeAddress> {
        match self.connections.get(&connection)?.stage {
            Stage::Dialling(node, _) => Some(node),
            Stage::HelloSent(..) | Stage::Linked(..) | Stage::Stranger | Stage::Leaving => None,
        }
    }

    fn dial_over(&mut self, now: Time, node: NodeAddress) {
        let chance = self.chance();
        if let Some(peer) = self.peers.get_mut(&node) {
            peer.dial = None;
            peer.plan(now, &self.settings, chance);
        }
    }

    /// Gives up our dial to `node`, if there is one.
    pub(super) fn drop_dial(&mut self, node: NodeAddress) {
        let dial = self.peers.get_mut(&node).and_then(|peer| peer.dial.take());
        let connections = dial.iter().flat_map(Dial::connections).collect();
        self.give_up(connections);
    }

    fn give_up(&mut self, connections: Vec<ConnectionId>) {
        for connection in connections {
            self.connections.remove(&connection);
            self.outputs.push_back(Output::Close(connection));
        }
    }
}
