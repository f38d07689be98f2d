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

use crate::{
    config::NodeConfig,
    outlet::{OutletLimits, StreamOutlet},
    refusals::Refusals,
    stores::lock,
};

/// One life of another node, from its first link until it is forgotten.
pub(crate) struct Peer {
    pub(crate) node: NodeAddress,
    pub(crate) incarnation: Incarnation,
    pub(crate) outlet: StreamOutlet<Arc<TcpStream>>,
    refusals: Arc<Refusals>,
}

impl Peer {
    fn new(
        node: NodeAddress,
        incarnation: Incarnation,
        config: &NodeConfig,
        refusals: Arc<Refusals>,
    ) -> Self {
        let limits = OutletLimits {
            queue_capacity: config.gncl.queue_capacity,
            unconfirmed_max: config.gncl.queue_capacity,
            payload_max: config.payload_max,
        };
        Self { node, incarnation, outlet: StreamOutlet::new(limits), refusals }
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
    pub(super) fn meet(&self, node: NodeAddress, incarnation: Incarnation, config: &NodeConfig) -> Arc<Peer> {
        match self.peer(node) {
            Some(peer) if peer.incarnation == incarnation => return peer,
            Some(_) => self.forget(node),
            None => {}
        }
        let peer = Arc::new(Peer::new(node, incarnation, config, self.refusals.clone()));
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
