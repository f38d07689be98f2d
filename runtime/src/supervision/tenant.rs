//! One life of a supervised actor as others hold it: its supervisor, its thread, the watchdog.

use std::{
    sync::{
        Arc, Mutex, Weak,
        atomic::{AtomicU64, Ordering},
    },
    task::Waker,
    time::Duration,
};

use super::{Reason, threads::Seat, vitals::Vitals};
use crate::{post::lock, time::Time};

/// What befalls a life.
#[derive(Debug)]
pub(super) enum Fate {
    /// It does not come back.
    Hung(Reason),
    /// It is gone.
    Ended(Reason),
}

/// Tells what befalls a life.
pub(super) type Report = Box<dyn Fn(Fate) + Send + Sync>;

/// One life of an actor. Reaches the actor from any thread, and not through its queue: that may be full, or unread.
#[derive(Clone)]
pub(super) struct Tenant(Arc<Inner>);

struct Inner {
    vitals: Arc<Vitals>,
    /// Where it lives; `None` for one whose thread nobody can replace.
    seat: Option<Arc<Seat>>,
    progress_within: Option<Duration>,
    orders: Mutex<Orders>,
    /// Since when it does not come back to its thread, in nanoseconds; 0: it does.
    holds_its_thread: AtomicU64,
    report: Report,
}

#[derive(Debug, Default)]
struct Orders {
    stop: bool,
    kill: bool,
    waker: Option<Waker>,
}

/// What a life was told since it looked last.
pub(super) struct Told {
    pub(super) stop: bool,
    pub(super) kill: bool,
}

impl std::fmt::Debug for WeakTenant {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{:?}", self.0.upgrade().map(|inner| inner.vitals.clone()))
    }
}

impl Tenant {
    pub(super) fn new(
        vitals: Arc<Vitals>,
        seat: Option<Arc<Seat>>,
        progress_within: Option<Duration>,
        report: Report,
    ) -> Self {
        Self(Arc::new(Inner {
            vitals,
            seat,
            progress_within,
            orders: Mutex::default(),
            holds_its_thread: AtomicU64::new(0),
            report,
        }))
    }

    pub(super) fn vitals(&self) -> &Arc<Vitals> {
        &self.0.vitals
    }

    pub(super) fn seat(&self) -> Option<&Arc<Seat>> {
        self.0.seat.as_ref()
    }

    pub(super) fn progress_within(&self) -> Option<Duration> {
        self.0.progress_within
    }

    pub(super) fn report(&self, fate: Fate) {
        (self.0.report)(fate);
    }

    /// Asks the actor to stop.
    pub(super) fn stop(&self) {
        self.0.vitals.set_stopping();
        self.pull(|orders| orders.stop = true);
    }

    /// Takes the actor's life, now for all that others see of it, and the next time that its thread is free for the rest.
    pub(super) fn kill(&self) {
        self.0.vitals.fence();
        self.pull(|orders| orders.kill = true);
        self.0.vitals.empty_hands();
    }

    /// Makes the actor's thread have a look at it.
    pub(super) fn wake(&self) {
        self.pull(|_| {});
    }

    /// What it was told; `waker` wakes it when it is told more.
    pub(super) fn told(&self, waker: &Waker) -> Told {
        let mut orders = lock(&self.0.orders);
        if orders.waker.as_ref().is_none_or(|former| !former.will_wake(waker)) {
            orders.waker = Some(waker.clone());
        }
        Told { stop: std::mem::take(&mut orders.stop), kill: orders.kill || self.0.vitals.is_over() }
    }

    /// It does not come back to its thread: the thread is lost with it.
    pub(super) fn set_holds_its_thread(&self, since: Time) {
        self.0.holds_its_thread.store(since.as_nanos().max(1), Ordering::Release);
    }

    /// Since when it does not come back to its thread.
    pub(super) fn holds_its_thread(&self) -> Option<Time> {
        let since = self.0.holds_its_thread.load(Ordering::Acquire);
        (since > 0).then(|| Time::from_nanos(since))
    }

    pub(super) fn has_ended(&self) -> bool {
        self.0.vitals.is_gone()
    }

    pub(super) fn downgrade(&self) -> WeakTenant {
        WeakTenant(Arc::downgrade(&self.0))
    }

    fn pull(&self, order: impl FnOnce(&mut Orders)) {
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

/// A [`Tenant`] that is forgotten when its life is.
pub(super) struct WeakTenant(Weak<Inner>);

impl WeakTenant {
    /// The life, if it has not ended.
    pub(super) fn living(&self) -> Option<Tenant> {
        self.0.upgrade().map(Tenant).filter(|tenant| !tenant.has_ended())
    }
}
