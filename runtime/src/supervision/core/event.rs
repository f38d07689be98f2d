//! What a supervisor is told, and what it orders.

use super::{ChildId, Generation, Reason};

/// What a supervisor is told.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Input {
    /// Start the children.
    Started,
    /// What this child requires is ready.
    Released(ChildId),
    /// This child takes messages.
    BecameReady(ChildId, Generation),
    /// This child does not come back: the reason says what it is in. Its life is taken.
    Hung(ChildId, Generation, Reason),
    /// This child is gone.
    Ended(ChildId, Generation, Reason),
    /// A deadline may have passed.
    TimePassed,
    /// Stop the children, last first.
    StopOrdered,
}

/// What a supervisor orders its shell to do, and what it says to others.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Order {
    /// Make a new instance of this child.
    Spawn(ChildId, Generation),
    /// Tell this child to stop.
    Stop(ChildId, Generation),
    /// Take this child's life without waiting for it.
    Abandon(ChildId, Generation),
    /// For others: this child failed.
    Failed(ChildId, Reason),
    /// For others: this child is ready.
    Ready(ChildId),
    /// For others: this child is gone and will not be started again.
    Gone(ChildId, Reason),
    /// For others: every child that is wanted and not held is ready. Said again after each restart.
    AllReady,
    /// For others: no child lives any more, and why. The last order.
    Ended(Reason),
}
