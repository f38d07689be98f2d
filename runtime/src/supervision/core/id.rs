//! The IDs of children in a node, and their generations.

use std::sync::{
    Arc,
    atomic::{AtomicU64, Ordering},
};

/// The ID of a child of any supervisor of one node. It stays the same through restarts, and is never reused.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ChildId(pub u64);

impl std::fmt::Display for ChildId {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "#{}", self.0)
    }
}

/// The number of an incarnation of a child; 0 before the first.
pub type Generation = u64;

/// Assigns IDs. All supervisors of a node share one generator, so that IDs are unique.
#[derive(Clone, Debug, Default)]
pub struct ChildIds(Arc<AtomicU64>);

impl ChildIds {
    /// Returns a new ID.
    #[must_use]
    pub fn next(&self) -> ChildId {
        // SYNC: Relaxed; the number itself is the only shared state.
        ChildId(self.0.fetch_add(1, Ordering::Relaxed))
    }
}
