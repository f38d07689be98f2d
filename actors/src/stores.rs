//! State that outlives every layer: owned by the node's root, lent to each new instance of a layer.

use std::{
    hash::{BuildHasher, RandomState},
    net::{SocketAddr, SocketAddrV4},
    os::unix::net::UnixListener,
    path::Path,
    sync::{
        Arc, Mutex, MutexGuard, OnceLock, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
};

use sinew_runtime::{
    post::Post,
    router::Router,
    tid::{AppAddress, Incarnation, NodeAddress},
};
use tokio::sync::watch;

use crate::{
    access::Access, aftermath::Aftermath, audit, clocks::ClockOffsets, config::NodeConfig, gncl,
    last_words::LastWords, lncl, log_quotas::LogQuotas, monitors, ndl, node, refusals::Refusals,
    secured::Secured, sync, undelivered::Undelivered, wills,
};

/// What the layers of one node share.
pub(crate) struct Stores {
    /// The node's configuration, checked.
    pub(crate) config: NodeConfig,
    /// The node's address.
    pub(crate) node: NodeAddress,
    /// Which life of the node this is.
    pub(crate) incarnation: Incarnation,
    /// Set by the root before it stops the layers: those that say goodbye to others do so only then, not when one of them
    /// is restarted.
    pub(crate) stopping: AtomicBool,
    /// Why the node gave up; peers are sent it instead of an orderly goodbye. Set before `stopping`.
    pub(crate) gave_up: OnceLock<LastWords>,
    /// Where messages go.
    pub(crate) router: Arc<Router>,
    /// Events into each layer.
    pub(crate) posts: Posts,
    /// How far each peer's clock is from ours; written by NDL, read by GNCL.
    pub(crate) clocks: ClockOffsets,
    /// How peers prove who they are, and this node to them; not set: it is open. Set before any layer starts.
    pub(crate) secured: OnceLock<Secured>,
    /// Who may send what to whom; not set: everybody everything. Set before any layer starts.
    pub(crate) access: OnceLock<Arc<Access>>,
    /// Address of GNCL's listener, known once it listens; announced by NDL. A restarted GNCL has the same listener.
    pub(crate) gncl_listen: OnceLock<SocketAddr>,
    /// Where GNCL listens besides; set with it.
    pub(crate) gncl_further: OnceLock<Vec<SocketAddrV4>>,
    /// TCP port at which GNCL listens at this host's IPv6 addresses, if it does; set with it.
    pub(crate) gncl_port6: OnceLock<u16>,
    /// What LNCL, the sync manager and NDL's sockets refused.
    pub(crate) refusals: Arc<Refusals>,
    /// Unconfirmed messages that were refused, and of which their senders were not told.
    pub(crate) undelivered: Arc<Undelivered>,
    /// GNCL's peers with the messages that wait for them, and what GNCL refused.
    pub(crate) gncl: gncl::Store,
    /// NDL's sockets for queries and answers. They stay open while this layer is restarted.
    pub(crate) ndl_sockets: Mutex<ndl::Sockets>,
    /// After how many changes that was so what the file of remembered peers has. Held by who writes it, and never by a layer's own thread.
    pub(crate) ndl_file: Mutex<u64>,
    /// What is to be told of nodes' ends behind their last messages.
    pub(crate) aftermath: Aftermath,
    /// Which nodes are there; a restarted NDL goes on with them.
    pub(crate) ndl: Mutex<ndl::Core>,
    /// What other layers have not been told of that, because their posts were full.
    pub(crate) untold: ndl::Untold,
    /// The same of links.
    pub(crate) untold_of_links: gncl::Untold,
    /// The same of this node's applications.
    pub(crate) untold_of_apps: lncl::Untold,
    /// Where other processes come in.
    pub(crate) door: lncl::Door,
    /// Who is registered on this node.
    pub(crate) registry: Mutex<lncl::Registry>,
    /// What guests have waiting at layers.
    pub(crate) shares_of_guests: lncl::Shares,
    /// Counts the changes of who has which name, on this node or any.
    pub(crate) directory_changes: watch::Sender<u64>,
    /// Who is known on other nodes, and what waits for whom.
    pub(crate) sync: Mutex<sync::Core>,
    /// The sync manager was told that groups have changed, and has not looked yet.
    groups_told: AtomicBool,
    /// How many lines others may cause in the log.
    pub(crate) log_quotas: LogQuotas,
    /// Where messages are counted, beside GNCL's peers.
    pub(crate) book: audit::Book,
    /// Who was asked for an audit, and who has asked.
    pub(crate) questions: audit::Questions,
    /// Who watches whom.
    pub(crate) monitors: Mutex<monitors::Core>,
    /// The last wills of applications, held for other nodes and by them.
    pub(crate) wills: Mutex<wills::Core>,
    /// Where faults strike on purpose.
    #[cfg(feature = "fault-points")]
    pub(crate) faults: sinew_runtime::supervision::fault::FaultPoints,
}

/// Events that wait for a layer at most. A layer that falls this far behind has a fault of its own.
pub(crate) const POST_CAPACITY: usize = 8_192;

impl Stores {
    /// The stores of a node that has not started yet.
    pub(crate) fn new(config: NodeConfig, incarnation: Incarnation) -> Arc<Self> {
        let node = config.node_address();
        let (router, posts) = (Arc::new(Router::new(node)), Posts::new());
        let undelivered = Undelivered::new(node, posts.lncl.clone());
        router.set_refusal_sink(undelivered.clone());
        Arc::new(Self {
            node,
            incarnation,
            stopping: AtomicBool::new(false),
            gave_up: OnceLock::new(),
            router,
            posts,
            undelivered,
            clocks: ClockOffsets::default(),
            secured: OnceLock::new(),
            access: OnceLock::new(),
            gncl_listen: OnceLock::new(),
            gncl_further: OnceLock::new(),
            gncl_port6: OnceLock::new(),
            refusals: Arc::default(),
            gncl: gncl::Store::default(),
            ndl_sockets: Mutex::default(),
            ndl_file: Mutex::default(),
            aftermath: Aftermath::default(),
            ndl: Mutex::new(ndl::new_core(&config, node, incarnation)),
            untold: ndl::Untold::new(config.ndl.nodes_max),
            untold_of_links: gncl::Untold::new(config.ndl.nodes_max),
            untold_of_apps: lncl::Untold::new(),
            door: lncl::Door::default(),
            registry: Mutex::new(lncl::Registry::counting_links_from(RandomState::new().hash_one(()))),
            shares_of_guests: lncl::Shares::default(),
            directory_changes: watch::Sender::default(),
            sync: Mutex::new(sync::Core::new(&config, node, incarnation)),
            groups_told: AtomicBool::new(false),
            log_quotas: LogQuotas::default(),
            book: audit::Book::default(),
            questions: audit::Questions::default(),
            monitors: Mutex::new(monitors::Core::new(
                node,
                incarnation,
                config.ndl.nodes_max,
                config.payload_max,
            )),
            wills: Mutex::new(wills::Core::new(incarnation, config.ndl.nodes_max, config.payload_max)),
            config,
            #[cfg(feature = "fault-points")]
            faults: sinew_runtime::supervision::fault::FaultPoints::default(),
        })
    }

    /// The node has ended: what it was reached by is free for another one, even where a thread that hangs still holds it.
    pub(crate) fn close(&self) {
        self.door.close();
        self.router.remove_local(AppAddress::INSPECT);
        self.gncl.close();
        self.gncl.end_threads();
        lock(&self.ndl_sockets).close_all();
    }

    /// Groups have changed: whether the sync manager has to be told. It looks at all groups, so one word does for all changes until then,
    /// and whoever joins and leaves without end cannot fill its post.
    pub(crate) fn groups_are_to_be_told(&self) -> bool {
        !self.groups_told.swap(true, Ordering::AcqRel)
    }

    /// The sync manager is about to look at the groups: the next change is to be told.
    pub(crate) fn groups_are_looked_at(&self) {
        // Not a store: what was changed before a word that was saved must be seen by whoever looks now.
        self.groups_told.swap(false, Ordering::AcqRel);
    }

    /// Somebody has a name that he had not, or has it no more, on this node or another. Said after the change and before
    /// whoever caused it hears that it is done.
    pub(crate) fn directory_has_changed(&self) {
        self.directory_changes.send_modify(|count| *count += 1);
    }

    /// Opens the door for other processes at `path`, if it is not open already.
    ///
    /// # Errors
    /// Why not, with what to do about it.
    pub(crate) fn open_door(&self, path: &Path) -> Result<UnixListener, lncl::ListenError> {
        let has_clients = self.access.get().is_some_and(|access| access.has_clients());
        self.door.open(path, if has_clients { lncl::Openers::Everybody } else { lncl::Openers::Own })
    }

    /// Puts an access list in force, for all that is sent from now on.
    pub(crate) fn guard(&self, access: Arc<Access>) {
        self.router.set_guard(access.clone());
        // There is one for each node, set once: whoever sets a second one keeps it for itself.
        let _ = self.access.set(access);
    }

    /// The stores of a node that has only the layers that a test starts.
    #[cfg(test)]
    pub(crate) fn for_test(config: NodeConfig, incarnation: Incarnation) -> Arc<Self> {
        Self::new(config, incarnation)
    }
}

/// Locks a mutex whose data are whole at every instant that a panic can strike.
pub(crate) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The posts of the layers.
pub(crate) struct Posts {
    pub(crate) root: Post<node::RootEvent>,
    pub(crate) lncl: Post<lncl::Event>,
    pub(crate) sync: Post<sync::Event>,
    pub(crate) gncl: Post<gncl::Event>,
    pub(crate) ndl: Post<ndl::Event>,
}

impl Posts {
    fn new() -> Self {
        Self {
            root: Post::new(POST_CAPACITY),
            lncl: Post::new(POST_CAPACITY),
            sync: Post::new(POST_CAPACITY),
            gncl: Post::new(POST_CAPACITY),
            ndl: Post::new(POST_CAPACITY),
        }
    }
}
