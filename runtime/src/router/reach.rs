//! How many destinations a message has.

use super::{Router, Snapshot};
use crate::tid::{AppAddress, NodeAddress, Tid};

/// The number of destinations of a message.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Reach {
    /// Number of applications of this node.
    pub here: usize,
    /// Number of other nodes.
    pub elsewhere: usize,
}

impl Router {
    /// Returns the number of applications of this node that a message from here may reach, and of other nodes.
    #[must_use]
    pub fn reach(&self, destination: Tid) -> Reach {
        let Tid { node, app } = self.absolute(destination);
        if destination.is_single() {
            let is_here = node == self.node;
            return Reach { here: usize::from(is_here), elsewhere: usize::from(!is_here) };
        }
        let Snapshot { table, members } = &**self.snapshot.load();
        let here = match (node == self.node || node == NodeAddress::ALL, app) {
            (false, _) => 0,
            (true, group) if group.is_group() => members.here.members(group).len(),
            (true, AppAddress::ALL) => table.local.len(),
            (true, _) => 1,
        };
        let elsewhere = match (node, app) {
            (NodeAddress::ALL, group) if group.is_group() => members.elsewhere.members(group).len(),
            (NodeAddress::ALL, _) => table.peers.len(),
            (node, _) => usize::from(node != self.node),
        };
        Reach { here, elsewhere }
    }
}
