//! Who is dialled, who is refused, which of several connections stays: GNCL without sockets and clocks.
//!
//! **After each [`Core::handle`], drain [`Core::poll`] until it is `None`, then sleep until [`Core::next_wake`].**
//!
//! ```text
//!  dialler    Dialling ── connected ──► HelloSent ── WELCOME ──► Linked
//!  acceptor   Stranger ── HELLO ──► (WELCOME) ──────────────────► Linked
//!  sides      Linked, both know classes: the dialler dials again for Stream and for Bulk; they end with the link (`sides.rs`)
//!  either     any of them ── refused ──► Leaving (until the peer has read the words, or the time is over)
//! ```

mod acquaintance;
mod connections;
mod dials;
#[cfg(feature = "fuzzing")]
pub(super) mod fuzzing;
mod handshake;
mod links;
mod sides;
#[cfg(test)]
mod tests;

use std::{
    collections::{BTreeMap, VecDeque},
    net::{IpAddr, SocketAddr},
    time::Duration,
};

use sinew_runtime::{
    tid::{Incarnation, NodeAddress},
    time::Time,
    wire::Checksum,
};

use super::LinkFact;
use acquaintance::Acquaintance;
use connections::{Clearing, FoundAt};
pub(super) use handshake::{
    CANCEL, CLASSES, DATAGRAMS, Decline, GUARD, HANDSHAKE_PAYLOAD_MAX, Introduction, Lane, OUTCOMES, Refusal,
    UNDELIVERED, read, write,
};

/// What the core is set to.
#[derive(Clone, Debug)]
pub(super) struct Settings {
    /// Who we are; `peer` and `dial` are filled in for each hello.
    pub(super) ours: Introduction,
    /// Time for a handshake, and for a refused peer to read why.
    pub(super) handshake: Duration,
    /// First wait before dialling again.
    pub(super) redial_min: Duration,
    /// Longest wait before dialling again, before jitter.
    pub(super) redial_max: Duration,
    /// Connections at most that are not links, of those that we accepted. For a further one one is closed: see `least_wanted`.
    pub(super) strangers_max: usize,
    /// Peers known at most. Further ones are refused.
    pub(super) peers_max: usize,
    /// Silence after which a link is pinged, and time between two pings.
    pub(super) ping_period: Duration,
    /// Silence after which a connection for Stream or for Bulk is pinged that was pinged and answered since messages went over it.
    pub(super) side_rest: Duration,
    /// Pings in a row without an answer after which a link is broken.
    pub(super) pings_missed_max: u32,
    /// Age of a link from which on its break counts as the first one.
    pub(super) healthy: Duration,
    /// Time that a peer's messages are kept without a link, if NDL never told of it.
    pub(super) orphan: Duration,
    /// Whether who says hello on a connection has proven there to be that node, by its keys.
    pub(super) connections_prove: bool,
}

/// One TCP connection, made or accepted. Never used twice.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct ConnectionId(pub(super) u64);

/// What has happened.
#[derive(Clone, Debug)]
pub(super) enum Input {
    /// A former instance of this layer left messages for this peer behind.
    Restored { node: NodeAddress, incarnation: Incarnation },
    /// NDL found a node, which announces these addresses, the one that it prefers first.
    NodeFound { node: NodeAddress, incarnation: Incarnation, addresses: Vec<SocketAddr> },
    /// NDL lost a node.
    NodeLost { node: NodeAddress, incarnation: Incarnation },
    /// NDL lost a node whose address is another process's: that one may be in an elder life.
    NodeDisowned { node: NodeAddress, incarnation: Incarnation },
    /// NDL heard a node say that it leaves. What it had sent before may still be on its way, and its GOODBYE behind that.
    NodeLeaves { node: NodeAddress, incarnation: Incarnation },
    /// The listener accepted a connection from this address; `connection` is from [`Core::open`].
    Accepted(ConnectionId, IpAddr),
    /// A dial reached the peer's host.
    Connected(ConnectionId),
    /// A dial did not.
    DialFailed { connection: ConnectionId, refused: bool },
    /// A first frame came from a dialler.
    HelloReceived(ConnectionId, Introduction),
    /// The answer to our hello came.
    WelcomeReceived(ConnectionId, Introduction),
    /// The peer does not want this connection.
    RefusalReceived(ConnectionId, Refusal),
    /// The peer sent what cannot be used.
    Violated(ConnectionId, Decline),
    /// What this life of a node proved who it is with, when it was linked last, counts no more.
    Disproven { node: NodeAddress, incarnation: Incarnation },
    /// Frames came on a link, the last one then; PING and PONG are not counted. Said before what follows from the time, or from PING and PONG.
    Heard(ConnectionId, Time),
    /// Messages pass on a link.
    Carried(ConnectionId),
    /// The peer asked for a sign of life.
    PingReceived(ConnectionId),
    /// The peer gave one.
    PongReceived(ConnectionId),
    /// The peer said goodbye.
    GoodbyeReceived(ConnectionId),
    /// The connection ended.
    Ended(ConnectionId),
    /// A connection could not be made for want of descriptors or memory.
    Starved,
    /// Time has passed, perhaps up to [`Core::next_wake`].
    TimePassed,
    /// The node is being stopped in order; there are messages for these nodes that are not known to have arrived.
    LeaveRequested { owed: Vec<NodeAddress> },
}

/// What is to be done.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Output {
    /// Connect to `address`; answer with `Connected` or `DialFailed`.
    Dial { connection: ConnectionId, address: SocketAddr },
    /// Send a HELLO.
    SendHello(ConnectionId, Introduction),
    /// The handshake is over: the peer's messages flow on this connection from now on, after the WELCOME if there is
    /// one to send.
    Attach(Attach),
    /// The peer's messages do not flow on this connection any more. A `Close` or a `Refuse` follows.
    Detach { connection: ConnectionId, node: NodeAddress, lane: Lane },
    /// Send a REFUSAL, close our direction, and throw away what still comes until the peer closes its own.
    Refuse(ConnectionId, Refusal),
    /// Close the connection and forget it. No input about it is expected any more.
    Close(ConnectionId),
    /// Send a PING on this connection to the node.
    SendPing(NodeAddress, Lane),
    /// Send a PONG.
    SendPong(NodeAddress, Lane),
    /// Send a GOODBYE on each connection, after all that waits for it.
    SendGoodbye(NodeAddress),
    /// The node, or this life of it, is gone with all that waits for it.
    Forget(NodeAddress),
    /// Tell the other layers.
    Fact(LinkFact),
    /// A connection to the node answers no ping, and is closed: whether the node itself is silent is not known here.
    Silent(NodeAddress),
    /// Count a refusal, ours or the peer's.
    Count { cause: &'static str, detail: String },
}

/// A handshake that has succeeded.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Attach {
    pub(super) connection: ConnectionId,
    pub(super) node: NodeAddress,
    pub(super) incarnation: Incarnation,
    pub(super) lane: Lane,
    /// Whether each class has a connection of its own.
    pub(super) by_class: bool,
    /// Whether the peer takes back what nobody waits for any more.
    pub(super) takes_cancels: bool,
    /// Whether the peer takes several outcomes in one frame.
    pub(super) takes_outcomes: bool,
    /// Whether the peer takes reports of messages that were not delivered.
    pub(super) takes_reports: bool,
    /// Whether values of class Stream may go by datagram.
    pub(super) takes_datagrams: bool,
    /// Whether the peer's frames have guards, and ours.
    pub(super) is_guarded: bool,
    /// Longest payload that the peer takes, in bytes.
    pub(super) payload_max: u64,
    /// Confirmed messages, of each connection, for whose outcomes the peer has room.
    pub(super) answers_max: u64,
    /// To be sent before all else.
    pub(super) welcome: Option<Introduction>,
}

impl Attach {
    /// What the frames on this connection have for a checksum. spec: FRAME-3.1
    pub(super) const fn checksum(&self) -> Checksum {
        if self.is_guarded { Checksum::Guarded } else { Checksum::Crc }
    }
}

/// How far a connection has come.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Stage {
    /// Our dial has not reached the peer's host yet.
    Dialling(NodeAddress, Lane),
    /// Our hello is on its way.
    HelloSent(NodeAddress, Lane),
    /// Accepted; has not said who it is.
    Stranger,
    /// Messages flow.
    Linked(NodeAddress, Lane),
    /// Refused; has not closed its side.
    Leaving,
}

#[derive(Clone, Copy, Debug)]
struct Connection {
    stage: Stage,
    /// From where it was made, if it was accepted.
    from: Option<IpAddr>,
    /// When it is given up; never for a link.
    deadline: Time,
}

/// All that GNCL knows about connections and peers.
#[derive(Debug)]
pub(super) struct Core {
    settings: Settings,
    connections: BTreeMap<ConnectionId, Connection>,
    peers: BTreeMap<NodeAddress, Acquaintance>,
    outputs: VecDeque<Output>,
    /// Where connections of strangers may be those of nodes that were found.
    found_at: FoundAt,
    /// Strangers that are to go, if there are any.
    clearing: Option<Clearing>,
    opened: u64,
    chance: fastrand::Rng,
    leaving: bool,
}

impl Core {
    /// A core that knows nobody; `seed` decides its jitter.
    pub(super) fn new(settings: Settings, seed: u64) -> Self {
        Self {
            settings,
            connections: BTreeMap::new(),
            peers: BTreeMap::new(),
            outputs: VecDeque::new(),
            found_at: FoundAt::default(),
            clearing: None,
            opened: 0,
            chance: fastrand::Rng::with_seed(seed),
            leaving: false,
        }
    }

    /// A name for a connection that was accepted.
    pub(super) const fn open(&mut self) -> ConnectionId {
        self.opened += 1;
        ConnectionId(self.opened)
    }

    /// Whether anything is known of `node`: of so many nodes at most as peers are known at most.
    pub(super) fn knows(&self, node: NodeAddress) -> bool {
        self.peers.contains_key(&node)
    }

    /// Takes note of what happened at `now`.
    pub(super) fn handle(&mut self, now: Time, input: Input) {
        match input {
            Input::Restored { node, incarnation } => self.restored(now, node, incarnation),
            Input::NodeFound { node, incarnation, addresses } => {
                self.found(now, node, incarnation, addresses)
            }
            Input::NodeLost { node, incarnation } => self.lost(now, node, incarnation),
            Input::NodeDisowned { node, incarnation } => self.disowned(now, node, incarnation),
            Input::NodeLeaves { node, incarnation } => self.leaves(now, node, incarnation),
            Input::Accepted(connection, from) => self.accepted(now, connection, from),
            Input::Connected(connection) => self.connected(now, connection),
            Input::DialFailed { connection, refused } => self.dial_failed(now, connection, refused),
            Input::HelloReceived(connection, hello) => self.hello(now, connection, &hello),
            Input::WelcomeReceived(connection, welcome) => self.welcome(now, connection, &welcome),
            Input::RefusalReceived(connection, refusal) => self.refused(now, connection, &refusal),
            Input::Violated(connection, decline) => self.decline(now, connection, &decline),
            Input::Disproven { node, incarnation } => self.disproven(now, node, incarnation),
            Input::Heard(connection, at) => self.heard(at, connection),
            Input::Carried(connection) => self.carried(connection),
            Input::PongReceived(connection) => self.lives(now, connection),
            Input::PingReceived(connection) => {
                self.lives(now, connection);
                let pong = self.linked(connection).map(|(node, lane)| Output::SendPong(node, lane));
                self.outputs.extend(pong);
            }
            Input::GoodbyeReceived(connection) => self.goodbye(now, connection),
            Input::Ended(connection) => self.ended(now, connection),
            Input::Starved => self.starved(now),
            Input::TimePassed => self.time_passed(now),
            Input::LeaveRequested { owed } => self.leave(now, &owed),
        }
    }

    /// The next thing to do.
    pub(super) fn poll(&mut self) -> Option<Output> {
        self.outputs.pop_front()
    }

    /// When to say [`Input::TimePassed`], if nothing else happens before.
    pub(super) fn next_wake(&self) -> Option<Time> {
        let deadlines = self.connections.values().map(|connection| connection.deadline);
        let peers = self.peers.values().filter_map(|peer| peer.next_wake(&self.settings));
        let clearing = self.clearing.as_ref().map(|clearing| clearing.next);
        deadlines.chain(peers).chain(clearing).filter(|at| *at != Time::MAX).min()
    }

    fn time_passed(&mut self, now: Time) {
        self.forgive_our_own_lateness(now);
        self.clear_further(now);
        let over = self.connections.iter().filter(|(_, connection)| connection.deadline <= now);
        let over: Vec<_> = over.map(|(id, connection)| (*id, connection.stage)).collect();
        for (connection, stage) in over {
            // One that makes room for another is gone by then.
            if self.stage(connection) == Some(stage) {
                self.timed_out(now, connection, stage);
            }
        }
        let due =
            self.peers.iter().filter(|(_, peer)| peer.next_wake(&self.settings).is_some_and(|at| at <= now));
        let due: Vec<_> = due.map(|(node, _)| *node).collect();
        for node in due {
            self.peer_due(now, node);
        }
    }

    /// A node whose own thread was held up may not blame its peers for the silence.
    fn forgive_our_own_lateness(&mut self, now: Time) {
        let late = self.next_wake().map_or(Duration::ZERO, |due| now.since(due));
        if late <= self.settings.ping_period / 2 {
            return;
        }
        for link in self.peers.values_mut().filter_map(|peer| peer.link.as_mut()) {
            link.pulses().for_each(|pulse| pulse.forgive(now, late));
        }
    }

    fn fact(&mut self, fact: LinkFact) {
        self.outputs.push_back(Output::Fact(fact));
    }

    fn count(&mut self, cause: &'static str, detail: String) {
        self.outputs.push_back(Output::Count { cause, detail });
    }

    fn stage(&self, connection: ConnectionId) -> Option<Stage> {
        self.connections.get(&connection).map(|connection| connection.stage)
    }

    fn linked(&self, connection: ConnectionId) -> Option<(NodeAddress, Lane)> {
        match self.stage(connection)? {
            Stage::Linked(node, lane) => Some((node, lane)),
            Stage::Dialling(..) | Stage::HelloSent(..) | Stage::Stranger | Stage::Leaving => None,
        }
    }

    /// The next number of a seeded sequence in `0.0..1.0`.
    fn chance(&mut self) -> f64 {
        self.chance.f64()
    }
}
