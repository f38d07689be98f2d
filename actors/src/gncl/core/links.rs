//! What happens to peers and their links.

use std::net::SocketAddr;

use sinew_runtime::{
    tid::{Incarnation, NodeAddress},
    time::Time,
};

use super::{
    ConnectionId, Core, Lane, LinkFact, Output, Stage,
    acquaintance::{Acquaintance, Lost},
};

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
        // A life that only said hello is no proof: another process may use the node's address. spec: GNCL-7
        if self.peers.get(&node).is_some_and(|peer| peer.bars_finding(incarnation, &self.settings)) {
            self.count("stale incarnation", format!("NDL found node {node} in a life that is over"));
            return;
        }
        if self.peers.get(&node).is_some_and(|peer| peer.disproves(incarnation, &self.settings)) {
            self.count(
                "life not proven",
                format!("NDL found node {node} in another life than the one that is linked"),
            );
            return;
        }
        if self.peers.get(&node).is_some_and(|peer| peer.incarnation != incarnation) {
            // It went to another life.
            self.drop_dial(node);
        }
        self.meet(now, node, incarnation);
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
        peer.wanted = Some(addresses);
        if peer.link.is_none() && peer.dial.is_none() {
            // spec: GNCL-1
            self.dial(now, node);
        }
    }

    /// NDL lost this life: whoever was told of that gets nothing of it until NDL finds it again, whatever it dials. spec: GNCL-7
    pub(super) fn lost(&mut self, now: Time, node: NodeAddress, incarnation: Incarnation) {
        self.over(now, node, incarnation);
        if !self.peers.contains_key(&node) && self.peers.len() < self.settings.peers_max {
            let mut lost = Acquaintance::new(now, incarnation, &self.settings);
            // As a former instance of this layer may have linked it.
            lost.was_linked = true;
            self.peers.insert(node, lost);
        }
        if let Some(peer) = self.peers.get_mut(&node)
            && incarnation >= peer.incarnation
            && !peer.disproves(incarnation, &self.settings)
        {
            peer.lost = Some(Lost { incarnation, at: now });
        }
    }

    /// This life of `node` is over: all that there is with it ends.
    fn over(&mut self, now: Time, node: NodeAddress, incarnation: Incarnation) {
        let Some(peer) = self.peers.get_mut(&node) else { return };
        if incarnation < peer.incarnation || peer.disproves(incarnation, &self.settings) {
            // The news is about a life that is over anyway, or never was.
            return;
        }
        peer.wanted = None;
        self.forget(now, node);
    }

    /// What was known of `node` was about another process than the one that has its address. spec: GNCL-7
    pub(super) fn disowned(&mut self, now: Time, node: NodeAddress, incarnation: Incarnation) {
        self.over(now, node, incarnation);
        if self.peers.get(&node).is_some_and(Acquaintance::is_idle) {
            self.peers.remove(&node);
        }
    }

    /// This life has not proven who it is, as is known by now, whether its link stands or not: it bars no other, or a thief could keep the
    /// node itself out by what it says in datagrams. Told again it begins no new time. spec: GNCL-7
    pub(super) fn disproven(&mut self, now: Time, node: NodeAddress, incarnation: Incarnation) {
        if let Some(peer) = self.peers.get_mut(&node)
            && peer.incarnation == incarnation
            && peer.was_linked
        {
            (peer.met, peer.was_linked) = (now, false);
        }
    }

    /// A link outlives the word of its node that it leaves: GOODBYE, or its break, ends it. spec: GNCL-10
    pub(super) fn leaves(&mut self, now: Time, node: NodeAddress, incarnation: Incarnation) {
        match self.peers.get_mut(&node) {
            Some(peer) if peer.link.is_some() && peer.incarnation == incarnation => peer.wanted = None,
            // It may dial for what it has for us still.
            Some(_) | None => self.over(now, node, incarnation),
        }
    }

    /// A former instance of this layer had this peer: it has some time to come back.
    pub(super) fn restored(&mut self, now: Time, node: NodeAddress, incarnation: Incarnation) {
        self.meet(now, node, incarnation);
        let chance = self.chance();
        if let Some(peer) = self.peers.get_mut(&node) {
            // That instance had a link with it: what is restored is what was left of one.
            peer.was_linked = true;
            // Where a link or a dial of this instance's is there already, what follows from its end plans.
            if peer.link.is_none() && peer.dial.is_none() {
                peer.plan(now, &self.settings, chance);
            }
        }
    }

    /// Makes sure that `node` is known in the life `incarnation`; what belongs to an older one ends. spec: GNCL-7
    ///
    /// Does nothing if the table is full.
    pub(super) fn meet(&mut self, now: Time, node: NodeAddress, incarnation: Incarnation) {
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
            (peer.met, peer.was_linked) = (now, false);
            if peer.is_lost(incarnation) {
                // What was lost was never linked, and is no bar to a life that is there.
                peer.lost = None;
            }
            peer.void_dial = 0;
            peer.back_off = self.settings.redial_min;
        } else if self.peers.len() < self.settings.peers_max {
            self.peers.insert(node, Acquaintance::new(now, incarnation, &self.settings));
        }
    }

    /// A full table gives up somebody of whom only a past life is known: of those that NDL lost the one that was lost first, and that after
    /// all others.
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

    pub(super) fn heard(&mut self, at: Time, connection: ConnectionId) {
        let Some((node, lane)) = self.linked(connection) else { return };
        let Some(link) = self.peers.get_mut(&node).and_then(|peer| peer.link.as_mut()) else { return };
        if let Some(pulse) = link.pulse_of(lane) {
            pulse.heard(at);
        }
    }

    /// The peer lives, as far as this connection tells: it has said PING or PONG.
    pub(super) fn lives(&mut self, now: Time, connection: ConnectionId) {
        let Some((node, lane)) = self.linked(connection) else { return };
        let Some(link) = self.peers.get_mut(&node).and_then(|peer| peer.link.as_mut()) else { return };
        if let Some(pulse) = link.pulse_of(lane) {
            match lane {
                // Whoever asks whether the peer lives asks here.
                Lane::Control => pulse.heard(now),
                Lane::Stream | Lane::Bulk => pulse.lives(now, &self.settings),
            }
        }
    }

    /// A peer with which messages pass is dialled again soon, however short its links are. spec: GNCL-8
    pub(super) fn carried(&mut self, connection: ConnectionId) {
        let Some((node, lane)) = self.linked(connection) else { return };
        let Some(peer) = self.peers.get_mut(&node) else { return };
        peer.back_off = self.settings.redial_min;
        if let Some(link) = &mut peer.link {
            link.side_carried(lane, self.settings.redial_min);
        }
    }

    /// spec: GNCL-10
    pub(super) fn goodbye(&mut self, now: Time, connection: ConnectionId) {
        let Some((node, lane)) = self.linked(connection) else { return };
        let Some(peer) = self.peers.get_mut(&node) else { return };
        peer.wanted = None;
        if lane != Lane::Control {
            return self.side_goodbye(now, connection, (node, lane));
        }
        if let Some(link) = &mut peer.link {
            link.has_left = true;
        }
        self.farewell(now, node);
    }

    /// A node that has said goodbye is gone when all its connections are through.
    pub(super) fn farewell(&mut self, now: Time, node: NodeAddress) {
        let Some(peer) = self.peers.get(&node) else { return };
        if peer.link.is_some_and(|link| link.has_left && !link.expects_more()) {
            let incarnation = peer.incarnation;
            self.fact(LinkFact::PeerLeft { node, incarnation, gave_up: None });
            self.forget(now, node);
        }
    }

    /// Ends all that there is with `node`; its incarnation stays known, so that no older one comes back.
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

    /// The link to `node` is over because its connection is; plans the next one.
    pub(super) fn link_over(&mut self, now: Time, node: NodeAddress) {
        if self.peers.get(&node).and_then(|peer| peer.link).is_some_and(|link| link.has_left) {
            self.drop_sides(node);
            return self.farewell(now, node);
        }
        if self.leaving
            && let Some(link) = self.peers.get_mut(&node).and_then(|peer| peer.link.as_mut())
        {
            // What the peer says there last, that all was taken, may not have been read yet; it hangs up itself.
            link.sides = None;
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

    /// The peer's messages wait from now on. spec: GNCL-13
    fn detach(&mut self, now: Time, node: NodeAddress) -> Option<ConnectionId> {
        self.drop_sides(node);
        let peer = self.peers.get_mut(&node)?;
        let incarnation = peer.incarnation;
        let connection = peer.unlink(now, &self.settings)?.connection;
        self.outputs.push_back(Output::Detach { connection, node, lane: Lane::Control });
        self.fact(LinkFact::LinkBroken { node, incarnation });
        Some(connection)
    }

    /// Something about this peer is due.
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
            for lane in Lane::SIDES {
                self.redial_side(now, node, lane);
                self.ping_due(now, node, lane);
            }
        }
    }

    /// spec: GNCL-9
    fn ping_due(&mut self, now: Time, node: NodeAddress, lane: Lane) {
        let Some(link) = self.peers.get_mut(&node).and_then(|peer| peer.link.as_mut()) else { return };
        let Some(again) = link.pulse_of(lane).and_then(|pulse| pulse.ping(now, &self.settings)) else {
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
    pub(super) fn leave(&mut self, now: Time, owed: &[NodeAddress]) {
        self.leaving = true;
        let nodes: Vec<_> = self.peers.keys().copied().collect();
        for node in nodes {
            self.leave_peer(now, node, owed.contains(&node));
        }
        if self.expects_sides() {
            // One of those who have not said hello may be such a side.
            return;
        }
        let strangers = self.connections.iter().filter(|(_, c)| c.stage == Stage::Stranger);
        let strangers: Vec<_> = strangers.map(|(id, _)| *id).collect();
        for connection in strangers {
            self.decline(now, connection, &super::Decline::Leaving);
        }
    }

    fn leave_peer(&mut self, now: Time, node: NodeAddress, is_owed: bool) {
        let Some(peer) = self.peers.get_mut(&node) else { return };
        let may_link = is_owed && peer.link.is_none() && peer.wanted.is_some();
        if !may_link {
            peer.wanted = None;
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

    /// Whether a link may still be made with a node for which messages wait, while ours is being stopped.
    pub(in crate::gncl) fn may_still_link(&self) -> bool {
        self.peers.values().any(|peer| peer.dial.is_some() || peer.redial_at.is_some())
    }
}
