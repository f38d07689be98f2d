//! Actions that a step under an outlet's lock defers until the lock is released.

use std::{cell::Cell, task::Waker};

use sinew_runtime::{
    outcome::{Outcome, Receipt},
    wakes,
};

/// Outcomes for which a thread keeps memory: as many as arrive at once from one healthy peer. More arrive
/// only from a lost peer.
const KEPT_MAX: usize = 1_024;

thread_local! {
    /// Reusable memory for the next settlements: each confirmed message passes its outcome through it.
    static SPARE: Cell<Vec<(Receipt, Outcome)>> = const { Cell::new(Vec::new()) };
}

/// Actions to run after the lock is released.
#[derive(Default)]
pub(super) struct DeferredActions {
    /// Receipts to settle, with their outcomes; see [`settle`](Self::settle).
    settle: Vec<(Receipt, Outcome)>,
    pub(super) wake: Option<Waker>,
    /// Wakers of senders that wait for room.
    pub(super) room: Vec<Waker>,
}

impl DeferredActions {
    /// Schedules these receipts for settlement.
    pub(super) fn settle(&mut self, settled: impl IntoIterator<Item = (Receipt, Outcome)>) {
        for settled in settled {
            if self.settle.capacity() == 0 {
                // A thread that is ending has no spare memory any more.
                self.settle = SPARE.try_with(Cell::take).unwrap_or_default();
            }
            self.settle.push(settled);
        }
    }

    /// Runs the actions; most steps have none.
    #[inline]
    pub(super) fn run(self) {
        if !self.settle.is_empty() || self.wake.is_some() || !self.room.is_empty() {
            self.run_all();
        }
    }

    fn run_all(mut self) {
        Receipt::settle_all(&mut self.settle);
        self.wake.into_iter().chain(self.room).for_each(wakes::wake);
        if (1..=KEPT_MAX).contains(&self.settle.capacity()) {
            // The settled code may have settled other receipts meanwhile, in memory of its own. One of the
            // two buffers is kept.
            let _ = SPARE.try_with(|spare| spare.set(self.settle));
        }
    }
}
