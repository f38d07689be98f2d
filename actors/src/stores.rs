//! State that outlives every layer: owned by the node's root, lent to each new instance of a layer.

use std::{
    collections::BTreeMap,
    net::SocketAddr,
    sync::{Arc, Mutex, OnceLock, PoisonError, atomic::AtomicBool},
    time::Duration,
};

use sinew_runtime::{
    post::Post,
    router::Router,
    tid::{Incarnation, NodeAddress},
};

use crate::{config::NodeConfig, gncl, lncl, ndl, node, sync};

/// What the layers of one node share.
pub(crate) struct Stores {
    /// The node's configuration, checked.
    pub(crate) config: NodeConfig,
    /// The node's address.
    pub(crate) node: NodeAddress,
    /// Which life of the node this is.
    pub(crate) incarnation: Incarnation,
    /// Where messages go.
    pub(crate) router: Arc<Router>,
    /// Events into each layer.
    pub(crate) posts: Posts,
    /// How far each peer's clock is from ours; written by NDL, read by GNCL.
    pub(crate) clocks: ClockOffsets,
    /// Address of GNCL's listener, known once it listens; announced by NDL. A restarted GNCL binds it again.
    pub(crate) gncl_listen: OnceLock<SocketAddr>,
    /// Who is registered on this node.
    pub(crate) registry: Mutex<lncl::Registry>,
    /// Which nodes are there; a restarted NDL goes on with them.
    pub(crate) ndl: Mutex<ndl::Core>,
    /// Who is known on other nodes, and what waits for whom.
    pub(crate) sync: Mutex<sync::Core>,
    /// The node stops in order: set by the root before it stops its layers. A layer that ends while this is not set is
    /// started again, and must not say goodbye to other nodes.
    pub(crate) stopping: AtomicBool,
}

#[cfg(test)]
impl Stores {
    /// The stores of a node that has only the layers that a test starts.
    pub(crate) fn for_test(config: NodeConfig, incarnation: Incarnation) -> Arc<Self> {
        let node = config.node_address();
        let ndl = Mutex::new(ndl::new_core(&config, node, incarnation));
        Arc::new(Self {
            config,
            node,
            incarnation,
            router: Arc::new(Router::new(node)),
            posts: Posts {
                root: Post::new(1_024),
                lncl: Post::new(1_024),
                sync: Post::new(1_024),
                gncl: Post::new(1_024),
                ndl: Post::new(1_024),
            },
            clocks: ClockOffsets::default(),
            gncl_listen: OnceLock::new(),
            registry: Mutex::default(),
            ndl,
            sync: Mutex::default(),
            stopping: AtomicBool::new(false),
        })
    }
}

/// The posts of the layers.
pub(crate) struct Posts {
    pub(crate) root: Post<node::RootEvent>,
    pub(crate) lncl: Post<lncl::Event>,
    pub(crate) sync: Post<sync::Event>,
    pub(crate) gncl: Post<gncl::Event>,
    pub(crate) ndl: Post<ndl::Event>,
}

/// The offsets of the peers' clocks against ours.
#[derive(Debug, Default)]
pub(crate) struct ClockOffsets(Mutex<BTreeMap<NodeAddress, ClockOffset>>);

/// How far a peer's monotonic clock is from ours.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct ClockOffset {
    /// Their clock minus ours, in nanoseconds.
    pub(crate) theirs_minus_ours_ns: i64,
    /// The error is at most this: half the round trip of the best sample.
    pub(crate) bound: Duration,
}

impl ClockOffsets {
    /// The offset of `node`, if it was ever measured.
    pub(crate) fn get(&self, node: NodeAddress) -> Option<ClockOffset> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).get(&node).copied()
    }

    /// Replaces the offset of `node`.
    pub(crate) fn set(&self, node: NodeAddress, offset: ClockOffset) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).insert(node, offset);
    }

    /// Forgets `node`.
    pub(crate) fn forget(&self, node: NodeAddress) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).remove(&node);
    }
}
