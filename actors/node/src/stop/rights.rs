//! The rights to press and to release the stop. spec: STOP-3, STOP-9

use std::collections::BTreeSet;

use sinew_runtime::tid::Tid;

use super::frame::Entry;
use crate::{NodeState, security_setup::is_private};

/// The reason of a refused release.
pub(super) const NO_OPERATOR: &str = "the stop is released by operators only: name this application in `operators` of \
     [roles] in the access list of every node (security.access), and ask its own node; without a list, a node that is open and on \
     loopback takes releases of its own applications and clients";

/// Returns whether the application at `source` may release at this node.
pub(super) fn may_release(state: &NodeState, source: Tid) -> bool {
    // Another node does not know the user of the application, and judges by its own list.
    source.node == state.ctx.node && is_operator(state, source)
}

/// Returns the applications that released and may do so, of those that a state of another node names. Without a list
/// that node has judged: on loopback it is of the same host.
pub(super) fn operators(state: &NodeState, entries: &[Entry]) -> BTreeSet<Tid> {
    let released = entries.iter().filter(|entry| entry.released > 0).map(|entry| entry.released_by);
    released.filter(|by| is_operator(state, *by)).collect()
}

fn is_operator(state: &NodeState, source: Tid) -> bool {
    match state.security.access.get() {
        Some(access) => access.is_operator(source),
        None => is_private(state),
    }
}
