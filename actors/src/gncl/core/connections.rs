//! What happens to one connection until it is a link or gone.

use std::{
    cmp::Reverse,
    collections::BTreeMap,
    net::{IpAddr, Ipv6Addr},
    time::Duration,
};

use sinew_runtime::{
    tid::{Incarnation, NodeAddress},
    time::Time,
};

use super::{
    Attach, CANCEL, Connection, ConnectionId, Core, DATAGRAMS, Decline, GUARD, Introduction, Lane, LinkFact,
    OUTCOMES, Output, Refusal, Stage, UNDELIVERED,
    acquaintance::{Acquaintance, Link, Pulse},
    dials::Dial,
    handshake::{check, printable},
    sides::Side,
};

/// Connections that a node makes at once: one for each class.
const OF_A_NODE: usize = 3;
/// How old may be what is known of where nodes were found, as a look through all their addresses takes a millisecond where there are a thousand.
const FOUND_FOR: Duration = Duration::from_millis(100);

/// Strangers that are closed at once where many are to go: as many as are accepted without a pause. Links that stand share the thread, and wait
/// for a system call or more for each.
const CLOSED_AT_ONCE: usize = 4;
/// Time between two such handfuls.
const CLOSED_EACH: Duration = Duration::from_millis(1);

/// Strangers that are to go because there were no descriptors left.
#[derive(Debug)]
pub(super) struct Clearing {
    left: usize,
    /// When the next ones go.
    pub(super) next: Time,
}

/// How many nodes NDL has found at each address.
#[derive(Debug, Default)]
pub(super) struct FoundAt {
    as_of: Option<Time>,
    nodes: BTreeMap<IpAddr, usize>,
}

impl Core {
    pub(super) fn accepted(&mut self, now: Time, connection: ConnectionId, from: IpAddr) {
        if self.leaving && !self.expects_sides() {
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

    /// There are no descriptors left, or no memory: what strangers hold is needed for peers. Half of them go, [`CLOSED_AT_ONCE`] each
    /// [`CLOSED_EACH`]. spec: GNCL-2
    pub(super) fn starved(&mut self, now: Time) {
        let half = self.strangers().count().div_ceil(2);
        match &mut self.clearing {
            // It goes on at its pace, however often that is said meanwhile.
            Some(clearing) => clearing.left = clearing.left.max(half),
            None => self.clear(now, half),
        }
    }

    /// The next of the strangers that are to go are due.
    pub(super) fn clear_further(&mut self, now: Time) {
        if let Some(Clearing { left, .. }) = self.clearing.take_if(|clearing| clearing.next <= now) {
            // Some have gone by themselves: of those that are left at least half stay, as where it begins.
            self.clear(now, left.min(self.strangers().count().div_ceil(2)));
        }
    }

    fn clear(&mut self, now: Time, count: usize) {
        let at_once = count.min(CLOSED_AT_ONCE);
        self.close_strangers(now, at_once);
        let left = count - at_once;
        self.clearing = (left > 0).then(|| Clearing { left, next: now + CLOSED_EACH });
    }

    /// Connections whose peer is not known, or was refused and has not closed, and from where they were made: oldest first.
    fn strangers(&self) -> impl DoubleEndedIterator<Item = (ConnectionId, Option<IpAddr>)> {
        let is_stranger = |stage| matches!(stage, Stage::Stranger | Stage::Leaving);
        self.connections.iter().filter(move |(_, c)| is_stranger(c.stage)).map(|(id, c)| (*id, c.from))
    }

    /// Strangers in the order in which they go. Who is a peer says hello at once, so those that have not for longest are none; but who
    /// connects thousands of times a second lets nobody say anything, unless it is his own that go: first those from where most come,
    /// and only behind all others those from where NDL has found a node, as many of the newest as that makes; half of the places at most
    /// are for these. Most come from one network of IPv6 where a host takes a new address for each: in it, first those of the address from
    /// where most come.
    fn least_wanted(&mut self, now: Time) -> Vec<ConnectionId> {
        self.look_where_nodes_are(now);
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

    fn look_where_nodes_are(&mut self, now: Time) {
        if self.found_at.as_of.is_some_and(|as_of| now.since(as_of) < FOUND_FOR) {
            return;
        }
        let mut nodes = BTreeMap::<_, usize>::new();
        for addresses in self.peers.values().filter_map(|peer| peer.wanted.as_ref()) {
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
        for connection in self.least_wanted(now).into_iter().take(count) {
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
        // The clock makes the number grow through restarts of this layer as well. spec: GNCL-6
        peer.dial_number = now.as_nanos().max(peer.dial_number + 1);
        // Of the first connection there is no link yet.
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
            // The first connection tells whether the node is there.
            return self.side_over(now, node, lane);
        }
        self.attempt_over(now, node, connection, refused);
    }

    pub(super) fn hello(&mut self, now: Time, connection: ConnectionId, hello: &Introduction) {
        match self.stage(connection) {
            Some(Stage::Stranger) => {}
            Some(Stage::Leaving) | None => return,
            Some(Stage::Dialling(..) | Stage::HelloSent(..) | Stage::Linked(..)) => {
                let what = "a HELLO came where none belongs".to_owned();
                return self.decline(now, connection, &Decline::Violation(what));
            }
        }
        if hello.lane != Lane::Control {
            return self.side_hello(now, connection, hello);
        }
        if let Err(decline) = self.judge(now, hello) {
            return self.decline(now, connection, &decline);
        }
        let node = hello.node;
        self.meet(now, node, hello.incarnation);
        // spec: GNCL-4
        self.drop_dial(node);
        // spec: GNCL-5
        self.unlink(now, node);
        let Some(peer) = self.peers.get_mut(&node) else { return };
        peer.void_dial = hello.dial;
        let welcome = Introduction { peer: node, dial: peer.dial_number, ..self.settings.ours.clone() };
        self.link(now, connection, hello, Some(welcome));
    }

    /// Whether a hello can be taken.
    fn judge(&self, now: Time, hello: &Introduction) -> Result<(), Decline> {
        if self.leaving {
            return Err(Decline::Leaving);
        }
        check(hello, &self.settings.ours)?;
        self.judge_life(now, hello.node, hello.incarnation)?;
        self.room_for_claim(hello.node)?;
        let Some(peer) = self.peers.get(&hello.node) else { return self.room() };
        // spec: GNCL-6
        let is_void = hello.incarnation == peer.incarnation && hello.dial <= peer.void_dial;
        // A dial that has not said hello yet loses against one that has. spec: GNCL-4
        let mut dials = peer.dial.iter().flat_map(Dial::connections);
        let said_hello = dials.any(|dial| matches!(self.stage(dial), Some(Stage::HelloSent(..))));
        if is_void || (said_hello && self.settings.ours.node < hello.node) {
            return Err(Decline::Duplicate);
        }
        Ok(())
    }

    /// Whether one more peer can be taken of which nobody but itself has told: whoever can connect can say that it is any node.
    fn room_for_claim(&self, node: NodeAddress) -> Result<(), Decline> {
        let strangers_max = self.settings.strangers_max;
        let is_new = self.peers.get(&node).is_none_or(|peer| peer.vouched().is_none() && !peer.is_claim());
        if is_new && self.peers.values().filter(|peer| peer.is_claim()).count() >= strangers_max {
            return Err(Decline::TooManyClaims { strangers_max });
        }
        Ok(())
    }

    /// Whether one more peer can be known.
    fn room(&self) -> Result<(), Decline> {
        let peers_max = self.settings.peers_max;
        if self.peers.len() < peers_max || self.peers.values().any(Acquaintance::is_idle) {
            Ok(())
        } else {
            Err(Decline::TooManyPeers { peers_max })
        }
    }

    pub(super) fn welcome(&mut self, now: Time, connection: ConnectionId, welcome: &Introduction) {
        let node = match self.stage(connection) {
            Some(Stage::HelloSent(node, Lane::Control)) => node,
            Some(Stage::HelloSent(node, lane)) => {
                return self.side_welcome(now, connection, (node, lane), welcome);
            }
            Some(Stage::Leaving) | None => return,
            Some(Stage::Dialling(..) | Stage::Stranger | Stage::Linked(..)) => {
                let what = "a WELCOME came where none belongs".to_owned();
                return self.decline(now, connection, &Decline::Violation(what));
            }
        };
        if let Err(decline) = self.judge_welcome(now, node, welcome) {
            return self.decline(now, connection, &decline);
        }
        self.meet(now, node, welcome.incarnation);
        let Some(peer) = self.peers.get_mut(&node) else { return };
        peer.void_dial = peer.void_dial.max(welcome.dial);
        self.link(now, connection, welcome, None);
    }

    fn judge_welcome(&self, now: Time, dialled: NodeAddress, welcome: &Introduction) -> Result<(), Decline> {
        check(welcome, &self.settings.ours)?;
        if welcome.node != dialled {
            return Err(Decline::WrongNode { wanted: dialled, ours: welcome.node });
        }
        self.judge_life(now, dialled, welcome.incarnation)
    }

    /// Whether this life of `node` may be linked: which one is there, and whether one is, says NDL. spec: GNCL-7
    fn judge_life(&self, now: Time, node: NodeAddress, incarnation: Incarnation) -> Result<(), Decline> {
        let Some(peer) = self.peers.get(&node) else { return Ok(()) };
        if incarnation != peer.incarnation && peer.is_hearsay(now, &self.settings) {
            // Who connects has proven more than the one of whom NDL tells. spec: GNCL-7
            Ok(())
        } else if incarnation < peer.incarnation {
            Err(Decline::Stale { theirs: incarnation, known: peer.incarnation })
        } else if peer.vouched().is_some_and(|present| incarnation > present) {
            Err(Decline::Contested { node })
        } else if peer.is_lost(incarnation) {
            Err(Decline::Lost { node })
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
        let by_class = theirs.knows_classes() && self.settings.ours.knows_classes();
        let redial_min = self.settings.redial_min;
        let Some(peer) = self.peers.get_mut(&node) else { return };
        let ours = peer.dial.take().and_then(|dial| dial.address_of(connection));
        let (dial, dialled) = if welcome.is_some() { (theirs.dial, None) } else { (peer.dial_number, ours) };
        if self.settings.connections_prove && peer.found.is_some_and(|found| found != incarnation) {
            // NDL was told of a life that never connected; it will tell of this one.
            (peer.found, peer.wanted) = (None, None);
        }
        if self.leaving {
            // What waited goes out on it, and it is the last one.
            peer.wanted = None;
        }
        peer.linked(Link {
            connection,
            since: now,
            pulse: Pulse::beat(now),
            dial,
            dialled,
            sides: by_class.then(|| [Side::new(redial_min); 2]),
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
            takes_cancels: theirs.knows(CANCEL),
            takes_outcomes: theirs.knows(OUTCOMES),
            takes_reports: theirs.knows(UNDELIVERED),
            takes_datagrams: by_class && theirs.knows(DATAGRAMS) && self.settings.ours.knows(DATAGRAMS),
            is_guarded: theirs.knows(GUARD) && self.settings.ours.knows(GUARD),
            payload_max: theirs.payload_max,
            answers_max: theirs.answers_max,
            welcome,
        }));
        self.fact(LinkFact::LinkUp { node, incarnation });
        self.dial_sides(now, node);
    }

    pub(super) fn refused(&mut self, now: Time, connection: ConnectionId, refusal: &Refusal) {
        let Some(stage) = self.stage(connection) else { return };
        match stage {
            Stage::HelloSent(node, _) | Stage::Linked(node, _) => {
                let cause = match &*refusal.cause {
                    // Two nodes that dial each other at once refuse one of the two: that is how it should be.
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

    /// Refuses a connection in words. spec: GNCL-3
    pub(super) fn decline(&mut self, now: Time, connection: ConnectionId, decline: &Decline) {
        let Some(stage) = self.stage(connection) else { return };
        if stage == Stage::Leaving {
            return;
        }
        let refusal = decline.to_refusal();
        self.count(decline.cause(), refusal.sentence.clone());
        // Who is refused stays from where it came.
        let from = self.connections.get(&connection).and_then(|known| known.from);
        self.leave_stage(now, connection, stage);
        let deadline = now + self.settings.handshake;
        self.connections.insert(connection, Connection { stage: Stage::Leaving, from, deadline });
        self.outputs.push_back(Output::Refuse(connection, refusal));
        // Whom we dialled is among them now: a peer whose addresses change without end must not hold more than there are places.
        if self.strangers().count() > self.settings.strangers_max {
            self.make_room_for_refused(now, connection);
        }
    }

    /// Of the others that were refused the one goes that began first. Where there is none, a stranger does that has said nothing.
    fn make_room_for_refused(&mut self, now: Time, refused: ConnectionId) {
        let mut others = self.connections.iter().filter(|(connection, _)| **connection != refused);
        let oldest =
            others.find(|(_, known)| known.stage == Stage::Leaving).map(|(connection, _)| *connection);
        let goes = match oldest {
            Some(oldest) => Some(oldest),
            None => self.least_wanted(now).into_iter().find(|connection| *connection != refused),
        };
        let Some(connection) = goes else { return };
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
            Stage::Stranger | Stage::HelloSent(..) => self.decline(now, connection, &Decline::TooLate),
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

    /// The connection is not in `stage` any more: the peer's side of that.
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
            Stage::Linked(node, Lane::Control) => self.link_over(now, node),
            Stage::Dialling(node, lane) | Stage::HelloSent(node, lane) => {
                self.connections.remove(&connection);
                self.side_over(now, node, lane);
            }
            Stage::Linked(node, lane) => {
                self.connections.remove(&connection);
                self.outputs.push_back(Output::Detach { connection, node, lane });
                self.side_over(now, node, lane);
            }
            Stage::Stranger | Stage::Leaving => {
                self.connections.remove(&connection);
            }
        }
    }

    /// A connection that was dialled enters a stage that does not last. spec: GNCL-2
    pub(super) fn stage_for_handshake(&mut self, now: Time, connection: ConnectionId, stage: Stage) {
        let deadline = now + self.settings.handshake;
        self.connections.insert(connection, Connection { stage, from: None, deadline });
    }
}

/// Where whoever has this address may have others as well: of IPv6 a network of 2^64 of them is the least that a host is given.
fn network_of(ip: IpAddr) -> IpAddr {
    match ip {
        IpAddr::V4(_) => ip,
        IpAddr::V6(ip) => Ipv6Addr::from_bits(ip.to_bits() >> 64 << 64).into(),
    }
}
