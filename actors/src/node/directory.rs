//! Names and groups, as the applications of a node see them.

use std::sync::Arc;

use sinew_runtime::{
    sender::Directory,
    tid::{AppAddress, Tid},
};

use crate::{
    lncl::AppFact,
    stores::{Stores, lock},
    sync,
};

pub(super) struct NodeDirectory(pub(super) Arc<Stores>);

impl Directory for NodeDirectory {
    fn resolve(&self, name: &str) -> Option<Tid> {
        lock(&self.0.sync).resolve(name)
    }

    fn set_member(&self, app: AppAddress, group: AppAddress, member: bool) {
        if self.0.router.set_member(group, app, member)
            && self.0.posts.sync.post(sync::Event::App(AppFact::GroupsChanged)).is_err()
        {
            tracing::warn!(
                "the sync manager's post is full; other nodes learn of the group with its next list"
            );
        }
    }
}
