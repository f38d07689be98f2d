//! The connections for Stream and for Bulk beside a link: the node that dialled the link dials them, and they
//! end with it.
//!
//! ```text
//!  dialler    Down ── link ──► Dialling ── WELCOME ──► Up ── ended ──► Redial ── time ──► Dialling
//!  acceptor   Down ── HELLO of this link ──► Up ── ended ──► Down
//! ```

use std::time::Duration;

use sinew_runtime::{tid::NodeAddress, time::Time};

use super::{
    Attach, CANCEL, Connection, ConnectionId, Core, DATAGRAMS, GUARD, Introduction, Lane, OUTCOME_RUNS,
    OUTCOMES, Output, RefusalError, Settings, Stage, UNDELIVERED,
    handshake::check,
    peer_state::{Keepalive, Link},
};

/// The state of one class's connection beside the first one.
#[derive(Clone, Copy, Debug)]
pub(super) struct LaneConnection {
    state: LaneState,
    /// The peer's dials for it up to this number are void.
    void_dial: u64,
    /// Delay before the next dial.
    back_off: Duration,
    /// Whether the peer has sent GOODBYE on it, so that all its messages have arrived.
    is_drained: bool,
}

#[derive(Clone, Copy, Debug)]
enum LaneState {
    Down,
    Redial(Time),
    /// A local dial or its HELLO is in progress.
    Dialling(ConnectionId),
    Up(ConnectionId, Keepalive),
}

impl LaneConnection {
    pub(super) const fn new(redial_min: Duration) -> Self {
        Self { state: LaneState::Down, void_dial: 0, back_off: redial_min, is_drained: false }
    }

    pub(super) const fn keepalive(&mut self) -> Option<&mut Keepalive> {
        match &mut self.state {
            LaneState::Up(_, keepalive) => Some(keepalive),
            LaneState::Down | LaneState::Redial(_) | LaneState::Dialling(_) => None,
        }
    }

    pub(super) fn next_wake(&self, settings: &Settings) -> Option<Time> {
        match self.state {
            LaneState::Redial(at) => Some(at),
            LaneState::Up(_, keepalive) => Some(keepalive.ping_at(settings)),
            LaneState::Down | LaneState::Dialling(_) => None,
        }
    }
}

impl Link {
    fn lane_connection(&mut self, lane: Lane) -> Option<&mut LaneConnection> {
        let [stream, bulk] = self.lane_connections.as_mut()?;
        match lane {
            Lane::Control => None,
            Lane::Stream => Some(stream),
            Lane::Bulk => Some(bulk),
        }
    }

    pub(super) fn keepalive_of(&mut self, lane: Lane) -> Option<&mut Keepalive> {
        match lane {
            Lane::Control => Some(&mut self.keepalive),
            Lane::Stream | Lane::Bulk => self.lane_connection(lane)?.keepalive(),
        }
    }

    pub(super) fn connection_of(&mut self, lane: Lane) -> Option<ConnectionId> {
        match (lane, self.lane_connection(lane).map(|lane_connection| lane_connection.state)) {
            (Lane::Control, _) => Some(self.connection),
            (Lane::Stream | Lane::Bulk, Some(LaneState::Up(connection, _))) => Some(connection),
            (Lane::Stream | Lane::Bulk, _) => None,
        }
    }

    /// Resets the back-off, because messages are exchanged on the connection for `lane`.
    pub(super) fn lane_traffic_seen(&mut self, lane: Lane, redial_min: Duration) {
        if let Some(lane_connection) = self.lane_connection(lane) {
            lane_connection.back_off = redial_min;
        }
    }

    /// Whether messages of a peer that has sent GOODBYE may still arrive on another connection.
    pub(super) fn expects_more(&self) -> bool {
        self.lane_connections.iter().flatten().any(|lane_connection| match lane_connection.state {
            LaneState::Up(..) | LaneState::Dialling(_) | LaneState::Redial(_) => true,
            // The peer may be about to dial it; otherwise it closes the link.
            LaneState::Down => self.dialled.is_none() && !lane_connection.is_drained,
        })
    }
}

impl Core {
    /// Whether a peer may dial a connection for Stream or for Bulk that is missing or breaks. The peer may
    /// detect that earlier than the local node.
    pub fn expects_lane_connections(&self) -> bool {
        let accepted = self.peers.values().filter_map(|peer| peer.link).filter(|link| link.dialled.is_none());
        accepted
            .filter_map(|link| link.lane_connections)
            .flatten()
            .any(|lane_connection| !lane_connection.is_drained)
    }

    /// Dials the further connections of an established link, if the local node dialled it.
    pub(super) fn dial_lanes(&mut self, now: Time, node: NodeAddress) {
        for lane in Lane::SECONDARY {
            self.dial_lane(now, node, lane);
        }
    }

    fn dial_lane(&mut self, now: Time, node: NodeAddress, lane: Lane) {
        let connection = self.open();
        let Some(link) = self.peers.get_mut(&node).and_then(|peer| peer.link.as_mut()) else { return };
        let (Some(address), Some(lane_connection)) = (link.dialled, link.lane_connection(lane)) else {
            return;
        };
        lane_connection.state = LaneState::Dialling(connection);
        self.stage_for_handshake(now, connection, Stage::Dialling(node, lane));
        self.outputs.push_back(Output::Dial { connection, address });
    }

    pub(super) fn redial_lane(&mut self, now: Time, node: NodeAddress, lane: Lane) {
        let lane_connection =
            self.peers.get_mut(&node).and_then(|peer| peer.link.as_mut()?.lane_connection(lane));
        if let Some(LaneState::Redial(at)) = lane_connection.map(|lane_connection| lane_connection.state)
            && at <= now
        {
            self.dial_lane(now, node, lane);
        }
    }

    pub(super) fn lane_hello(&mut self, now: Time, connection: ConnectionId, hello: &Introduction) {
        if let Err(decline) = self.check_lane_hello(hello) {
            return self.decline(now, connection, &decline);
        }
        let (node, lane) = (hello.node, hello.lane);
        // The peer would not dial if it still had the former connection. spec: GNCL-5
        self.drop_lane(node, lane);
        let ours = &self.settings.ours;
        let welcome = Introduction { peer: node, dial: 0, lane, link: hello.link, ..ours.clone() };
        let Some(link) = self.peers.get_mut(&node).and_then(|peer| peer.link.as_mut()) else { return };
        if let Some(lane_connection) = link.lane_connection(lane) {
            lane_connection.void_dial = hello.dial;
        }
        self.lane_up(now, connection, hello, Some(welcome));
    }

    /// Whether the peer may have this connection: it belongs to the link that the peer dialled. spec: GNCL-14
    fn check_lane_hello(&mut self, hello: &Introduction) -> Result<(), RefusalError> {
        check(hello, &self.settings.ours)?;
        let peer = self.peers.get_mut(&hello.node).filter(|peer| peer.incarnation == hello.incarnation);
        let link = peer.and_then(|peer| peer.link.as_mut());
        let link = link.filter(|link| link.dialled.is_none() && link.dial == hello.link);
        let lane_connection = link.and_then(|link| link.lane_connection(hello.lane));
        if lane_connection.is_some_and(|lane_connection| hello.dial > lane_connection.void_dial) {
            Ok(())
        } else {
            Err(RefusalError::Duplicate)
        }
    }

    pub(super) fn lane_welcome(
        &mut self,
        now: Time,
        connection: ConnectionId,
        (node, lane): (NodeAddress, Lane),
        welcome: &Introduction,
    ) {
        let link = self.peers.get(&node).and_then(|peer| Some((peer.incarnation, peer.link?.dial)));
        let judged = check(welcome, &self.settings.ours).and_then(|()| {
            let is_ours = welcome.node == node && welcome.lane == lane;
            if is_ours && link == Some((welcome.incarnation, welcome.link)) {
                Ok(())
            } else {
                Err(RefusalError::Violation("a WELCOME for another connection came".to_owned()))
            }
        });
        match judged {
            Ok(()) => self.lane_up(now, connection, welcome, None),
            Err(decline) => self.decline(now, connection, &decline),
        }
    }

    fn lane_up(
        &mut self,
        now: Time,
        connection: ConnectionId,
        theirs: &Introduction,
        welcome: Option<Introduction>,
    ) {
        let (node, lane) = (theirs.node, theirs.lane);
        let Some(peer) = self.peers.get_mut(&node) else { return };
        let incarnation = peer.incarnation;
        let Some(lane_connection) = peer.link.as_mut().and_then(|link| link.lane_connection(lane)) else {
            return;
        };
        lane_connection.state = LaneState::Up(connection, Keepalive::new(now));
        let stage = Stage::Linked(node, lane);
        self.connections.insert(connection, Connection { stage, from: None, deadline: Time::MAX });
        self.outputs.push_back(Output::Attach(Attach {
            connection,
            node,
            incarnation,
            lane,
            by_class: true,
            takes_cancels: theirs.supports(CANCEL),
            takes_outcomes: theirs.supports(OUTCOMES),
            takes_outcome_runs: theirs.supports(OUTCOME_RUNS),
            takes_reports: theirs.supports(UNDELIVERED),
            takes_datagrams: theirs.supports(DATAGRAMS) && self.settings.ours.supports(DATAGRAMS),
            is_guarded: theirs.supports(GUARD) && self.settings.ours.supports(GUARD),
            payload_max: theirs.payload_max,
            answers_max: theirs.answers_max,
            welcome,
        }));
    }

    /// Handles the end or the failure of the connection for `lane`, and plans the next dial, if it is local.
    pub(super) fn lane_down(&mut self, now: Time, node: NodeAddress, lane: Lane) {
        let (chance, redial_max) = (self.chance(), self.settings.redial_max);
        let Some(link) = self.peers.get_mut(&node).and_then(|peer| peer.link.as_mut()) else { return };
        // This includes a leaving peer: its kept messages for this connection arrive on the next one. spec: GNCL-10
        let is_dialled = link.dialled.is_some();
        if let Some(lane_connection) = link.lane_connection(lane) {
            // spec: GNCL-8
            lane_connection.state = if is_dialled && !lane_connection.is_drained {
                LaneState::Redial(now + lane_connection.back_off.mul_f64(0.8 + 0.4 * chance))
            } else {
                LaneState::Down
            };
            lane_connection.back_off = (lane_connection.back_off * 2).min(redial_max);
        }
        self.finish_departure(now, node);
    }

    /// Records that the peer has no more messages for this connection. spec: GNCL-10
    pub(super) fn lane_goodbye(
        &mut self,
        now: Time,
        connection: ConnectionId,
        (node, lane): (NodeAddress, Lane),
    ) {
        let link = self.peers.get_mut(&node).and_then(|peer| peer.link.as_mut());
        if let Some(lane_connection) = link.and_then(|link| link.lane_connection(lane)) {
            lane_connection.is_drained = true;
        }
        self.ended(now, connection);
        self.outputs.push_back(Output::Close(connection));
    }

    /// Ends the connections for Stream and for Bulk, and the dials for them.
    pub(super) fn drop_lanes(&mut self, node: NodeAddress) {
        for lane in Lane::SECONDARY {
            self.drop_lane(node, lane);
        }
        if let Some(link) = self.peers.get_mut(&node).and_then(|peer| peer.link.as_mut()) {
            link.lane_connections = None;
        }
    }

    fn drop_lane(&mut self, node: NodeAddress, lane: Lane) {
        let link = self.peers.get_mut(&node).and_then(|peer| peer.link.as_mut());
        let Some(lane_connection) = link.and_then(|link| link.lane_connection(lane)) else { return };
        match std::mem::replace(&mut lane_connection.state, LaneState::Down) {
            LaneState::Down | LaneState::Redial(_) => {}
            LaneState::Dialling(connection) => {
                self.connections.remove(&connection);
                self.outputs.push_back(Output::Close(connection));
            }
            LaneState::Up(connection, _) => {
                self.connections.remove(&connection);
                self.outputs.push_back(Output::Detach { connection, node, lane });
                self.outputs.push_back(Output::Close(connection));
            }
        }
    }
}
