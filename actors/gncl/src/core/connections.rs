//! The state of one connection until it is a link or closed.

use std::{
    cmp::Reverse,
    collections::BTreeMap,
    net::{IpAddr, Ipv6Addr},
    time::Duration,
};

use sinew_model::facts::LinkFact;
use sinew_runtime::{
    tid::{Incarnation, NodeAddress},
    time::Time,
};

use super::{
    Attach, CANCEL, Connection, ConnectionId, Core, DATAGRAMS, GUARD, Introduction, Lane, OUTCOME_RUNS,
    OUTCOMES, Output, Refusal, RefusalError, Stage, UNDELIVERED,
    dials::Dial,
    handshake::{check, printable},
    lane_connections::LaneConnection,
    peer_state::{Keepalive, Link, PeerState},
};

/// Number of connections that a node opens at once: one per class.
const OF_A_NODE: usize = 3;
/// Maximum age of the table of found nodes by address, because rebuilding it takes a millisecond for a
/// thousand addresses.
const FOUND_FOR: Duration = Duration::from_millis(100);

/// Maximum number of unauthenticated connections closed at once: as many as are accepted without a pause.
/// Established links share the thread, and each close delays them by at least one system call.
const CLOSED_AT_ONCE: usize = 4;
/// Time between two such batches.
const CLOSED_EACH: Duration = Duration::from_millis(1);

/// Unauthenticated connections that are being closed because no descriptors were left.
#[derive(Debug)]
pub(super) struct Clearing {
    left: usize,
    /// Time of the next batch.
    pub(super) next: Time,
}

/// Number of nodes that NDL has found at each address.
#[derive(Debug, Default)]
pub(super) struct FoundAt {
    as_of: Option<Time>,
    nodes: BTreeMap<IpAddr, usize>,
}

impl Core {
    pub(super) fn accepted(&mut self, now: Time, connection: ConnectionId, from: IpAddr) {
        if self.leaving && !self.expects_lane_connections() {
            self.count("leaving", "a connection was closed at once".to_owned());
            self.outputs.push_back(Output::Close(connection));
            return;
        }
        if self.strangers().count() >= self.settings.strangers_max {
            let what = "the oldest one from where most come was closed; see `gncl.strangers_max`";
            self.count("too many strangers", what.to_owned());
            self.close_strangers(now, 1);
        }
        let deadline = now + self.settings.handshake;
        self.connections
            .insert(connection, Connection { stage: Stage::Stranger, from: Some(from), deadline });
    }

    /// Closes half of the unauthenticated connections to free descriptors or memory for peers:
    /// [`CLOSED_AT_ONCE`] each [`CLOSED_EACH`]. spec: GNCL-2
    pub(super) fn starved(&mut self, now: Time) {
        let half = self.strangers().count().div_ceil(2);
        match &mut self.clearing {
            // A running closure keeps its pace, however often this is reported meanwhile.
            Some(clearing) => clearing.left = clearing.left.max(half),
            None => self.close_batch(now, half),
        }
    }

    /// Closes the next batch of unauthenticated connections, if it is due.
    pub(super) fn close_next_batch(&mut self, now: Time) {
        if let Some(Clearing { left, .. }) = self.clearing.take_if(|clearing| clearing.next <= now) {
            // Some have closed by themselves. At least half of the remaining ones stay, as at the start.
            self.close_batch(now, left.min(self.strangers().count().div_ceil(2)));
        }
    }

    fn close_batch(&mut self, now: Time, count: usize) {
        let at_once = count.min(CLOSED_AT_ONCE);
        self.close_strangers(now, at_once);
        let left = count - at_once;
        self.clearing = (left > 0).then(|| Clearing { left, next: now + CLOSED_EACH });
    }

    /// Returns the connections of unknown peers, and those that were refused and not closed yet, with their
    /// source addresses: oldest first.
    fn strangers(&self) -> impl DoubleEndedIterator<Item = (ConnectionId, Option<IpAddr>)> {
        let is_stranger = |stage| matches!(stage, Stage::Stranger | Stage::Leaving);
        self.connections.iter().filter(move |(_, c)| is_stranger(c.stage)).map(|(id, c)| (*id, c.from))
    }

    /// Returns the unauthenticated connections in the order of their closure. A peer sends HELLO at once, so
    /// the oldest ones are not peers. A source that connects thousands of times a second would displace all
    /// others before their HELLO. Therefore connections from the address with the most connections are closed
    /// first. Last are those from addresses where NDL has found nodes: the newest ones, [`OF_A_NODE`] per
    /// node, for at most half of the places. A host may use a new IPv6 address for each connection, so the
    /// network with the most connections is closed first. Within it, the address with the most connections is
    /// first.
    fn eviction_order(&mut self, now: Time) -> Vec<ConnectionId> {
        self.refresh_found_at(now);
        let places = self.settings.strangers_max / 2;
        let mut newer: BTreeMap<Option<IpAddr>, usize> = BTreeMap::new();
        let of_addresses = self.strangers().rev().map(|(connection, from)| {
            let newer = newer.entry(from).or_default();
            *newer += 1;
            let nodes = from.and_then(|from| self.found_at.nodes.get(&from)).copied().unwrap_or(0);
            let is_expected = *newer <= (nodes * OF_A_NODE).min(places);
            (*newer, Reverse(connection), from, is_expected)
        });
        let mut of_addresses: Vec<_> = of_addresses.collect();
        of_addresses.sort_unstable();
        let mut before: BTreeMap<Option<IpAddr>, usize> = BTreeMap::new();
        let ranked = of_addresses.into_iter().map(|(_, Reverse(connection), from, is_expected)| {
            let before = before.entry(from.map(network_of)).or_default();
            *before += 1;
            (is_expected, Reverse(*before), connection)
        });
        let mut ranked: Vec<_> = ranked.collect();
        ranked.sort_unstable();
        ranked.into_iter().map(|(_, _, connection)| connection).collect()
    }

    fn refresh_found_at(&mut self, now: Time) {
        if self.found_at.as_of.is_some_and(|as_of| now.since(as_of) < FOUND_FOR) {
            return;
        }
        let mut nodes = BTreeMap::<_, usize>::new();
        for addresses in self.peers.values().filter_map(|peer| peer.dial_addresses.as_ref()) {
            let mut addresses: Vec<_> = addresses.iter().map(|at| at.ip()).collect();
            addresses.sort_unstable();
            addresses.dedup();
            for address in addresses {
                *nodes.entry(address).or_default() += 1;
            }
        }
        self.found_at = FoundAt { as_of: Some(now), nodes };
    }

    fn close_strangers(&mut self, now: Time, count: usize) {
        for connection in self.eviction_order(now).into_iter().take(count) {
            self.connections.remove(&connection);
            self.outputs.push_back(Output::Close(connection));
        }
    }

    pub(super) fn connected(&mut self, now: Time, connection: ConnectionId) {
        let Some(Stage::Dialling(node, lane)) = self.stage(connection) else { return };
        if lane == Lane::Control {
            self.reached(node, connection);
        }
        let Some(peer) = self.peers.get_mut(&node) else { return };
        // The clock makes the number rise over restarts of this layer, too. spec: GNCL-6
        peer.dial_number = now.as_nanos().max(peer.dial_number + 1);
        // The first connection has no link yet.
        let link = peer.link.map_or(0, |link| link.dial);
        let hello =
            Introduction { peer: node, dial: peer.dial_number, lane, link, ..self.settings.ours.clone() };
        self.stage_for_handshake(now, connection, Stage::HelloSent(node, lane));
        self.outputs.push_back(Output::SendHello(connection, hello));
    }

    pub(super) fn dial_failed(&mut self, now: Time, connection: ConnectionId, refused: bool) {
        let Some(Stage::Dialling(node, lane)) = self.stage(connection) else { return };
        self.connections.remove(&connection);
        if lane != Lane::Control {
            // The first connection shows whether the node is present.
            return self.lane_down(now, node, lane);
        }
        self.attempt_over(now, node, connection, refused);
    }

    pub(super) fn hello(&mut self, now: Time, connection: ConnectionId, hello: &Introduction) {
        match self.stage(connection) {
            Some(Stage::Stranger) => {}
            Some(Stage::Leaving) | None => return,
            Some(Stage::Dialling(..) | Stage::HelloSent(..) | Stage::Linked(..)) => {
                let what = "a HELLO came where none belongs".to_owned();
                return self.decline(now, connection, &RefusalError::Violation(what));
            }
        }
        if hello.lane != Lane::Control {
            return self.lane_hello(now, connection, hello);
        }
        if let Err(decline) = self.check_hello(now, hello) {
            return self.decline(now, connection, &decline);
        }
        let node = hello.node;
        self.adopt_incarnation(now, node, hello.incarnation);
        // spec: GNCL-4
        self.drop_dial(node);
        // spec: GNCL-5
        self.unlink(now, node);
        let Some(peer) = self.peers.get_mut(&node) else { return };
        peer.void_dial = hello.dial;
        let welcome = Introduction { peer: node, dial: peer.dial_number, ..self.settings.ours.clone() };
        self.link(now, connection, hello, Some(welcome));
    }

    /// Whether a HELLO can be accepted.
    fn check_hello(&self, now: Time, hello: &Introduction) -> Result<(), RefusalError> {
        if self.leaving {
            return Err(RefusalError::Leaving);
        }
        check(hello, &self.settings.ours)?;
        self.check_incarnation(now, hello.node, hello.incarnation)?;
        self.check_claim_room(hello.node)?;
        let Some(peer) = self.peers.get(&hello.node) else { return self.check_peer_room() };
        // spec: GNCL-6
        let is_void = hello.incarnation == peer.incarnation && hello.dial <= peer.void_dial;
        // A dial that has not sent its HELLO yet loses against a received HELLO. spec: GNCL-4
        let mut dials = peer.dial.iter().flat_map(Dial::connections);
        let hello_sent = dials.any(|dial| matches!(self.stage(dial), Some(Stage::HelloSent(..))));
        if is_void || (hello_sent && self.settings.ours.node < hello.node) {
            return Err(RefusalError::Duplicate);
        }
        Ok(())
    }

    /// Whether one more peer can be accepted that is known only from its own HELLO: any process that can
    /// connect can claim to be any node.
    fn check_claim_room(&self, node: NodeAddress) -> Result<(), RefusalError> {
        let strangers_max = self.settings.strangers_max;
        let is_new = self
            .peers
            .get(&node)
            .is_none_or(|peer| peer.present_incarnation().is_none() && !peer.is_unconfirmed());
        if is_new && self.peers.values().filter(|peer| peer.is_unconfirmed()).count() >= strangers_max {
            return Err(RefusalError::TooManyClaims { strangers_max });
        }
        Ok(())
    }

    /// Whether one more peer can be known.
    fn check_peer_room(&self) -> Result<(), RefusalError> {
        let peers_max = self.settings.peers_max;
        if self.peers.len() < peers_max || self.peers.values().any(PeerState::is_idle) {
            Ok(())
        } else {
            Err(RefusalError::TooManyPeers { peers_max })
        }
    }

    pub(super) fn welcome(&mut self, now: Time, connection: ConnectionId, welcome: &Introduction) {
        let node = match self.stage(connection) {
            Some(Stage::HelloSent(node, Lane::Control)) => node,
            Some(Stage::HelloSent(node, lane)) => {
                return self.lane_welcome(now, connection, (node, lane), welcome);
            }
            Some(Stage::Leaving) | None => return,
            Some(Stage::Dialling(..) | Stage::Stranger | Stage::Linked(..)) => {
                let what = "a WELCOME came where none belongs".to_owned();
                return self.decline(now, connection, &RefusalError::Violation(what));
            }
        };
        if let Err(decline) = self.check_welcome(now, node, welcome) {
            return self.decline(now, connection, &decline);
        }
        self.adopt_incarnation(now, node, welcome.incarnation);
        let Some(peer) = self.peers.get_mut(&node) else { return };
        peer.void_dial = peer.void_dial.max(welcome.dial);
        self.link(now, connection, welcome, None);
    }

    fn check_welcome(
        &self,
        now: Time,
        dialled: NodeAddress,
        welcome: &Introduction,
    ) -> Result<(), RefusalError> {
        check(welcome, &self.settings.ours)?;
        if welcome.node != dialled {
            return Err(RefusalError::WrongNode { wanted: dialled, ours: welcome.node });
        }
        self.check_incarnation(now, dialled, welcome.incarnation)
    }

    /// Whether this incarnation of `node` may be linked. NDL determines whether the node is present, and in
    /// which incarnation. spec: GNCL-7
    fn check_incarnation(
        &self,
        now: Time,
        node: NodeAddress,
        incarnation: Incarnation,
    ) -> Result<(), RefusalError> {
        let Some(peer) = self.peers.get(&node) else { return Ok(()) };
        if incarnation != peer.incarnation && peer.is_unverified(now, &self.settings) {
            // An authenticated connection proves more than the incarnation in NDL's datagrams. spec: GNCL-7
            Ok(())
        } else if incarnation < peer.incarnation {
            Err(RefusalError::Stale { theirs: incarnation, known: peer.incarnation })
        } else if peer.present_incarnation().is_some_and(|present| incarnation > present) {
            Err(RefusalError::Contested { node })
        } else if peer.is_lost(incarnation) {
            Err(RefusalError::Lost { node })
        } else {
            Ok(())
        }
    }

    fn link(
        &mut self,
        now: Time,
        connection: ConnectionId,
        theirs: &Introduction,
        welcome: Option<Introduction>,
    ) {
        let (node, incarnation) = (theirs.node, theirs.incarnation);
        let by_class = theirs.supports_classes() && self.settings.ours.supports_classes();
        let redial_min = self.settings.redial_min;
        let Some(peer) = self.peers.get_mut(&node) else { return };
        let ours = peer.dial.take().and_then(|dial| dial.address_of(connection));
        let (dial, dialled) = if welcome.is_some() { (theirs.dial, None) } else { (peer.dial_number, ours) };
        if self.settings.connections_authenticate && peer.found.is_some_and(|found| found != incarnation) {
            // NDL reported an incarnation that never connected; it will report this one.
            (peer.found, peer.dial_addresses) = (None, None);
        }
        if self.leaving {
            // Pending messages are sent on this link, and it is the last one.
            peer.dial_addresses = None;
        }
        peer.linked(Link {
            connection,
            since: now,
            keepalive: Keepalive::new(now),
            dial,
            dialled,
            lane_connections: by_class.then(|| [LaneConnection::new(redial_min); 2]),
            has_left: false,
        });
        let stage = Stage::Linked(node, Lane::Control);
        self.connections.insert(connection, Connection { stage, from: None, deadline: Time::MAX });
        self.outputs.push_back(Output::Attach(Attach {
            connection,
            node,
            incarnation,
            lane: Lane::Control,
            by_class,
            takes_cancels: theirs.supports(CANCEL),
            takes_outcomes: theirs.supports(OUTCOMES),
            takes_outcome_runs: theirs.supports(OUTCOME_RUNS),
            takes_reports: theirs.supports(UNDELIVERED),
            takes_datagrams: by_class && theirs.supports(DATAGRAMS) && self.settings.ours.supports(DATAGRAMS),
            is_guarded: theirs.supports(GUARD) && self.settings.ours.supports(GUARD),
            payload_max: theirs.payload_max,
            answers_max: theirs.answers_max,
            welcome,
        }));
        self.fact(LinkFact::LinkUp { node, incarnation });
        self.dial_lanes(now, node);
    }

    pub(super) fn refused(&mut self, now: Time, connection: ConnectionId, refusal: &Refusal) {
        let Some(stage) = self.stage(connection) else { return };
        match stage {
            Stage::HelloSent(node, _) | Stage::Linked(node, _) => {
                let cause = match &*refusal.cause {
                    // Two nodes that dial each other at once refuse one of the two connections, as intended.
                    "duplicate" => "duplicate at the peer",
                    "leaving" => "the peer leaves",
                    _ => "refused by the peer",
                };
                self.count(cause, format!("node {node} says: {}", printable(&refusal.sentence)));
            }
            Stage::Dialling(..) | Stage::Stranger | Stage::Leaving => {}
        }
        self.ended(now, connection);
        self.outputs.push_back(Output::Close(connection));
    }

    /// Refuses a connection with a REFUSAL. spec: GNCL-3
    pub(super) fn decline(&mut self, now: Time, connection: ConnectionId, decline: &RefusalError) {
        let Some(stage) = self.stage(connection) else { return };
        if stage == Stage::Leaving {
            return;
        }
        let refusal = decline.to_refusal();
        self.count(decline.cause(), refusal.sentence.clone());
        // A refused connection keeps its source address.
        let from = self.connections.get(&connection).and_then(|known| known.from);
        self.leave_stage(now, connection, stage);
        let deadline = now + self.settings.handshake;
        self.connections.insert(connection, Connection { stage: Stage::Leaving, from, deadline });
        self.outputs.push_back(Output::Refuse(connection, refusal));
        // Refused local dials count as well. A peer that changes its addresses without end must not hold more
        // connections than allowed.
        if self.strangers().count() > self.settings.strangers_max {
            self.make_room_for_refused(now, connection);
        }
    }

    /// Closes the oldest of the other refused connections, or an unauthenticated one that has not sent HELLO
    /// if there is none.
    fn make_room_for_refused(&mut self, now: Time, refused: ConnectionId) {
        let mut others = self.connections.iter().filter(|(connection, _)| **connection != refused);
        let oldest =
            others.find(|(_, known)| known.stage == Stage::Leaving).map(|(connection, _)| *connection);
        let evicted = match oldest {
            Some(oldest) => Some(oldest),
            None => self.eviction_order(now).into_iter().find(|connection| *connection != refused),
        };
        let Some(connection) = evicted else { return };
        self.count("too many strangers", "one was closed for one that was refused".to_owned());
        self.connections.remove(&connection);
        self.outputs.push_back(Output::Close(connection));
    }

    pub(super) fn ended(&mut self, now: Time, connection: ConnectionId) {
        if let Some(stage) = self.stage(connection) {
            self.leave_stage(now, connection, stage);
        }
    }

    pub(super) fn timed_out(&mut self, now: Time, connection: ConnectionId, stage: Stage) {
        match stage {
            Stage::Stranger | Stage::HelloSent(..) => self.decline(now, connection, &RefusalError::TooLate),
            Stage::Dialling(node, _) => {
                self.count("dial timed out", format!("node {node} cannot be reached"));
                self.outputs.push_back(Output::Close(connection));
                self.ended(now, connection);
            }
            Stage::Leaving | Stage::Linked(..) => {
                self.outputs.push_back(Output::Close(connection));
                self.ended(now, connection);
            }
        }
    }

    /// Updates the peer's state when the connection leaves `stage`.
    fn leave_stage(&mut self, now: Time, connection: ConnectionId, stage: Stage) {
        match stage {
            Stage::Dialling(node, Lane::Control) => {
                self.connections.remove(&connection);
                self.attempt_over(now, node, connection, false);
            }
            Stage::HelloSent(node, Lane::Control) => {
                self.connections.remove(&connection);
                self.handshake_failed(now, node);
            }
            Stage::Linked(node, Lane::Control) => self.link_down(now, node),
            Stage::Dialling(node, lane) | Stage::HelloSent(node, lane) => {
                self.connections.remove(&connection);
                self.lane_down(now, node, lane);
            }
            Stage::Linked(node, lane) => {
                self.connections.remove(&connection);
                self.outputs.push_back(Output::Detach { connection, node, lane });
                self.lane_down(now, node, lane);
            }
            Stage::Stranger | Stage::Leaving => {
                self.connections.remove(&connection);
            }
        }
    }

    /// Puts a dialled connection into a temporary stage. spec: GNCL-2
    pub(super) fn stage_for_handshake(&mut self, now: Time, connection: ConnectionId, stage: Stage) {
        let deadline = now + self.settings.handshake;
        self.connections.insert(connection, Connection { stage, from: None, deadline });
    }
}

/// Returns the network of addresses that one host may own. For IPv6, a network of 2^64 addresses is the
/// smallest one assigned to a host.
fn network_of(ip: IpAddr) -> IpAddr {
    match ip {
        IpAddr::V4(_) => ip,
        IpAddr::V6(ip) => Ipv6Addr::from_bits(ip.to_bits() >> 64 << 64).into(),
    }
}
