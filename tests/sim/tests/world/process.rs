//! A node's process: its cores, their event queues, and their timers.

use std::{
    collections::BTreeMap,
    net::{SocketAddr, SocketAddrV4},
    time::Duration,
};

use sinew_gncl::core::ConnectionId;
use sinew_model::{
    config::NodeConfig,
    events::{GnclEvent, NdlEvent, SyncEvent},
};
use sinew_runtime::{
    tid::{Incarnation, NodeAddress},
    time::Time,
};
use sinew_sim::{Chance, Clock, Pipe, Timer};

use crate::{
    apps::App,
    ndl::announced_at,
    plan::{MISSED_MAX, NODES, PERIOD},
    sessions::Store,
    tcp::Wire,
    world::{gncl_address, node_address},
};

/// The event queues of the layers. An event is read some time after it was posted, in order.
#[derive(Default)]
pub(crate) struct EventQueues {
    pub(crate) ndl: Pipe<NdlEvent>,
    pub(crate) gncl: Pipe<GnclEvent>,
    pub(crate) sync: Pipe<SyncEvent>,
}

/// A node's process.
pub(crate) struct Process {
    pub(crate) node: usize,
    pub(crate) address: NodeAddress,
    pub(crate) incarnation: Incarnation,
    pub(crate) config: NodeConfig,
    pub(crate) clock: Clock,
    pub(crate) is_alive: bool,
    pub(crate) is_leaving: bool,
    pub(crate) ndl: sinew_ndl::Core,
    pub(crate) gncl: sinew_gncl::core::Core,
    pub(crate) sync: sinew_sync::Core,
    pub(crate) event_queues: EventQueues,
    pub(crate) timers: [Timer; 3],
    pub(crate) store: Store,
    pub(crate) wires: BTreeMap<ConnectionId, Wire>,
    /// The number of GNCL's present instance.
    pub(crate) gncl_instance: u64,
    /// The address at which GNCL listens.
    pub(crate) gncl_at: SocketAddr,
    /// The number of the sync manager's present event, and of its present input.
    pub(crate) sync_events: u64,
    pub(crate) sync_inputs: u32,
    pub(crate) apps: Vec<App>,
    /// Since when it has no link to a node, as far as the checks have seen.
    pub(crate) unlinked_since: BTreeMap<NodeAddress, Time>,
}

impl Process {
    pub(crate) fn new(
        node: usize,
        incarnation: Incarnation,
        clock: Clock,
        seed: u64,
        apps: Vec<App>,
    ) -> Self {
        let mut config = NodeConfig::new(format!("node{node}"));
        (config.ndl.period, config.ndl.missed_max) = (PERIOD, MISSED_MAX);
        config.ndl.nodes_max = NODES - 1;
        // Datagrams of class Stream carry nothing here.
        config.gncl.datagrams = false;
        config.sync.requirement_deadline = Duration::from_secs(60);
        let address = node_address(node);
        let mut chance = Chance::new(seed.wrapping_mul(0x1_0001) ^ incarnation.0);
        let (nonce, secret) = (chance.draw(), u128::from(chance.draw()));
        Self {
            node,
            address,
            incarnation,
            clock,
            is_alive: true,
            is_leaving: false,
            ndl: sinew_ndl::Core::new(&config, address, incarnation, nonce, secret),
            gncl: new_gncl(&config, address, incarnation, chance.draw()),
            sync: sinew_sync::Core::new(&config, address, incarnation),
            config,
            event_queues: EventQueues::default(),
            timers: [Timer::default(); 3],
            store: Store::default(),
            wires: BTreeMap::new(),
            gncl_instance: 0,
            gncl_at: gncl_address(node),
            sync_events: 0,
            sync_inputs: 0,
            apps,
            unlinked_since: BTreeMap::new(),
        }
    }

    /// Returns the addresses that NDL announces for GNCL.
    pub(crate) fn announced(&self) -> (Vec<SocketAddrV4>, Option<u16>) {
        announced_at(self.gncl_at)
    }
}

/// Creates GNCL's core as its actor does.
pub(crate) fn new_gncl(
    config: &NodeConfig,
    address: NodeAddress,
    incarnation: Incarnation,
    seed: u64,
) -> sinew_gncl::core::Core {
    sinew_gncl::core::Core::new(sinew_gncl::settings(config, address, incarnation, false), seed)
}
