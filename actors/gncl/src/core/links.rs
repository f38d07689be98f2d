//! Events of peers and their links.

use std::net::SocketAddr;

use sinew_model::facts::{LinkFact, LossReason};
use sinew_runtime::{
    tid::{Incarnation, NodeAddress},
    time::Time,
};

use super::{
    ConnectionId, Core, Input, Lane, Output, Stage,
    peer_state::{Lost, PeerState},
};

impl Input {
    /// Returns the input for the loss of a node, which NDL reports with this reason.
    pub const fn of_loss(why: &LossReason, node: NodeAddress, incarnation: Incarnation) -> Self {
        match why {
            LossReason::Left | LossReason::GaveUp(_) => Self::NodeLeaves { node, incarnation },
            LossReason::Duplicate => Self::NodeDisowned { node, incarnation },
            LossReason::Crashed | LossReason::Hung | LossReason::LinkDown | LossReason::Restarted => {
                Self::NodeLost { node, incarnation }
            }
        }
    }
}

impl Core {
    pub(super) fn found(
        &mut self,
        now: Time,
        node: NodeAddress,
        incarnation: Incarnation,
        addresses: Vec<SocketAddr>,
    ) {
        if self.leaving || node == self.settings.ours.node || !node.is_single() {
            return;
        }
        // An incarnation that only sent HELLO proves nothing: another process may use the node's address. spec: GNCL-7
        if self.peers.get(&node).is_some_and(|peer| peer.blocks_incarnation(incarnation, &self.settings)) {
            self.count("stale incarnation", format!("NDL found node {node} in a former incarnation"));
            return;
        }
        if self.peers.get(&node).is_some_and(|peer| peer.contradicts_link(incarnation, &self.settings)) {
            self.count(
                "unauthenticated incarnation",
                format!("NDL found node {node} in another incarnation than the connected one"),
            );
            return;
        }
        if self.peers.get(&node).is_some_and(|peer| peer.incarnation != incarnation) {
            // The dial was to another incarnation.
            self.drop_dial(node);
        }
        self.adopt_incarnation(now, node, incarnation);
        let Some(peer) = self.peers.get_mut(&node) else {
            let peers_max = self.settings.peers_max;
            self.count(
                "too many peers",
                format!("node {node} is not dialled; `ndl.nodes_max` is {peers_max}"),
            );
            return;
        };
        peer.orphan_at = None;
        peer.lost = None;
        peer.found = Some(incarnation);
        peer.dial_addresses = Some(addresses);
        if peer.link.is_none() && peer.dial.is_none() {
            // spec: GNCL-1
            self.dial(now, node);
        }
    }

    /// Handles the loss of this incarnation. After the report of its loss a node gets no messages until NDL
    /// finds it again, even if it dials. spec: GNCL-7
    pub(super) fn lost(&mut self, now: Time, node: NodeAddress, incarnation: Incarnation) {
        self.end_incarnation(now, node, incarnation);
        if !self.peers.contains_key(&node) && self.peers.len() < self.settings.peers_max {
            let mut lost = PeerState::new(now, incarnation, &self.settings);
            // A former instance of this layer may have linked it.
            lost.was_linked = true;
            self.peers.insert(node, lost);
        }
        if let Some(peer) = self.peers.get_mut(&node)
            && incarnation >= peer.incarnation
            && !peer.contradicts_link(incarnation, &self.settings)
        {
            peer.lost = Some(Lost { incarnation, at: now });
        }
    }

    /// Ends this incarnation of `node`, with its link and dials.
    fn end_incarnation(&mut self, now: Time, node: NodeAddress, incarnation: Incarnation) {
        let Some(peer) = self.peers.get_mut(&node) else { return };
        if incarnation < peer.incarnation || peer.contradicts_link(incarnation, &self.settings) {
            // The report is about an incarnation that has ended anyway, or never existed.
            return;
        }
        peer.dial_addresses = None;
        self.forget(now, node);
    }

    /// Removes the state of `node`, which belonged to another process than the present owner of its address.
    /// spec: GNCL-7
    pub(super) fn disowned(&mut self, now: Time, node: NodeAddress, incarnation: Incarnation) {
        self.end_incarnation(now, node, incarnation);
        if self.peers.get(&node).is_some_and(PeerState::is_idle) {
            self.peers.remove(&node);
        }
    }

    /// Marks an incarnation as not authenticated, with or without a link: it does not block another one.
    /// Otherwise a thief could exclude the node itself by its datagrams. Repeated calls do not restart the
    /// time. spec: GNCL-7
    pub(super) fn credentials_revoked(&mut self, now: Time, node: NodeAddress, incarnation: Incarnation) {
        if let Some(peer) = self.peers.get_mut(&node)
            && peer.incarnation == incarnation
            && peer.was_linked
        {
            (peer.known_since, peer.was_linked) = (now, false);
        }
    }

    /// Handles an announced departure. A link outlives it: only GOODBYE or a break ends the link. spec: GNCL-10
    pub(super) fn leaves(&mut self, now: Time, node: NodeAddress, incarnation: Incarnation) {
        match self.peers.get_mut(&node) {
            Some(peer) if peer.link.is_some() && peer.incarnation == incarnation => {
                peer.dial_addresses = None
            }
            // The peer may still dial to send its pending messages.
            Some(_) | None => self.end_incarnation(now, node, incarnation),
        }
    }

    /// Restores a peer of a former instance of this layer, with some time to reconnect.
    pub(super) fn restored(&mut self, now: Time, node: NodeAddress, incarnation: Incarnation) {
        self.adopt_incarnation(now, node, incarnation);
        let chance = self.chance();
        if let Some(peer) = self.peers.get_mut(&node) {
            // The former instance had a link with this peer: the restored state is the remainder of one.
            peer.was_linked = true;
            // If this instance already has a link or a dial, its end plans the next step.
            if peer.link.is_none() && peer.dial.is_none() {
                peer.plan(now, &self.settings, chance);
            }
        }
    }

    /// Ensures that `node` is known in the given `incarnation`, and ends the state of an older one. spec: GNCL-7
    ///
    /// Does nothing if the table is full.
    pub(super) fn adopt_incarnation(&mut self, now: Time, node: NodeAddress, incarnation: Incarnation) {
        if let Some(peer) = self.peers.get(&node) {
            if peer.incarnation == incarnation {
                return;
            }
            self.unlink(now, node);
            self.outputs.push_back(Output::Forget(node));
        } else {
            self.make_room();
        }
        if let Some(peer) = self.peers.get_mut(&node) {
            peer.incarnation = incarnation;
            (peer.known_since, peer.was_linked) = (now, false);
            if peer.is_lost(incarnation) {
                // The lost incarnation was never linked, and does not block a present one.
                peer.lost = None;
            }
            peer.void_dial = 0;
            peer.back_off = self.settings.redial_min;
        } else if self.peers.len() < self.settings.peers_max {
            self.peers.insert(node, PeerState::new(now, incarnation, &self.settings));
        }
    }

    /// Removes a peer without link or dial from a full table. Peers lost by NDL are removed after all others,
    /// the earliest loss first.
    fn make_room(&mut self) {
        if self.peers.len() < self.settings.peers_max {
            return;
        }
        let idle = self.peers.iter().filter(|(_, peer)| peer.is_idle());
        let idle = idle.min_by_key(|(_, peer)| peer.lost.map(|lost| lost.at)).map(|(node, _)| *node);
        if let Some(node) = idle {
            self.peers.remove(&node);
            self.outputs.push_back(Output::Forget(node));
        }
    }

    pub(super) fn frames_received(&mut self, at: Time, connection: ConnectionId) {
        let Some((node, lane)) = self.linked(connection) else { return };
        let Some(link) = self.peers.get_mut(&node).and_then(|peer| peer.link.as_mut()) else { return };
        if let Some(keepalive) = link.keepalive_of(lane) {
            keepalive.on_frame(at);
        }
    }

    /// Records that the peer is alive on this connection: it has sent PING or PONG.
    pub(super) fn liveness_received(&mut self, now: Time, connection: ConnectionId) {
        let Some((node, lane)) = self.linked(connection) else { return };
        let Some(link) = self.peers.get_mut(&node).and_then(|peer| peer.link.as_mut()) else { return };
        if let Some(keepalive) = link.keepalive_of(lane) {
            match lane {
                // A peer that checks liveness uses this connection.
                Lane::Control => keepalive.on_frame(now),
                Lane::Stream | Lane::Bulk => keepalive.on_liveness(now, &self.settings),
            }
        }
    }

    /// Resets the back-off: a peer that exchanges messages is dialled again soon, however short its links
    /// are. spec: GNCL-8
    pub(super) fn traffic_seen(&mut self, connection: ConnectionId) {
        let Some((node, lane)) = self.linked(connection) else { return };
        let Some(peer) = self.peers.get_mut(&node) else { return };
        peer.back_off = self.settings.redial_min;
        if let Some(link) = &mut peer.link {
            link.lane_traffic_seen(lane, self.settings.redial_min);
        }
    }

    /// spec: GNCL-10
    pub(super) fn goodbye(&mut self, now: Time, connection: ConnectionId) {
        let Some((node, lane)) = self.linked(connection) else { return };
        let Some(peer) = self.peers.get_mut(&node) else { return };
        peer.dial_addresses = None;
        if lane != Lane::Control {
            return self.lane_goodbye(now, connection, (node, lane));
        }
        if let Some(link) = &mut peer.link {
            link.has_left = true;
        }
        self.finish_departure(now, node);
    }

    /// Removes a node that has sent GOODBYE when all its connections are finished.
    pub(super) fn finish_departure(&mut self, now: Time, node: NodeAddress) {
        let Some(peer) = self.peers.get(&node) else { return };
        if peer.link.is_some_and(|link| link.has_left && !link.expects_more()) {
            let incarnation = peer.incarnation;
            self.fact(LinkFact::PeerLeft { node, incarnation, gave_up: None });
            self.forget(now, node);
        }
    }

    /// Ends the link and the dials of `node`. Its incarnation remains known, so that no older one can return.
    fn forget(&mut self, now: Time, node: NodeAddress) {
        self.drop_dial(node);
        self.unlink(now, node);
        if let Some(peer) = self.peers.get_mut(&node) {
            peer.redial_at = None;
            peer.orphan_at = None;
            peer.back_off = self.settings.redial_min;
        }
        self.outputs.push_back(Output::Forget(node));
    }

    /// Ends the link to `node` because its connection has ended, and plans the next one.
    pub(super) fn link_down(&mut self, now: Time, node: NodeAddress) {
        if self.peers.get(&node).and_then(|peer| peer.link).is_some_and(|link| link.has_left) {
            self.drop_lanes(node);
            return self.finish_departure(now, node);
        }
        if self.leaving
            && let Some(link) = self.peers.get_mut(&node).and_then(|peer| peer.link.as_mut())
        {
            // The peer's last frame, the acknowledgement of all messages, may not have been read yet. The
            // peer closes the connection itself.
            link.lane_connections = None;
        }
        let Some(connection) = self.detach(now, node) else { return };
        self.connections.remove(&connection);
        let chance = self.chance();
        if let Some(peer) = self.peers.get_mut(&node) {
            peer.plan(now, &self.settings, chance);
        }
    }

    /// Ends the link to `node`, if there is one, and closes its connection.
    pub(super) fn unlink(&mut self, now: Time, node: NodeAddress) {
        if let Some(connection) = self.detach(now, node) {
            self.connections.remove(&connection);
            self.outputs.push_back(Output::Close(connection));
        }
    }

    /// Detaches the connection; the peer's messages wait from now on. spec: GNCL-13
    fn detach(&mut self, now: Time, node: NodeAddress) -> Option<ConnectionId> {
        self.drop_lanes(node);
        let peer = self.peers.get_mut(&node)?;
        let incarnation = peer.incarnation;
        let connection = peer.unlink(now, &self.settings)?.connection;
        self.outputs.push_back(Output::Detach { connection, node, lane: Lane::Control });
        self.fact(LinkFact::LinkBroken { node, incarnation });
        Some(connection)
    }

    /// Handles a timer of this peer.
    pub(super) fn peer_due(&mut self, now: Time, node: NodeAddress) {
        let Some(peer) = self.peers.get_mut(&node) else { return };
        if peer.orphan_at.is_some_and(|at| at <= now) {
            self.forget(now, node);
        } else if peer.redial_at.is_some_and(|at| at <= now) {
            self.dial(now, node);
        } else if peer.dial.as_ref().is_some_and(|dial| dial.next_at <= now) {
            self.attempt(now, node);
        } else {
            self.ping_due(now, node, Lane::Control);
            for lane in Lane::SECONDARY {
                self.redial_lane(now, node, lane);
                self.ping_due(now, node, lane);
            }
        }
    }

    /// spec: GNCL-9
    fn ping_due(&mut self, now: Time, node: NodeAddress, lane: Lane) {
        let Some(link) = self.peers.get_mut(&node).and_then(|peer| peer.link.as_mut()) else { return };
        let Some(again) = link.keepalive_of(lane).and_then(|keepalive| keepalive.ping(now, &self.settings))
        else {
            return;
        };
        if again {
            self.outputs.push_back(Output::SendPing(node, lane));
            return;
        }
        let Some(connection) = link.connection_of(lane) else { return };
        self.count(
            "silent link",
            format!("node {node} answers no ping; its GNCL hangs or the way to it is cut"),
        );
        self.outputs.push_back(Output::Silent(node));
        self.ended(now, connection);
        self.outputs.push_back(Output::Close(connection));
    }

    /// spec: GNCL-10
    pub(super) fn leave(&mut self, now: Time, undelivered_to: &[NodeAddress]) {
        self.leaving = true;
        let nodes: Vec<_> = self.peers.keys().copied().collect();
        for node in nodes {
            self.leave_peer(now, node, undelivered_to.contains(&node));
        }
        if self.expects_lane_connections() {
            // A connection that has not sent HELLO may be one of these.
            return;
        }
        let strangers = self.connections.iter().filter(|(_, c)| c.stage == Stage::Stranger);
        let strangers: Vec<_> = strangers.map(|(id, _)| *id).collect();
        for connection in strangers {
            self.decline(now, connection, &super::RefusalError::Leaving);
        }
    }

    fn leave_peer(&mut self, now: Time, node: NodeAddress, has_undelivered: bool) {
        let Some(peer) = self.peers.get_mut(&node) else { return };
        let may_link = has_undelivered && peer.link.is_none() && peer.dial_addresses.is_some();
        if !may_link {
            peer.dial_addresses = None;
            peer.redial_at = None;
        }
        if peer.link.is_some() || may_link {
            self.outputs.push_back(Output::SendGoodbye(node));
        }
        if !may_link {
            self.drop_dial(node);
        } else if self.peers.get(&node).is_some_and(|peer| peer.dial.is_none()) {
            self.dial(now, node);
        }
    }

    /// Whether a link to a node with pending messages may still be established while the local node is being stopped.
    pub fn may_still_link(&self) -> bool {
        self.peers.values().any(|peer| peer.dial.is_some() || peer.redial_at.is_some())
    }
}
