//! A handle of one incarnation of a supervised actor, for its supervisor, its thread and the watchdog.

use std::{
    sync::{
        Arc, Mutex, Weak,
        atomic::{AtomicU64, Ordering},
    },
    task::Waker,
    time::Duration,
};

use super::{Reason, liveness::Liveness, threads::ThreadSlot};
use crate::{lock, time::Time};

/// An event in the life of an incarnation.
#[derive(Debug)]
pub(super) enum ActorEvent {
    /// The actor hangs.
    Hung(Reason),
    /// The actor has ended.
    Ended(Reason),
}

/// Reports an event of an incarnation.
pub(super) type Report = Box<dyn Fn(ActorEvent) + Send + Sync>;

/// A handle of one incarnation. It reaches the actor from any thread, and not through its queue, which may be
/// full or unread.
#[derive(Clone)]
pub(super) struct ActorHandle(Arc<Inner>);

struct Inner {
    liveness: Arc<Liveness>,
    /// The thread of the actor; `None` for an actor with a thread that cannot be replaced.
    slot: Option<Arc<ThreadSlot>>,
    progress_within: Option<Duration>,
    orders: Mutex<Orders>,
    /// Since when the actor blocks its thread, in nanoseconds; 0: it does not.
    blocked_since: AtomicU64,
    report: Report,
}

#[derive(Debug, Default)]
struct Orders {
    stop: bool,
    kill: bool,
    waker: Option<Waker>,
}

/// The orders that an incarnation received since its last check.
pub(super) struct PendingOrders {
    pub(super) stop: bool,
    pub(super) kill: bool,
}

impl std::fmt::Debug for WeakActorHandle {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{:?}", self.0.upgrade().map(|inner| inner.liveness.clone()))
    }
}

impl ActorHandle {
    pub(super) fn new(
        liveness: Arc<Liveness>,
        slot: Option<Arc<ThreadSlot>>,
        progress_within: Option<Duration>,
        report: Report,
    ) -> Self {
        Self(Arc::new(Inner {
            liveness,
            slot,
            progress_within,
            orders: Mutex::default(),
            blocked_since: AtomicU64::new(0),
            report,
        }))
    }

    pub(super) fn liveness(&self) -> &Arc<Liveness> {
        &self.0.liveness
    }

    pub(super) fn slot(&self) -> Option<&Arc<ThreadSlot>> {
        self.0.slot.as_ref()
    }

    pub(super) fn progress_within(&self) -> Option<Duration> {
        self.0.progress_within
    }

    pub(super) fn report(&self, event: ActorEvent) {
        (self.0.report)(event);
    }

    /// Orders the actor to stop.
    pub(super) fn stop(&self) {
        self.0.liveness.set_stopping();
        self.update_orders(|orders| orders.stop = true);
    }

    /// Abandons the incarnation: it is fenced at once, and ended when its thread is free.
    pub(super) fn kill(&self) {
        self.0.liveness.fence();
        self.update_orders(|orders| orders.kill = true);
        self.0.liveness.release_inbox();
    }

    /// Wakes the actor's thread to check for orders.
    pub(super) fn wake(&self) {
        self.update_orders(|_| {});
    }

    /// Returns the pending orders, and registers `waker` for further ones.
    pub(super) fn take_orders(&self, waker: &Waker) -> PendingOrders {
        let mut orders = lock(&self.0.orders);
        if orders.waker.as_ref().is_none_or(|former| !former.will_wake(waker)) {
            orders.waker = Some(waker.clone());
        }
        PendingOrders {
            stop: std::mem::take(&mut orders.stop),
            kill: orders.kill || self.0.liveness.is_fenced(),
        }
    }

    /// Records that the actor blocks its thread: the thread is lost with it.
    pub(super) fn set_blocks_thread(&self, since: Time) {
        self.0.blocked_since.store(since.as_nanos().max(1), Ordering::Release);
    }

    /// Returns since when the actor blocks its thread.
    pub(super) fn blocked_since(&self) -> Option<Time> {
        let since = self.0.blocked_since.load(Ordering::Acquire);
        (since > 0).then(|| Time::from_nanos(since))
    }

    pub(super) fn has_ended(&self) -> bool {
        self.0.liveness.has_ended()
    }

    pub(super) fn downgrade(&self) -> WeakActorHandle {
        WeakActorHandle(Arc::downgrade(&self.0))
    }

    fn update_orders(&self, order: impl FnOnce(&mut Orders)) {
        let waker = {
            let mut orders = lock(&self.0.orders);
            order(&mut orders);
            orders.waker.take()
        };
        if let Some(waker) = waker {
            waker.wake();
        }
    }
}

/// A weak handle, which does not keep an incarnation alive.
pub(super) struct WeakActorHandle(Weak<Inner>);

impl WeakActorHandle {
    /// Returns the incarnation, if it exists. It may have ended. The result may become its last owner, and must not be
    /// dropped under a lock.
    pub(super) fn upgrade(&self) -> Option<ActorHandle> {
        self.0.upgrade().map(ActorHandle)
    }
}
