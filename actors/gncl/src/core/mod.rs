//! GNCL without sockets and clocks: which peers are dialled, which are refused, and which of several
//! connections is kept.
//!
//! **After each `Core::handle`, drain `Core::poll` until it is `None`, then sleep until `Core::next_wake`.**
//!
//! ```text
//!  dialler    Dialling ── connected ──► HelloSent ── WELCOME ──► Linked
//!  acceptor   Stranger ── HELLO ──► (WELCOME) ──────────────────► Linked
//!  lanes      Linked, both know classes: the dialler dials again for Stream and for Bulk, until the link ends
//!  either     any of them ── refused ──► Leaving (until the peer has read the words, or the time is over)
//! ```

mod connections;
mod dials;
#[cfg(feature = "fuzzing")]
pub(super) mod fuzzing;
mod handshake;
mod lane_connections;
mod links;
mod peer_state;
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

use connections::{Clearing, FoundAt};
pub use handshake::{
    CANCEL, CLASSES, DATAGRAMS, GUARD, HANDSHAKE_PAYLOAD_MAX, Introduction, Lane, OUTCOME_RUNS, OUTCOMES,
    Refusal, RefusalError, UNDELIVERED, read, write,
};
use peer_state::PeerState;
use sinew_model::facts::LinkFact;

/// Settings of the core.
#[derive(Clone, Debug)]
pub struct Settings {
    /// The local introduction; `peer` and `dial` are filled in for each HELLO.
    pub ours: Introduction,
    /// Time for a handshake, and for a refused peer to read the reason.
    pub handshake: Duration,
    /// First delay before dialling again.
    pub redial_min: Duration,
    /// Longest delay before dialling again, before jitter.
    pub redial_max: Duration,
    /// Maximum number of accepted connections that are not links. For a further one an existing one is
    /// closed: see `eviction_order`.
    pub strangers_max: usize,
    /// Maximum number of known peers. Further ones are refused.
    pub peers_max: usize,
    /// Silence after which a link is pinged, and time between two pings.
    pub ping_period: Duration,
    /// Silence after which a connection for Stream or for Bulk gets a PING, if only PINGs and their answers
    /// were exchanged since the last message.
    pub idle_ping_delay: Duration,
    /// Number of consecutive unanswered PINGs after which a link is broken.
    pub pings_missed_max: u32,
    /// Age of a link after which its break counts as the first one.
    pub healthy: Duration,
    /// Time for which a peer's messages are kept without a link, if NDL never reported the peer.
    pub orphan: Duration,
    /// Whether connections authenticate their peers by keys before HELLO.
    pub connections_authenticate: bool,
}

/// Identifies one TCP connection, dialled or accepted. Never reused.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct ConnectionId(pub u64);

/// Events.
#[derive(Clone, Debug)]
pub enum Input {
    /// A former instance of this layer has left messages for this peer.
    Restored { node: NodeAddress, incarnation: Incarnation },
    /// NDL found a node that announces these addresses, the preferred one first.
    NodeFound { node: NodeAddress, incarnation: Incarnation, addresses: Vec<SocketAddr> },
    /// NDL lost a node.
    NodeLost { node: NodeAddress, incarnation: Incarnation },
    /// NDL lost a node, and its address belongs to another process, which may have an older incarnation.
    NodeDisowned { node: NodeAddress, incarnation: Incarnation },
    /// NDL received a node's announcement that it leaves. Its earlier messages may still be in flight, with
    /// its GOODBYE behind them.
    NodeLeaves { node: NodeAddress, incarnation: Incarnation },
    /// The listener accepted a connection from this address; `connection` is from [`Core::open`].
    Accepted(ConnectionId, IpAddr),
    /// A dial reached the peer's host.
    Connected(ConnectionId),
    /// A dial failed.
    DialFailed { connection: ConnectionId, refused: bool },
    /// A first frame arrived from a dialler.
    HelloReceived(ConnectionId, Introduction),
    /// The answer to the local HELLO arrived.
    WelcomeReceived(ConnectionId, Introduction),
    /// The peer refuses this connection.
    RefusalReceived(ConnectionId, Refusal),
    /// The peer sent an invalid frame.
    Violated(ConnectionId, RefusalError),
    /// The credentials with which this incarnation authenticated its last link are no longer valid.
    CredentialsRevoked { node: NodeAddress, incarnation: Incarnation },
    /// Frames other than PING and PONG arrived on a link, the last one at this time. Reported before inputs
    /// that depend on it: the passing of time, PING and PONG.
    FramesReceived(ConnectionId, Time),
    /// Messages are exchanged on a link.
    TrafficSeen(ConnectionId),
    /// The peer sent PING.
    PingReceived(ConnectionId),
    /// The peer sent PONG.
    PongReceived(ConnectionId),
    /// The peer sent GOODBYE.
    GoodbyeReceived(ConnectionId),
    /// The connection ended.
    Ended(ConnectionId),
    /// A connection failed for lack of descriptors or memory.
    Starved,
    /// Time has passed, perhaps up to [`Core::next_wake`].
    TimePassed,
    /// The node is being stopped in order. Messages for these nodes are not known to have arrived.
    LeaveRequested { undelivered_to: Vec<NodeAddress> },
}

/// Actions for the shell.
#[derive(Clone, Debug, PartialEq)]
pub enum Output {
    /// Connect to `address`; answer with `Connected` or `DialFailed`.
    Dial { connection: ConnectionId, address: SocketAddr },
    /// Send a HELLO.
    SendHello(ConnectionId, Introduction),
    /// The handshake is complete. The peer's messages are sent on this connection from now on, after the
    /// WELCOME if there is one.
    Attach(Attach),
    /// The peer's messages are no longer sent on this connection. A `Close` or a `Refuse` follows.
    Detach { connection: ConnectionId, node: NodeAddress, lane: Lane },
    /// Send a REFUSAL, close the local direction, and discard received frames until the peer closes its own.
    Refuse(ConnectionId, Refusal),
    /// Close the connection and forget it. No further input about it is expected.
    Close(ConnectionId),
    /// Send a PING on this connection to the node.
    SendPing(NodeAddress, Lane),
    /// Send a PONG.
    SendPong(NodeAddress, Lane),
    /// Send a GOODBYE on each connection, behind all queued messages.
    SendGoodbye(NodeAddress),
    /// The node, or this incarnation of it, is removed with all queued messages.
    Forget(NodeAddress),
    /// Notify the other layers.
    Fact(LinkFact),
    /// A connection to the node answers no PING, and is closed. It is unknown whether the node itself is silent.
    Silent(NodeAddress),
    /// Count a refusal, local or remote.
    Count { cause: &'static str, detail: String },
}

/// A handshake that has succeeded.
#[derive(Clone, Debug, PartialEq)]
pub struct Attach {
    pub connection: ConnectionId,
    pub node: NodeAddress,
    pub incarnation: Incarnation,
    pub lane: Lane,
    /// Whether each class has a connection of its own.
    pub by_class: bool,
    /// Whether the peer accepts cancellations of requests.
    pub takes_cancels: bool,
    /// Whether the peer accepts several outcomes in one frame.
    pub takes_outcomes: bool,
    /// Whether the peer accepts runs of outcomes.
    pub takes_outcome_runs: bool,
    /// Whether the peer accepts reports of undelivered messages.
    pub takes_reports: bool,
    /// Whether values of class Stream may be sent by datagram.
    pub takes_datagrams: bool,
    /// Whether the frames of both sides have guards.
    pub is_guarded: bool,
    /// Longest payload that the peer accepts, in bytes.
    pub payload_max: u64,
    /// Number of confirmed messages, per connection, for which the peer has room for outcomes.
    pub answers_max: u64,
    /// The WELCOME to send before all other frames.
    pub welcome: Option<Introduction>,
}

impl Attach {
    /// Returns the checksum of the frames on this connection. spec: FRAME-3.1
    pub const fn checksum(&self) -> Checksum {
        if self.is_guarded { Checksum::Guarded } else { Checksum::Crc }
    }
}

/// The stage of a connection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Stage {
    /// The local dial has not reached the peer's host yet.
    Dialling(NodeAddress, Lane),
    /// The local HELLO has been sent.
    HelloSent(NodeAddress, Lane),
    /// The connection was accepted, and has not sent HELLO.
    Stranger,
    /// Messages are exchanged.
    Linked(NodeAddress, Lane),
    /// The connection was refused, and the peer has not closed its direction.
    Leaving,
}

#[derive(Clone, Copy, Debug)]
struct Connection {
    stage: Stage,
    /// The source address, if it was accepted.
    from: Option<IpAddr>,
    /// Time at which it is given up; never for a link.
    deadline: Time,
}

/// GNCL's state of connections and peers.
#[derive(Debug)]
pub struct Core {
    settings: Settings,
    connections: BTreeMap<ConnectionId, Connection>,
    peers: BTreeMap<NodeAddress, PeerState>,
    outputs: VecDeque<Output>,
    /// Addresses from which unauthenticated connections may be those of found nodes.
    found_at: FoundAt,
    /// Unauthenticated connections that are being closed, if any.
    clearing: Option<Clearing>,
    opened: u64,
    chance: fastrand::Rng,
    leaving: bool,
}

impl Core {
    /// Creates a core without peers; `seed` determines its jitter.
    pub fn new(settings: Settings, seed: u64) -> Self {
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

    /// Returns an identifier for an accepted connection.
    pub const fn open(&mut self) -> ConnectionId {
        self.opened += 1;
        ConnectionId(self.opened)
    }

    /// Whether `node` is known. The number of known nodes is bounded by the maximum number of peers.
    pub fn is_known(&self, node: NodeAddress) -> bool {
        self.peers.contains_key(&node)
    }

    /// Processes an event that happened at `now`.
    pub fn handle(&mut self, now: Time, input: Input) {
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
            Input::CredentialsRevoked { node, incarnation } => {
                self.credentials_revoked(now, node, incarnation)
            }
            Input::FramesReceived(connection, at) => self.frames_received(at, connection),
            Input::TrafficSeen(connection) => self.traffic_seen(connection),
            Input::PongReceived(connection) => self.liveness_received(now, connection),
            Input::PingReceived(connection) => {
                self.liveness_received(now, connection);
                let pong = self.linked(connection).map(|(node, lane)| Output::SendPong(node, lane));
                self.outputs.extend(pong);
            }
            Input::GoodbyeReceived(connection) => self.goodbye(now, connection),
            Input::Ended(connection) => self.ended(now, connection),
            Input::Starved => self.starved(now),
            Input::TimePassed => self.time_passed(now),
            Input::LeaveRequested { undelivered_to } => self.leave(now, &undelivered_to),
        }
    }

    /// Returns the next action.
    pub fn poll(&mut self) -> Option<Output> {
        self.outputs.pop_front()
    }

    /// Returns when to pass [`Input::TimePassed`], unless another event happens before.
    pub fn next_wake(&self) -> Option<Time> {
        let deadlines = self.connections.values().map(|connection| connection.deadline);
        let peers = self.peers.values().filter_map(|peer| peer.next_wake(&self.settings));
        let clearing = self.clearing.as_ref().map(|clearing| clearing.next);
        deadlines.chain(peers).chain(clearing).filter(|at| *at != Time::MAX).min()
    }

    fn time_passed(&mut self, now: Time) {
        self.exclude_local_delay(now);
        self.close_next_batch(now);
        let over = self.connections.iter().filter(|(_, connection)| connection.deadline <= now);
        let over: Vec<_> = over.map(|(id, connection)| (*id, connection.stage)).collect();
        for (connection, stage) in over {
            // A connection that was closed to make room for another does not exist any more.
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

    /// Excludes the delay of the local thread from the silence of peers.
    fn exclude_local_delay(&mut self, now: Time) {
        let late = self.next_wake().map_or(Duration::ZERO, |due| now.since(due));
        if late <= self.settings.ping_period / 2 {
            return;
        }
        for link in self.peers.values_mut().filter_map(|peer| peer.link.as_mut()) {
            link.keepalives().for_each(|keepalive| keepalive.exclude_delay(now, late));
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

    /// Returns the next number of a seeded sequence in `0.0..1.0`.
    fn chance(&mut self) -> f64 {
        self.chance.f64()
    }
}
