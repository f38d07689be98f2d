//! The names, groups and monitors of a replay.

use std::{
    collections::BTreeMap,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
};

use sinew_runtime::{
    monitor::{MonitorError, MonitorId},
    sender::Directory,
    tid::{AppAddress, NodeAddress, Tid},
};

use crate::world::World;

/// The directory of one application.
pub(crate) struct Names {
    pub(crate) node: NodeAddress,
    pub(crate) names: Arc<BTreeMap<String, Tid>>,
    pub(crate) world: Arc<World>,
    /// The number of monitors that were set: a recorded `Down` names its monitor by this number.
    pub(crate) monitors: AtomicU64,
}

impl Directory for Names {
    fn resolve(&self, name: &str) -> Option<Tid> {
        self.names.get(name).copied()
    }

    fn set_member(&self, app: AppAddress, group: AppAddress, member: bool) {
        self.world.set_member(Tid::new(self.node, app), group, member);
    }

    fn monitor(&self, _: AppAddress, _: Tid) -> Result<MonitorId, MonitorError> {
        Ok(MonitorId(self.monitors.fetch_add(1, Ordering::Relaxed) + 1))
    }

    fn demonitor(&self, _: AppAddress, _: MonitorId) -> bool {
        true
    }
}
