//! Names and groups, as the applications of a node see them.

use std::sync::Arc;

use sinew_runtime::{
    monitor::{MonitorError, MonitorId},
    sender::Directory,
    tid::{AppAddress, Tid},
    time::Time,
};

use crate::{lncl, monitors, stores::Stores};

pub(super) struct NodeDirectory(pub(super) Arc<Stores>);

impl Directory for NodeDirectory {
    fn resolve(&self, name: &str) -> Option<Tid> {
        lncl::resolve(&self.0, name)
    }

    fn nearest(&self, name: &str) -> Vec<String> {
        lncl::nearest(&self.0, name)
    }

    fn monitor(&self, watcher: AppAddress, target: Tid) -> Result<MonitorId, MonitorError> {
        monitors::change(&self.0, |core| core.monitor(Time::now(), watcher, target))
    }

    fn demonitor(&self, watcher: AppAddress, monitor: MonitorId) -> bool {
        monitors::change(&self.0, |core| core.demonitor(Time::now(), watcher, monitor))
    }

    fn set_member(&self, app: AppAddress, group: AppAddress, member: bool) {
        lncl::set_member(&self.0, app, group, member);
    }
}
