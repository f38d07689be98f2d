//! The directory of a node, in which a sender resolves names.

use crate::{
    monitor::{MonitorError, MonitorId},
    tid::{AppAddress, Tid},
    wire::PayloadType,
};

/// The names and groups that a node knows.
pub trait Directory: Send + Sync {
    /// Returns the TID that has `name` now, or `None` if no application has it.
    fn resolve(&self, name: &str) -> Option<Tid>;

    /// Returns names of applications that are similar to `name`, three at most, the most similar first; none
    /// if no names are available. The search compares names, so use it only for messages that people read.
    fn nearest(&self, name: &str) -> Vec<String> {
        let _ = name;
        Vec::new()
    }

    /// Returns why the application called `name` is not there, if it is required by one of this node and was
    /// there, or is expected. For messages that people read.
    fn why_not(&self, name: &str) -> Option<String> {
        let _ = name;
        None
    }

    /// Adds the application at `app` of this node to `group`, or removes it.
    fn set_member(&self, app: AppAddress, group: AppAddress, member: bool);

    /// Records that the application at `app` of this node sends payloads of this type. It is called on the sending
    /// thread at the first message of the type, so it must not block.
    fn sends(&self, app: AppAddress, sent: PayloadType) {
        let _ = (app, sent);
    }

    /// Sets a monitor of the current incarnation of `target` for the application at `watcher` of this node.
    ///
    /// # Errors
    /// The monitor was not set, and nothing changed.
    fn monitor(&self, watcher: AppAddress, target: Tid) -> Result<MonitorId, MonitorError> {
        let _ = (watcher, target);
        Err(MonitorError::Unsupported)
    }

    /// Removes a monitor of `watcher`. Returns `false` if it does not exist, or has already reported.
    fn demonitor(&self, watcher: AppAddress, monitor: MonitorId) -> bool {
        let _ = (watcher, monitor);
        false
    }
}
