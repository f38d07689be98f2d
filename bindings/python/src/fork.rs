//! The child of a fork has copies of objects that belong to its parent: their end must not have an effect there.

use std::sync::atomic::{AtomicU32, Ordering};

use pyo3::prelude::*;

/// The number of forks between the first process and this one.
static GENERATION: AtomicU32 = AtomicU32::new(0);

/// Records that this process is the child of a fork. Python calls it there.
#[pyfunction]
pub(crate) fn forked() {
    // SYNC: Relaxed; the child has one thread then.
    GENERATION.fetch_add(1, Ordering::Relaxed);
}

/// The generation of the first process with a guard, plus 1; 0: there is none.
static FIRST_GUARD: AtomicU32 = AtomicU32::new(0);

/// Returns whether this process may have guards. The thread that makes outputs safe starts with the first guard, and is
/// not in the child of a fork.
pub(crate) fn may_guard() -> bool {
    let own = GENERATION.load(Ordering::Relaxed) + 1;
    // SYNC: Relaxed; the number alone matters.
    match FIRST_GUARD.compare_exchange(0, own, Ordering::Relaxed, Ordering::Relaxed) {
        Ok(_) => true,
        Err(first) => first == own,
    }
}

/// The process that has made an object.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) struct Owner(u32);

impl Owner {
    pub(crate) fn this_process() -> Self {
        Self(GENERATION.load(Ordering::Relaxed))
    }

    /// Returns whether this process has only a copy of the object.
    pub(crate) fn is_parent(self) -> bool {
        self != Self::this_process()
    }
}
