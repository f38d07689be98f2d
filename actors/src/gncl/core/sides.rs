//! The connections for Stream and for Bulk beside a link: whoever dialled the link dials them, and they end with it.
//!
//! ```text
//!  dialler    Down ── link ──► Dialling ── WELCOME ──► Up ── ended ──► Redial ── time ──► Dialling
//!  acceptor   Down ── HELLO of this link ──► Up ── ended ──► Down
//! ```

use std::time::Duration;

use sinew_runtime::{tid::NodeAddress, time::Time};

use super::{
    Attach, CANCEL, Connection, ConnectionId, Core, DATAGRAMS, Decline, GUARD, Introduction, Lane, OUTCOMES,
    Output, Settings, Stage, UNDELIVERED,
    acquaintance::{Link, Pulse},
    handshake::check,
};

/// What there is for one class beside the first connection.
#[derive(Clone, Copy, Debug)]
pub(super) struct Side {
    state: SideState,
    /// The peer's dials for it up to this number are void.
    void_dial: u64,
    /// The wait before the next dial.
    back_off: Duration,
    /// The peer has said goodbye on it: all that it had for it has come.
    is_through: bool,
}

#[derive(Clone, Copy, Debug)]
enum SideState {
    Down,
    Redial(Time),
    /// A dial of ours is on its way, or its hello.
    Dialling(ConnectionId),
    Up(ConnectionId, Pulse),
}

impl Side {
    pub(super) const fn new(redial_min: Duration) -> Self {
        Self { state: SideState::Down, void_dial: 0, back_off: redial_min, is_through: false }
    }

    pub(super) const fn pulse(&mut self) -> Option<&mut Pulse> {
        match &mut self.state {
            SideState::Up(_, pulse) => Some(pulse),
            SideState::Down | SideState::Redial(_) | SideState::Dialling(_) => None,
        }
    }

    pub(super) fn next_wake(&self, settings: &Settings) -> Option<Time> {
        match self.state {
            SideState::Redial(at) => Some(at),
            SideState::Up(_, pulse) => Some(pulse.ping_at(settings)),
            SideState::Down | SideState::Dialling(_) => None,
        }
    }
}

impl Link {
    fn side(&mut self, lane: Lane) -> Option<&mut Side> {
        let [stream, bulk] = self.sides.as_mut()?;
        match lane {
            Lane::Control => None,
            Lane::Stream => Some(stream),
            Lane::Bulk => Some(bulk),
        }
    }

    pub(super) fn pulse_of(&mut self, lane: Lane) -> Option<&mut Pulse> {
        match lane {
            Lane::Control => Some(&mut self.pulse),
            Lane::Stream | Lane::Bulk => self.side(lane)?.pulse(),
        }
    }

    pub(super) fn connection_of(&mut self, lane: Lane) -> Option<ConnectionId> {
        match (lane, self.side(lane).map(|side| side.state)) {
            (Lane::Control, _) => Some(self.connection),
            (Lane::Stream | Lane::Bulk, Some(SideState::Up(connection, _))) => Some(connection),
            (Lane::Stream | Lane::Bulk, _) => None,
        }
    }

    /// Messages pass on the connection for `lane`.
    pub(super) fn side_carried(&mut self, lane: Lane, redial_min: Duration) {
        if let Some(side) = self.side(lane) {
            side.back_off = redial_min;
        }
    }

    /// Whether messages of a peer that has said goodbye may still come on another connection.
    pub(super) fn expects_more(&self) -> bool {
        self.sides.iter().flatten().any(|side| match side.state {
            SideState::Up(..) | SideState::Dialling(_) | SideState::Redial(_) => true,
            // It may be about to dial; if it is not, it hangs up.
            SideState::Down => self.dialled.is_none() && !side.is_through,
        })
    }
}

impl Core {
    /// Whether a peer may dial a connection for Stream or for Bulk: one that is not there, or breaks; the peer may know that before we do.
    pub(in crate::gncl) fn expects_sides(&self) -> bool {
        let accepted = self.peers.values().filter_map(|peer| peer.link).filter(|link| link.dialled.is_none());
        accepted.filter_map(|link| link.sides).flatten().any(|side| !side.is_through)
    }

    /// A link stands: the sides are dialled by whoever dialled it.
    pub(super) fn dial_sides(&mut self, now: Time, node: NodeAddress) {
        for lane in Lane::SIDES {
            self.dial_side(now, node, lane);
        }
    }

    fn dial_side(&mut self, now: Time, node: NodeAddress, lane: Lane) {
        let connection = self.open();
        let Some(link) = self.peers.get_mut(&node).and_then(|peer| peer.link.as_mut()) else { return };
        let (Some(address), Some(side)) = (link.dialled, link.side(lane)) else { return };
        side.state = SideState::Dialling(connection);
        self.stage_for_handshake(now, connection, Stage::Dialling(node, lane));
        self.outputs.push_back(Output::Dial { connection, address });
    }

    pub(super) fn redial_side(&mut self, now: Time, node: NodeAddress, lane: Lane) {
        let side = self.peers.get_mut(&node).and_then(|peer| peer.link.as_mut()?.side(lane));
        if let Some(SideState::Redial(at)) = side.map(|side| side.state)
            && at <= now
        {
            self.dial_side(now, node, lane);
        }
    }

    pub(super) fn side_hello(&mut self, now: Time, connection: ConnectionId, hello: &Introduction) {
        if let Err(decline) = self.judge_side(hello) {
            return self.decline(now, connection, &decline);
        }
        let (node, lane) = (hello.node, hello.lane);
        // The peer would not dial if it still had the former one. spec: GNCL-5
        self.drop_side(node, lane);
        let ours = &self.settings.ours;
        let welcome = Introduction { peer: node, dial: 0, lane, link: hello.link, ..ours.clone() };
        let Some(link) = self.peers.get_mut(&node).and_then(|peer| peer.link.as_mut()) else { return };
        if let Some(side) = link.side(lane) {
            side.void_dial = hello.dial;
        }
        self.side_up(now, connection, hello, Some(welcome));
    }

    /// Whether the peer may have this connection: it belongs to the link that it dialled. spec: GNCL-14
    fn judge_side(&mut self, hello: &Introduction) -> Result<(), Decline> {
        check(hello, &self.settings.ours)?;
        let peer = self.peers.get_mut(&hello.node).filter(|peer| peer.incarnation == hello.incarnation);
        let link = peer.and_then(|peer| peer.link.as_mut());
        let link = link.filter(|link| link.dialled.is_none() && link.dial == hello.link);
        let side = link.and_then(|link| link.side(hello.lane));
        if side.is_some_and(|side| hello.dial > side.void_dial) { Ok(()) } else { Err(Decline::Duplicate) }
    }

    pub(super) fn side_welcome(
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
                Err(Decline::Violation("a WELCOME for another connection came".to_owned()))
            }
        });
        match judged {
            Ok(()) => self.side_up(now, connection, welcome, None),
            Err(decline) => self.decline(now, connection, &decline),
        }
    }

    fn side_up(
        &mut self,
        now: Time,
        connection: ConnectionId,
        theirs: &Introduction,
        welcome: Option<Introduction>,
    ) {
        let (node, lane) = (theirs.node, theirs.lane);
        let Some(peer) = self.peers.get_mut(&node) else { return };
        let incarnation = peer.incarnation;
        let Some(side) = peer.link.as_mut().and_then(|link| link.side(lane)) else { return };
        side.state = SideState::Up(connection, Pulse::beat(now));
        let stage = Stage::Linked(node, lane);
        self.connections.insert(connection, Connection { stage, from: None, deadline: Time::MAX });
        self.outputs.push_back(Output::Attach(Attach {
            connection,
            node,
            incarnation,
            lane,
            by_class: true,
            takes_cancels: theirs.knows(CANCEL),
            takes_outcomes: theirs.knows(OUTCOMES),
            takes_reports: theirs.knows(UNDELIVERED),
            takes_datagrams: theirs.knows(DATAGRAMS) && self.settings.ours.knows(DATAGRAMS),
            is_guarded: theirs.knows(GUARD) && self.settings.ours.knows(GUARD),
            payload_max: theirs.payload_max,
            answers_max: theirs.answers_max,
            welcome,
        }));
    }

    /// The connection for `lane` is over, or never came to be; plans the next one, if we dial it.
    pub(super) fn side_over(&mut self, now: Time, node: NodeAddress, lane: Lane) {
        let (chance, redial_max) = (self.chance(), self.settings.redial_max);
        let Some(link) = self.peers.get_mut(&node).and_then(|peer| peer.link.as_mut()) else { return };
        // Also of a peer that leaves: what it keeps for this connection comes on the next one. spec: GNCL-10
        let is_dialled = link.dialled.is_some();
        if let Some(side) = link.side(lane) {
            // spec: GNCL-8
            side.state = if is_dialled && !side.is_through {
                SideState::Redial(now + side.back_off.mul_f64(0.8 + 0.4 * chance))
            } else {
                SideState::Down
            };
            side.back_off = (side.back_off * 2).min(redial_max);
        }
        self.farewell(now, node);
    }

    /// The peer has nothing more for this connection. spec: GNCL-10
    pub(super) fn side_goodbye(
        &mut self,
        now: Time,
        connection: ConnectionId,
        (node, lane): (NodeAddress, Lane),
    ) {
        let link = self.peers.get_mut(&node).and_then(|peer| peer.link.as_mut());
        if let Some(side) = link.and_then(|link| link.side(lane)) {
            side.is_through = true;
        }
        self.ended(now, connection);
        self.outputs.push_back(Output::Close(connection));
    }

    /// Ends the connections for Stream and for Bulk, and the dials for them.
    pub(super) fn drop_sides(&mut self, node: NodeAddress) {
        for lane in Lane::SIDES {
            self.drop_side(node, lane);
        }
        if let Some(link) = self.peers.get_mut(&node).and_then(|peer| peer.link.as_mut()) {
            link.sides = None;
        }
    }

    fn drop_side(&mut self, node: NodeAddress, lane: Lane) {
        let link = self.peers.get_mut(&node).and_then(|peer| peer.link.as_mut());
        let Some(side) = link.and_then(|link| link.side(lane)) else { return };
        match std::mem::replace(&mut side.state, SideState::Down) {
            SideState::Down | SideState::Redial(_) => {}
            SideState::Dialling(connection) => {
                self.connections.remove(&connection);
                self.outputs.push_back(Output::Close(connection));
            }
            SideState::Up(connection, _) => {
                self.connections.remove(&connection);
                self.outputs.push_back(Output::Detach { connection, node, lane });
                self.outputs.push_back(Output::Close(connection));
            }
        }
    }
}
