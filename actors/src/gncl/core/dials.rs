//! A dial of ours to a peer: all addresses that it announced, one shortly after the other, until one is reached. spec: GNCL-16

use std::{
    collections::VecDeque,
    net::{IpAddr, SocketAddr},
    time::Duration,
};

use sinew_runtime::{tid::NodeAddress, time::Time};

use super::{ConnectionId, Core, Lane, LinkFact, Output, Stage};

/// Time before the next address is dialled beside those that have not answered: long for a network of a machine, and with the first wait
/// before a dial short enough that no requirement is lost over it (50 ms). RFC 8305 has no less than 10 ms.
pub(super) const STAGGER: Duration = Duration::from_millis(20);

/// Addresses of a peer that are dialled at once, at most; a further one when one of them has failed.
pub(super) const AT_ONCE_MAX: usize = 8;

/// A dial on its way.
#[derive(Debug)]
pub(super) struct Dial {
    /// Connections that are being made, or the one that has been.
    attempts: Vec<(ConnectionId, SocketAddr)>,
    /// Addresses that were not dialled yet, the next one first.
    untried: VecDeque<SocketAddr>,
    /// When the next one is dialled, if nobody answers before, or behind the last one what the others have not answered is told;
    /// [`Time::MAX`] if neither.
    pub(super) next_at: Time,
    /// Where the peer's host has said that nobody listens.
    refused: Vec<SocketAddr>,
    /// It said so at each address so far.
    is_refused: bool,
}

/// Where one life of a peer was linked, since this instance of the layer knows it.
#[derive(Debug, Default)]
pub(super) struct Reached(Vec<SocketAddr>);

/// Where more were reached, nothing is concluded from them.
const REACHED_MAX: usize = 32;

impl Reached {
    /// Our dial led to it at this address.
    pub(super) fn dialled(&mut self, at: SocketAddr) {
        if self.0.len() < REACHED_MAX && !self.0.contains(&at) {
            self.0.push(at);
        }
    }

    /// Its own dial came from there; where it listens there it did not say.
    pub(super) fn came_from(&mut self, ip: IpAddr) {
        self.dialled((ip, 0).into());
    }

    /// Whether it was linked, and nowhere else than where its host refuses now. One that came from a link-local address may have done so on
    /// any link.
    fn is_refused(&self, refused: &[SocketAddr]) -> bool {
        let is_refused = |at: &SocketAddr| {
            let came_from = |by: &SocketAddr| at.port() == 0 && by.ip() == at.ip() && !is_link_local(at.ip());
            refused.iter().any(|by| by == at || came_from(by))
        };
        !self.0.is_empty() && self.0.len() < REACHED_MAX && self.0.iter().all(is_refused)
    }
}

const fn is_link_local(ip: IpAddr) -> bool {
    match ip {
        IpAddr::V4(_) => false,
        IpAddr::V6(ip) => ip.is_unicast_link_local(),
    }
}

impl Dial {
    /// To these addresses, beginning with the one at `first`.
    fn to(addresses: &[SocketAddr], first: usize) -> Self {
        let mut untried: VecDeque<_> = addresses.iter().copied().collect();
        untried.rotate_left(first % addresses.len().max(1));
        Self { attempts: Vec::new(), untried, next_at: Time::MAX, refused: Vec::new(), is_refused: true }
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
        let Some(address) = dial.untried.pop_front() else {
            dial.next_at = Time::MAX;
            return self.tell_who_refused(node);
        };
        dial.attempts.push((connection, address));
        let is_full = !dial.untried.is_empty() && dial.attempts.len() >= AT_ONCE_MAX;
        let is_alone = dial.untried.is_empty() && dial.attempts.len() == 1 && dial.refused.is_empty();
        dial.next_at = if is_full || is_alone { Time::MAX } else { now + STAGGER };
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
        dial.refused.extend(dial.address_of(failed).filter(|_| refused));
        dial.attempts.retain(|(attempt, _)| *attempt != failed);
        dial.is_refused &= refused;
        if !dial.untried.is_empty() {
            return self.attempt(now, node);
        }
        let is_over = dial.attempts.is_empty();
        if is_over && dial.is_refused {
            self.fact(LinkFact::DialRefused { node, incarnation });
        } else if is_over || dial.next_at == Time::MAX {
            self.tell_who_refused(node);
        }
        if is_over {
            self.dial_over(now, node);
        }
    }

    /// All addresses were dialled, and had their time: where the host refuses wherever this life of the peer was ever linked, what is said
    /// elsewhere, or is not said because packets are thrown away there, is no reason to wait. Whether it is lost by that says NDL, which
    /// knows where else it is heard. spec: GNCL-16
    fn tell_who_refused(&mut self, node: NodeAddress) {
        let Some(peer) = self.peers.get(&node) else { return };
        let Some(dial) = &peer.dial else { return };
        if peer.reached.is_refused(&dial.refused) {
            let (incarnation, at) = (peer.incarnation, dial.refused.clone());
            self.outputs.push_back(Output::RefusedWhereLinked { node, incarnation, at });
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
