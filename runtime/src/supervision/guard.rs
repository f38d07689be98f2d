//! The guard around a supervised actor: catches its panics, takes its stop order, and says how it ended.

use std::{
    any::Any,
    panic::{AssertUnwindSafe, catch_unwind},
    pin::Pin,
    sync::Arc,
    task::{Context, Poll},
};

use actix::{
    Actor,
    dev::{AsyncContextParts, ContextFut},
};

use super::{
    Burials, Launch, ReadyGate, Reason,
    panics::Caught,
    tenant::{Fate, Tenant},
    vitals::{Doing, Over, Vitals},
};
use crate::{outcome::Outcome, safe_wake::SafeWaker, time::Time};

/// A running actor of any type, as its guard sees it.
pub trait Life {
    /// Lets it run. Ready when it has ended, with how.
    fn poll(&mut self, cx: &mut Context<'_>) -> Poll<Reason>;
    /// Asks it to stop; actix then asks its `stopping`.
    fn stop(&mut self);
    /// Makes sure that dropping it runs no more of its code than its `Drop`.
    fn terminate(&mut self);
}

struct ActixLife<A, C>(ContextFut<A, C>)
where
    C: AsyncContextParts<A> + Unpin,
    A: Actor<Context = C>;

impl<A, C> Life for ActixLife<A, C>
where
    C: AsyncContextParts<A> + Unpin,
    A: Actor<Context = C>,
{
    fn poll(&mut self, cx: &mut Context<'_>) -> Poll<Reason> {
        Pin::new(&mut self.0).poll(cx).map(|()| Reason::Normal)
    }

    fn stop(&mut self) {
        self.0.ctx().stop();
    }

    fn terminate(&mut self) {
        // Without it the drop would poll the actor once more, on its broken state (`docs/decisions/0001-actix.md`).
        self.0.ctx().terminate();
    }
}

/// A running actix actor, to be guarded.
pub fn life<A, C>(actor: ContextFut<A, C>) -> Box<dyn Life>
where
    C: AsyncContextParts<A> + Unpin + 'static,
    A: Actor<Context = C>,
{
    Box::new(ActixLife(actor))
}

/// The guarded actor: a future that never panics and reports its end exactly once.
pub(super) struct Guard {
    life: Option<Box<dyn Life>>,
    tenant: Tenant,
    /// Out while the actor has its turn.
    vitals: Option<Arc<Vitals>>,
    was_polled: bool,
    has_reported: bool,
    /// How it ended does not depend on its drop.
    ends_before_its_drop: bool,
    /// Where what its panics carry is dropped.
    burials: Burials,
    waker: SafeWaker,
}

impl Guard {
    /// Guards an actor that is made.
    pub(super) fn around(life: Option<Box<dyn Life>>, tenant: Tenant, burials: Burials) -> Self {
        let vitals = Some(tenant.vitals().clone());
        let (was_polled, has_reported, ends_before_its_drop) = (false, false, false);
        let waker = SafeWaker::default();
        Self { life, tenant, vitals, was_polled, has_reported, ends_before_its_drop, burials, waker }
    }

    /// Guards one that has done all that it is for when it has ended: what it drops then is not its own.
    pub(super) fn around_overseer(life: Box<dyn Life>, tenant: Tenant) -> Self {
        let mut guard = Self::around(Some(life), tenant, Burials::default());
        guard.ends_before_its_drop = true;
        guard
    }

    /// Makes an actor, on its thread. `None` if its code panicked, which is reported.
    pub(super) fn make(launch: &Launch, ready: ReadyGate, tenant: Tenant, burials: Burials) -> Option<Self> {
        let mut guard = Self::around(None, tenant, burials);
        let made = Vitals::turn(&mut guard.vitals, Doing::Start, || {
            catch_unwind(AssertUnwindSafe(|| launch(ready)))
        });
        match made {
            Ok(life) => {
                guard.life = Some(life);
                Some(guard)
            }
            Err(panic) => {
                guard.end_in(panic);
                None
            }
        }
    }

    /// What a turn is called until something in it has a better name.
    const fn doing(&self, stops: bool) -> Doing {
        match (self.was_polled, stops) {
            (_, true) => Doing::Stop,
            (false, false) => Doing::Start,
            (true, false) => Doing::Task,
        }
    }

    /// It panicked. That is told before anything becomes of what the panic carries.
    fn end_in(&mut self, panic: Box<dyn Any + Send>) {
        let Caught { words, carried } = Caught::new(panic);
        self.end(Reason::Panic(words));
        self.bury_carried(carried);
    }

    fn bury_carried(&self, carried: Option<Box<dyn Any + Send>>) {
        if let Some(carried) = carried {
            self.burials.bury(self.tenant.vitals().name(), carried);
        }
    }

    fn end(&mut self, mut reason: Reason) {
        let mut carried = None;
        if let Some(life) = self.life.take() {
            let caught = Vitals::turn(&mut self.vitals, Doing::Drop, || bury(life));
            if let Some(caught) = caught {
                carried = caught.carried;
                // Not where it has failed already: the first failure is the reason.
                if !reason.is_failure() && !self.ends_before_its_drop {
                    reason = Reason::Panic(caught.words);
                }
            }
        }
        if !std::mem::replace(&mut self.has_reported, true) {
            let vitals = self.tenant.vitals();
            // A message in the hand of one that panicked was settled by nobody.
            vitals.settle(Outcome::Failed);
            // Who holds its sender on another thread does not speak beside its next life.
            vitals.fence();
            vitals.set_gone();
            if let Some(since) = self.tenant.holds_its_thread() {
                let (actor, away) = (vitals.name(), Time::now().since(since));
                crate::log::warn!(actor, ?away, "came back too late: it is dropped, and its thread ends");
            }
            self.tenant.report(Fate::Ended(reason));
        }
        self.bury_carried(carried);
    }
}

/// Drops an actor whose code may panic while it is dropped, even if that is not the first time; its panic then.
fn bury(mut life: Box<dyn Life>) -> Option<Caught> {
    let buried = catch_unwind(AssertUnwindSafe(|| {
        life.terminate();
        drop(life);
    }));
    let panic = buried.err()?;
    // A life that was taken leaves its drop as it leaves any turn.
    (!panic.is::<Over>()).then(|| Caught::new(panic))
}

impl Future for Guard {
    type Output = ();

    fn poll(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<()> {
        let this = &mut *self;
        // All that the actor waits for wakes it by this one.
        let mut safe = std::mem::take(&mut this.waker);
        let mut cx = Context::from_waker(safe.of(cx.waker()));
        let told = this.tenant.told(cx.waker());
        if told.kill {
            this.end(Reason::Killed);
            return Poll::Ready(());
        }
        let doing = this.doing(told.stop);
        this.was_polled = true;
        let Some(life) = &mut this.life else { return Poll::Ready(()) };
        let polled = Vitals::turn(&mut this.vitals, doing, || {
            catch_unwind(AssertUnwindSafe(|| {
                if told.stop {
                    life.stop();
                }
                life.poll(&mut cx)
            }))
        });
        let reason = match polled {
            Ok(Poll::Pending) if !this.tenant.vitals().is_over() => {
                this.waker = safe;
                return Poll::Pending;
            }
            Ok(Poll::Pending) => Reason::Killed,
            Err(panic) if panic.is::<Over>() => Reason::Killed,
            Ok(Poll::Ready(reason)) => reason,
            Err(panic) => {
                this.end_in(panic);
                return Poll::Ready(());
            }
        };
        this.end(reason);
        Poll::Ready(())
    }
}

impl Drop for Guard {
    fn drop(&mut self) {
        // The arbiter's thread ends with the actor still in it.
        self.end(Reason::ThreadEnded);
    }
}
