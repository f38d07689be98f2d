//! Which child of a node, and which life of it.

use std::sync::{
    Arc,
    atomic::{AtomicU64, Ordering},
};

/// A child of any supervisor of one node. Stays the same through restarts; is never given to another child.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ChildId(pub u64);

impl std::fmt::Display for ChildId {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "#{}", self.0)
    }
}

/// Which life of a child; 0 before its first.
pub type Generation = u64;

/// Hands out ids. All supervisors of a node share one, so that their children never have the same.
#[derive(Clone, Debug, Default)]
pub struct ChildIds(Arc<AtomicU64>);

impl ChildIds {
    /// An id that was not handed out before.
    #[must_use]
    pub fn next(&self) -> ChildId {
        // SYNC: Relaxed; the number itself is all that is shared.
        ChildId(self.0.fetch_add(1, Ordering::Relaxed))
    }
}
