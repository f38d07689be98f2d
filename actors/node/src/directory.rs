//! Names and groups, as visible to the applications of a node.

use std::sync::Arc;

use sinew_runtime::{
    lock,
    monitor::{MonitorError, MonitorId},
    sender::Directory,
    tid::{AppAddress, Tid},
    time::Time,
    wire::PayloadType,
};
use sinew_sync::monitors;

use crate::NodeState;

pub(super) struct NodeDirectory(pub(super) Arc<NodeState>);

impl Directory for NodeDirectory {
    fn resolve(&self, name: &str) -> Option<Tid> {
        sinew_lncl::resolve(&self.0.lncl, name)
    }

    fn nearest(&self, name: &str) -> Vec<String> {
        sinew_lncl::nearest(&self.0.lncl, name)
    }

    fn why_not(&self, name: &str) -> Option<String> {
        lock(&self.0.sync.core).why_required_is_missing(Time::now(), name)
    }

    fn monitor(&self, watcher: AppAddress, target: Tid) -> Result<MonitorId, MonitorError> {
        monitors::change(&self.0.sync, |core| core.monitor(Time::now(), watcher, target))
    }

    fn demonitor(&self, watcher: AppAddress, monitor: MonitorId) -> bool {
        monitors::change(&self.0.sync, |core| core.demonitor(Time::now(), watcher, monitor))
    }

    fn sends(&self, app: AppAddress, sent: PayloadType) {
        self.0.types.sends(app, sent);
    }

    fn set_member(&self, app: AppAddress, group: AppAddress, member: bool) {
        sinew_lncl::set_member(&self.0.lncl, app, group, member);
    }
}
