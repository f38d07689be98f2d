//! What a step under an outlet's lock puts off until the lock is free again.

use std::{cell::Cell, task::Waker};

use sinew_runtime::{
    outcome::{Outcome, Receipt},
    wakes,
};

/// Outcomes for which a thread keeps memory: as many as come at once from one peer while it is well. More are those of a peer that is lost.
const KEPT_MAX: usize = 1_024;

thread_local! {
    /// Memory for what the thread settles next: an outcome for each confirmed message comes this way.
    static SPARE: Cell<Vec<(Receipt, Outcome)>> = const { Cell::new(Vec::new()) };
}

/// What is done when the lock is free again.
#[derive(Default)]
pub(super) struct After {
    /// Who is told, and what; see [`settle`](Self::settle).
    settle: Vec<(Receipt, Outcome)>,
    pub(super) wake: Option<Waker>,
    /// Those who waited for room.
    pub(super) room: Vec<Waker>,
}

impl After {
    /// These are told.
    pub(super) fn settle(&mut self, told: impl IntoIterator<Item = (Receipt, Outcome)>) {
        for told in told {
            if self.settle.capacity() == 0 {
                // A thread that ends has none any more.
                self.settle = SPARE.try_with(Cell::take).unwrap_or_default();
            }
            self.settle.push(told);
        }
    }

    pub(super) fn run(mut self) {
        for (receipt, outcome) in self.settle.drain(..) {
            receipt.settle(outcome);
        }
        self.wake.into_iter().chain(self.room).for_each(wakes::wake);
        if (1..=KEPT_MAX).contains(&self.settle.capacity()) {
            // Whoever was told may have settled others meanwhile, in memory of their own: one of the two is kept.
            let _ = SPARE.try_with(|spare| spare.set(self.settle));
        }
    }
}
