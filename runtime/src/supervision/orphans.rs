//! Children whose supervisor is gone without an end of its own: told to stop, waited for, and their lives taken if need be.
//!
//! Nobody decides for them any more, so nothing is decided: each has the time to stop that it was declared with, then its
//! life is taken. Whoever listened to their supervisor hears of each end, as of any other.

use std::{
    cell::RefCell,
    collections::BTreeMap,
    panic::{AssertUnwindSafe, catch_unwind},
    rc::Rc,
    time::Duration,
};

use futures_util::{FutureExt, StreamExt};
use tokio::time::timeout;

use super::{
    Reason, SupervisorFact, Threads,
    core::{ChildId, Input},
    panics::words,
    tenant::Tenant,
    watchdog::Reprieve,
};
use crate::{post::Post, time::Time};

/// Time in which a thread that does not hang lets go a child whose life is taken.
pub(super) const LETTING_GO: Duration = Duration::from_millis(200);

/// Whoever is told what happens to a supervisor's children.
pub(super) type Listener = Box<dyn FnMut(SupervisorFact)>;

/// Where a supervisor that fails leaves its children, for whoever oversees it.
pub(super) type Legacy = Rc<RefCell<Option<Orphans>>>;

/// A child whose end nobody was told of.
pub(super) struct Orphan {
    pub(super) tenant: Tenant,
    pub(super) stop_within: Duration,
}

/// All children of a supervisor that are left. Dropping them takes their lives.
pub(super) struct Orphans {
    left: BTreeMap<ChildId, Left>,
    threads: Rc<RefCell<Threads>>,
    post: Post<Input>,
    listener: Listener,
}

/// One that is left, and how long it has for what it does.
struct Left {
    tenant: Tenant,
    does: Does,
    until: Time,
    reprieve: Reprieve,
}

#[derive(Clone, Copy)]
enum Does {
    /// It was told to stop.
    Stop,
    /// Its life is taken and its end is told; its thread is to let it go.
    LetGo,
}

impl Left {
    fn new(tenant: Tenant, does: Does, within: Duration, threads: &Threads) -> Self {
        let reprieve = threads.reprieve(&tenant, within);
        Self { tenant, does, until: Time::now() + within, reprieve }
    }

    /// Whether its time is over. Who was not given it has more.
    fn is_late(&mut self, now: Time) -> bool {
        if self.until > now {
            return false;
        }
        let is_leaving = self.tenant.vitals().is_leaving();
        let later =
            if self.tenant.has_ended() { None } else { self.reprieve.until(self.until, now, is_leaving) };
        self.until = later.unwrap_or(self.until);
        later.is_none()
    }
}

impl Orphans {
    /// Takes the children over, and tells each to stop.
    pub(super) fn take_over(
        orphans: impl Iterator<Item = (ChildId, Orphan)>,
        threads: Rc<RefCell<Threads>>,
        post: Post<Input>,
        listener: Listener,
    ) -> Self {
        let tell = |(id, Orphan { tenant, stop_within }): (ChildId, Orphan)| {
            tenant.stop();
            (id, Left::new(tenant, Does::Stop, stop_within, &threads.borrow()))
        };
        let left = orphans.map(tell).collect();
        Self { left, threads, post, listener }
    }

    /// Sees to it that all of them end, on the calling thread, with nobody who waits for that.
    pub(super) fn end_apart(mut self) {
        let has_a_loop =
            actix_rt::Arbiter::try_current().is_some() && tokio::runtime::Handle::try_current().is_ok();
        if has_a_loop {
            actix_rt::spawn(async move {
                let why = Reason::GaveUp("its supervisor was dropped".to_owned());
                self.end_all(&why).await;
                self.tell(SupervisorFact::Ended(why));
            });
        }
        // Without one the thread ends, and nobody can wait: dropped here, they have no time at all.
    }

    /// Waits until each has ended or its time is over; `listener` is told of each. An end in order is none here: `why` their
    /// supervisor failed is why they end.
    pub(super) async fn end_all(&mut self, why: &Reason) {
        let mut events = self.post.attach();
        while let Some(Some(event)) = events.next().now_or_never() {
            self.hear(event, why);
        }
        self.bury(why);
        while let Some(next) = self.left.values().map(|left| left.until).min() {
            match timeout(next.since(Time::now()), events.next()).await {
                Ok(Some(event)) => self.hear(event, why),
                // Another reader came, which nobody makes: dropped, they have no time any more.
                Ok(None) => return,
                Err(_) => self.time_is_over(Time::now(), why),
            }
        }
    }

    fn hear(&mut self, event: Input, why: &Reason) {
        let (Input::Ended(id, _, reason) | Input::Hung(id, _, reason)) = event else { return };
        let Some(Left { tenant, does, .. }) = self.left.get(&id) else { return };
        match does {
            // What is told of a former life is told late: this one can still act.
            _ if !tenant.vitals().is_over() => {}
            Does::Stop => {
                let reason = if reason.is_failure() { reason } else { why.clone() };
                self.lose(id, reason);
            }
            Does::LetGo if tenant.has_ended() => _ = self.left.remove(&id),
            Does::LetGo => {}
        }
    }

    /// Those that ended without a word that anybody has heard.
    fn bury(&mut self, why: &Reason) {
        let ended = self.left.iter().filter(|(_, left)| left.tenant.has_ended());
        for id in ended.map(|(id, _)| *id).collect::<Vec<_>>() {
            self.lose(id, why.clone());
        }
    }

    fn time_is_over(&mut self, now: Time, why: &Reason) {
        let late =
            self.left.iter_mut().filter_map(|(id, left)| left.is_late(now).then_some((*id, left.does)));
        for (id, does) in late.collect::<Vec<_>>() {
            match does {
                Does::Stop => {
                    let has_ended = self.left.get(&id).is_some_and(|left| left.tenant.has_ended());
                    self.lose(id, if has_ended { why.clone() } else { Reason::Killed });
                }
                Does::LetGo => {
                    if let Some(left) = self.left.remove(&id) {
                        self.give_up(&left.tenant);
                    }
                }
            }
        }
    }

    /// It does nothing any more, and that is told. What is left of it is its thread's business, for a while.
    fn lose(&mut self, id: ChildId, reason: Reason) {
        let Some(Left { tenant, .. }) = self.left.remove(&id) else { return };
        tenant.kill();
        crate::log::warn!(child = tenant.vitals().name(), %reason, "ended without its supervisor");
        self.tell(SupervisorFact::Gone(id, reason));
        if tenant.holds_its_thread().is_some() {
            self.give_up(&tenant);
        } else if !tenant.has_ended() {
            let left = Left::new(tenant, Does::LetGo, LETTING_GO, &self.threads.borrow());
            self.left.insert(id, left);
        }
    }

    fn give_up(&self, tenant: &Tenant) {
        if !tenant.has_ended() {
            self.threads.borrow_mut().give_up(tenant);
        }
    }

    /// Whoever listens may be why the supervisor failed.
    fn tell(&mut self, fact: SupervisorFact) {
        if let Err(panic) = catch_unwind(AssertUnwindSafe(|| (self.listener)(fact))) {
            crate::log::error!(
                said = words(panic),
                "whoever listens to a supervisor panicked, and is told the rest"
            );
        }
    }
}

impl Drop for Orphans {
    fn drop(&mut self) {
        for left in self.left.values() {
            // One that has ended takes no notice.
            left.tenant.kill();
        }
    }
}
