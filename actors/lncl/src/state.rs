//! The state of LNCL that outlives its actor.

use std::{
    hash::{BuildHasher, RandomState},
    os::unix::net::UnixListener,
    path::Path,
    sync::{Arc, Mutex},
};

#[cfg(any(test, feature = "testing"))]
use sinew_model::config::NodeConfig;
use sinew_model::{context::NodeContext, guest_quotas::GuestQuotas};
#[cfg(any(test, feature = "testing"))]
use sinew_runtime::tid::Incarnation;
use sinew_security::SecurityState;
use sinew_session::book::Book;

use super::{
    ClientSocket, Commands, ListenError, Registry, SocketAccess, observed_links::ObservedLinks,
    undelivered::Undelivered,
};

/// The state of LNCL that outlives its actor. The node's root lends it to each new instance.
pub struct State {
    /// What all layers share.
    pub ctx: Arc<NodeContext>,
    /// The security in force.
    pub security: Arc<SecurityState>,
    /// The socket through which other processes connect.
    pub client_socket: ClientSocket,
    /// The applications that are registered on this node.
    pub registry: Mutex<Registry>,
    /// The commands that the node supervises.
    pub commands: Commands,
    /// The quota of messages that guests (clients of other users) may have queued at the layers.
    pub guest_quotas: GuestQuotas,
    /// Unconfirmed messages that were refused without a report to their senders.
    pub undelivered: Arc<Undelivered>,
    /// The clients with direct links, and which of them are watched.
    pub observed_links: ObservedLinks,
    /// Counts messages, except those of GNCL's peers.
    pub book: Book,
}

impl State {
    /// Returns the state of a node that has not started yet.
    pub fn new(ctx: Arc<NodeContext>, security: Arc<SecurityState>) -> Arc<Self> {
        let undelivered = Undelivered::new(ctx.node, ctx.event_queues.lncl.clone(), ctx.checks.clone());
        ctx.router.set_refusal_sink(undelivered.clone());
        Arc::new(Self {
            ctx,
            security,
            client_socket: ClientSocket::default(),
            registry: Mutex::new(Registry::counting_links_from(RandomState::new().hash_one(()))),
            commands: Commands::default(),
            guest_quotas: GuestQuotas::default(),
            undelivered,
            observed_links: ObservedLinks::default(),
            book: Book::default(),
        })
    }

    /// Opens the socket for other processes at `path`, if it is not open already.
    ///
    /// # Errors
    /// Returns the cause and the remedy.
    pub fn open_client_socket(&self, path: &Path) -> Result<UnixListener, ListenError> {
        let has_clients = self.security.access.get().is_some_and(|access| access.has_clients());
        self.client_socket.open(path, if has_clients { SocketAccess::AnyUser } else { SocketAccess::Own })
    }

    /// Returns the state of a node that has only this layer.
    #[cfg(any(test, feature = "testing"))]
    pub fn for_test(config: NodeConfig, incarnation: Incarnation) -> Arc<Self> {
        Self::new(NodeContext::for_test(config, incarnation).0, Arc::default())
    }
}
