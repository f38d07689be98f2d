//! Reloads the files that a running node can read again: its access list and its deny list.

use sinew_runtime::log;
use sinew_security::{
    access::{AccessError, AccessSummary},
    node_security::{Denied, DenyListError, DenyListSummary},
};

use super::NodeHandle;
use crate::security_setup;

/// Maximum characters of a list's faults in the log: the program that requested the reload gets all of them.
const LOGGED_MAX: usize = 1_024;

impl NodeHandle {
    /// Reads the node's access list again and puts it in force: for every later delivery, and for every later
    /// registration of another process's application. Messages already in a mailbox, and existing
    /// registrations, stay.
    ///
    /// # Errors
    /// The node was started without a list, or the file cannot be used: the list in force stays. This is logged too.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::NodeHandle;
    ///
    /// fn reload(handle: &NodeHandle) {
    ///     match handle.reload_access() {
    ///         Ok(list) => println!("{} rules are in force", list.rules),
    ///         Err(why) => eprintln!("the former list stays in force: {why}"),
    ///     }
    /// }
    /// ```
    pub fn reload_access(&self) -> Result<AccessSummary, AccessError> {
        let access = self.state.security.access.get().ok_or(AccessError::None)?;
        let read = access.reload();
        match &read {
            Ok(AccessSummary { rules, clients }) => {
                log::info!(rules, clients, "another access list is in force");
                security_setup::warn_without_groups(access);
            }
            Err(why) => {
                let why: String = why.to_string().chars().take(LOGGED_MAX).collect();
                log::error!(why, "the access list was not replaced");
            }
        }
        read
    }

    /// Reads the node's deny list again and puts it in force. Connections to nodes with a listed certificate
    /// end with a reason, and new ones are refused. Such a node is lost when it is silent; messages to it
    /// wait and expire.
    ///
    /// Blocks: a file of up to 8 MiB is read and searched on the caller's thread. Do not call it from the
    /// thread of a control loop or an actor. Concurrent reloads wait for each other.
    ///
    /// # Errors
    /// The node was started without keys, the file cannot be used, or further action is needed: each error
    /// states the rules in force. It is logged too.
    pub fn reload_deny_list(&self) -> Result<DenyListSummary, DenyListError> {
        let secured = self.state.security.secured.get().ok_or(DenyListError::None)?;
        let read =
            secured.reload_deny_list().map_err(DenyListError::from).and_then(|Denied { summary, own }| {
                // After the list is in force: it applies to nodes that connect meanwhile.
                let posted = self.state.ctx.event_queues.gncl.post(sinew_gncl::Event::DenyListChanged);
                posted.map_err(|_| DenyListError::NotTold { summary })?;
                own.map_or(Ok(summary), |serial| Err(DenyListError::Own { serial, summary }))
            });
        match &read {
            Ok(DenyListSummary { denied, readmitted }) => {
                log::info!(denied, readmitted, "another deny list is in force")
            }
            Err(why) => {
                let why: String = why.to_string().chars().take(LOGGED_MAX).collect();
                log::error!(why, "the deny list was read again");
            }
        }
        read
    }
}
