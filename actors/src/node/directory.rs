//! Names and groups, as the applications of a node see them.

use std::sync::Arc;

use sinew_runtime::{
    sender::Directory,
    tid::{AppAddress, Tid},
};

use crate::{lncl, stores::Stores};

pub(super) struct NodeDirectory(pub(super) Arc<Stores>);

impl Directory for NodeDirectory {
    fn resolve(&self, name: &str) -> Option<Tid> {
        lncl::resolve(&self.0, name)
    }

    fn set_member(&self, app: AppAddress, group: AppAddress, member: bool) {
        lncl::set_member(&self.0, app, group, member);
    }
}
