//! What another node is to the senders of this one: an outlet that outlives connections and restarts of this layer.

use std::{
    collections::BTreeMap,
    net::Shutdown,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
};

use bytes::Bytes;
use sinew_runtime::{
    outcome::{Outcome, ReceiptSink, Rejection, Ticket},
    router::{Outlet, Refused},
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    time::Time,
    wire::{Header, Kind, Message},
};
use socket2::SockRef;
use tokio::net::TcpStream;

use super::core::{Decline, write};
use crate::{
    config::NodeConfig,
    outlet::{LinkNumber, OutletLimits, Session, StreamOutlet},
    refusals::Refusals,
    session::{Ack, Arrival, Receiving, Window},
    stores::{Stores, lock},
};

/// Bytes of frames for one peer that are kept unacknowledged, from which on further messages wait.
const WINDOW_BYTES: usize = 4 << 20;
/// Messages that are kept at most: half of what their numbers' 16 bits on the wire can tell apart.
const WINDOW_MESSAGES_MAX: usize = 1 << 15;
/// Frames of this layer itself that wait for a socket at most: more than a peer's ACKs, PINGs and PONGs ever are.
const WORDS_MAX: usize = 32;

/// What all peers of a node share.
struct Setting<'a> {
    config: &'a NodeConfig,
    refusals: &'a Arc<Refusals>,
}

/// One life of another node, from its first link until it is forgotten.
pub(crate) struct Peer {
    pub(crate) node: NodeAddress,
    pub(crate) incarnation: Incarnation,
    pub(crate) outlet: StreamOutlet<Arc<TcpStream>>,
    /// What was taken of its messages. Locked for a moment, never with another lock in hand.
    receiving: Mutex<Receiving>,
    here: NodeAddress,
    refusals: Arc<Refusals>,
}

impl Peer {
    /// `now` numbers what is remembered of the peer: a later peer of the same life has a larger number.
    fn new(
        now: Time,
        here: NodeAddress,
        node: NodeAddress,
        incarnation: Incarnation,
        setting: Setting<'_>,
    ) -> Self {
        let Setting { config, refusals } = setting;
        let limits = OutletLimits {
            queue_capacity: config.gncl.queue_capacity,
            queue_bytes: config.gncl.queue_bytes,
            unconfirmed_max: config.gncl.queue_capacity,
            payload_max: config.payload_max,
        };
        let messages = config.gncl.queue_capacity.min(WINDOW_MESSAGES_MAX);
        let window = Window { messages, bytes: WINDOW_BYTES };
        let (memory, void) = (now.as_nanos(), frame(here, node, Kind::GNCL_VOID, Bytes::new()).header);
        let outlet = StreamOutlet::with_session(limits, Session::new(memory, window, void));
        let receiving = Mutex::new(Receiving::new(memory));
        Self { node, incarnation, outlet, receiving, here, refusals: refusals.clone() }
    }

    /// Its messages come on `link` from now on, and are taken from no other.
    pub(super) fn attach(&self, link: LinkNumber) {
        self.receiving().attach(link.number());
        self.acknowledge();
    }

    /// A message came on `link`. Returns whether it is to be taken.
    ///
    /// # Errors
    /// It is not the next one.
    pub(super) fn arrive(&self, link: LinkNumber, message: &Message) -> Result<bool, Decline> {
        let number = message.header.number;
        let arrival = self.receiving().arrive(link.number(), number, message.size());
        match arrival {
            Arrival::Take { ack_is_due } => {
                if ack_is_due {
                    self.acknowledge();
                }
                Ok(true)
            }
            Arrival::Fenced => Ok(false),
            Arrival::OutOfStep { expected } => Err(Decline::Violation(format!(
                "message {number} came where {} is the next one",
                expected as u16
            ))),
        }
    }

    /// The peer says what it has taken.
    pub(super) fn heard(&self, link: LinkNumber, ack: &Ack, now: Time) {
        let counts = self.receiving().heard(link.number(), ack.epoch);
        if counts && self.outlet.heard(link, ack, now) {
            self.refusals.count(
                now,
                "session begun anew",
                &format!("node {} does not know what it took; what it was sent ends as Unknown", self.node),
            );
            self.acknowledge();
        }
    }

    /// Tells the peer what was taken, if it does not know.
    pub(super) fn acknowledge_if_owed(&self) {
        let owes = self.receiving().owes_ack();
        if owes {
            self.acknowledge();
        }
    }

    fn acknowledge(&self) {
        let epoch = self.outlet.epoch();
        let ack = self.receiving().ack(epoch);
        self.say(frame(self.here, self.node, Kind::GNCL_ACK, write(&ack)));
    }

    fn receiving(&self) -> MutexGuard<'_, Receiving> {
        self.receiving.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Says something on the present connection, ahead of all that waits. Without one nobody needs it.
    pub(super) fn say(&self, message: Message) {
        if let Err(refused) = self.outlet.submit_urgent(message, WORDS_MAX)
            && refused.why == Rejection::QueueFull
        {
            let detail = format!("a frame of kind {} for node {}", refused.message.header.kind, self.node);
            self.refusals.count(Time::now(), "own frame not sent", &detail);
        }
    }

    /// Sends a frame of this layer itself.
    pub(super) fn send(&self, message: Message) {
        if let Err(refused) = self.outlet.submit(message) {
            let kind = refused.message.header.kind;
            let detail = format!("a frame of kind {kind} for node {}: {}", self.node, refused.why);
            self.refusals.count(Time::now(), "own frame not sent", &detail);
        }
    }
}

impl Outlet for Peer {
    fn submit(&self, message: Message) -> Result<(), Refused> {
        self.outlet.submit(message)
    }
}

/// The outcome of a message that came from this peer goes back to it. spec: GNCL-12
impl ReceiptSink for Peer {
    fn settle(&self, ticket: Ticket, outcome: Outcome) {
        let mut said = Message::outcome(ticket, outcome);
        said.header.sent = Time::now();
        self.send(said);
    }
}

/// A frame from this node's GNCL to that of `node`.
pub(super) fn frame(here: NodeAddress, node: NodeAddress, kind: Kind, payload: Bytes) -> Message {
    let mut header = Header::new(kind, Tid::new(here, AppAddress::GNCL), Tid::new(node, AppAddress::GNCL));
    header.sent = Time::now();
    Message::new(header, payload)
}

/// What of GNCL outlives a restart of it.
#[derive(Default)]
pub(crate) struct Store {
    peers: Mutex<BTreeMap<NodeAddress, Arc<Peer>>>,
    /// The socket that listens. It stays open while this layer is restarted: a peer that is refused would say that this
    /// node is lost.
    pub(super) listener: Mutex<Option<std::net::TcpListener>>,
    /// What GNCL refused, and why.
    pub(crate) refusals: Arc<Refusals>,
}

impl Store {
    /// The peers that are known now.
    pub(crate) fn peers(&self) -> Vec<Arc<Peer>> {
        self.lock().values().cloned().collect()
    }

    /// The peer at `node`.
    pub(crate) fn peer(&self, node: NodeAddress) -> Option<Arc<Peer>> {
        self.lock().get(&node).cloned()
    }

    /// The peer at `node` in this life of it, made if need be. An older life is closed.
    pub(super) fn meet(
        &self,
        now: Time,
        node: NodeAddress,
        incarnation: Incarnation,
        stores: &Stores,
    ) -> Arc<Peer> {
        match self.peer(node) {
            Some(peer) if peer.incarnation == incarnation => return peer,
            Some(_) => self.forget(node),
            None => {}
        }
        let setting = Setting { config: &stores.config, refusals: &self.refusals };
        let peer = Arc::new(Peer::new(now, stores.node, node, incarnation, setting));
        self.lock().insert(node, peer.clone());
        peer
    }

    /// Nothing reaches `node` any more: what waits for it is lost, and says so.
    pub(super) fn forget(&self, node: NodeAddress) {
        let peer = self.lock().remove(&node);
        // Closed without the lock: whoever is told of an outcome may ask for a peer.
        if let Some(peer) = peer {
            peer.outlet.close(Rejection::NoSuchNode);
        }
    }

    /// Nobody connects any more, and the port is free, whoever still holds the socket.
    pub(crate) fn close(&self) {
        if let Some(listener) = lock(&self.listener).take() {
            // An error says that it does not listen any more.
            let _ = SockRef::from(&listener).shutdown(Shutdown::Both);
        }
    }

    fn lock(&self) -> MutexGuard<'_, BTreeMap<NodeAddress, Arc<Peer>>> {
        self.peers.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
