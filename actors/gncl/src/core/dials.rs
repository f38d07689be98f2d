//! A local dial to a peer: its announced addresses are dialled with short delays, until one is reached. spec: GNCL-16

use std::{collections::VecDeque, net::SocketAddr, time::Duration};

use sinew_model::facts::LinkFact;
use sinew_runtime::{tid::NodeAddress, time::Time};

use super::{ConnectionId, Core, Lane, Output, Stage};

/// Delay before the next address is dialled in parallel with unanswered ones. It is long for a machine's
/// network. With the first delay before a dial, it is still short enough to keep every requirement (50 ms).
/// RFC 8305 has a minimum of 10 ms.
pub(super) const STAGGER: Duration = Duration::from_millis(20);

/// The longer delay after [`SILENT`] unanswered addresses, when a further one hardly will answer. The last of
/// the 23 addresses that a node can announce (NDL-3.5) is dialled 0.9 s after the first. This is within the
/// time in which a link may be established again (NDL-4.3).
pub(super) const LATER: Duration = Duration::from_millis(50);
pub(super) const SILENT: usize = 8;

/// A dial in progress.
#[derive(Debug)]
pub(super) struct Dial {
    /// Connections in progress, or the one that was established.
    attempts: Vec<(ConnectionId, SocketAddr)>,
    /// Addresses not dialled yet, the next one first.
    untried: VecDeque<SocketAddr>,
    /// Time of the next dial if there is no answer before; [`Time::MAX`] if there is none.
    pub(super) next_at: Time,
    /// Whether the peer's host has refused the connection at each address so far.
    is_refused: bool,
}

impl Dial {
    /// Creates a dial to these addresses, beginning with the one at `first`.
    fn to(addresses: &[SocketAddr], first: usize) -> Self {
        let mut untried: VecDeque<_> = addresses.iter().copied().collect();
        untried.rotate_left(first % addresses.len().max(1));
        Self { attempts: Vec::new(), untried, next_at: Time::MAX, is_refused: true }
    }

    /// Returns the address of this connection.
    pub(super) fn address_of(&self, connection: ConnectionId) -> Option<SocketAddr> {
        self.attempts.iter().find(|(attempt, _)| *attempt == connection).map(|(_, address)| *address)
    }

    pub(super) fn connections(&self) -> impl Iterator<Item = ConnectionId> {
        self.attempts.iter().map(|(connection, _)| *connection)
    }
}

impl Core {
    /// Dials a peer that has neither a link nor a dial in progress.
    pub(super) fn dial(&mut self, now: Time, node: NodeAddress) {
        let Some(peer) = self.peers.get_mut(&node) else { return };
        let Some(addresses) = &peer.dial_addresses else { return };
        debug_assert!(peer.link.is_none() && peer.dial.is_none(), "one connection to a peer is enough");
        peer.dial = Some(Dial::to(addresses, peer.first));
        peer.redial_at = None;
        self.attempt(now, node);
    }

    /// Dials the next address, in parallel with those before it.
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

    /// Records that an address was reached: the other attempts are dropped.
    pub(super) fn reached(&mut self, node: NodeAddress, connection: ConnectionId) {
        let Some(dial) = self.peers.get_mut(&node).and_then(|peer| peer.dial.as_mut()) else { return };
        dial.untried.clear();
        dial.next_at = Time::MAX;
        let others: Vec<_> = dial.connections().filter(|other| *other != connection).collect();
        dial.attempts.retain(|(attempt, _)| *attempt == connection);
        self.give_up(others);
    }

    /// Records that an address was not reached: the next one is dialled at once. The dial ends with the last one.
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

    /// Records that a reached peer did not become a link: the next dial begins with another address.
    pub(super) fn handshake_failed(&mut self, now: Time, node: NodeAddress) {
        if let Some(peer) = self.peers.get_mut(&node) {
            peer.first = peer.first.wrapping_add(1);
        }
        self.dial_over(now, node);
    }

    /// Returns the node and the address that a dial in progress is for.
    pub fn dialled(&self, connection: ConnectionId) -> Option<(NodeAddress, SocketAddr)> {
        let dials = self.peers.iter().filter_map(|(node, peer)| Some((*node, peer.dial.as_ref()?)));
        dials.into_iter().find_map(|(node, dial)| Some((node, dial.address_of(connection)?)))
    }

    /// Returns the node that the connection is being dialled to.
    pub fn node_dialled(&self, connection: ConnectionId) -> Option<NodeAddress> {
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
