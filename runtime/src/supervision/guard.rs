//! The guard around a supervised actor: it catches panics, executes the stop order, and reports the end.

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
    DropQueue, Launch, ReadyGate, Reason,
    actor_handle::{ActorEvent, ActorHandle},
    liveness::{Activity, FencedUnwind, Liveness},
    panics::Caught,
};
use crate::{outcome::Outcome, safe_wake::SafeWaker, time::Time};

/// A running actor of any type, as its guard uses it.
pub trait RunningActor {
    /// Polls the actor. Ready when the actor has ended, with the reason.
    fn poll(&mut self, cx: &mut Context<'_>) -> Poll<Reason>;
    /// Requests a stop; actix then calls the actor's `stopping`.
    fn stop(&mut self);
    /// Ensures that dropping the actor runs none of its code except its `Drop`.
    fn terminate(&mut self);
}

struct ActixActor<A, C>(ContextFut<A, C>)
where
    C: AsyncContextParts<A> + Unpin,
    A: Actor<Context = C>;

impl<A, C> RunningActor for ActixActor<A, C>
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
        // Otherwise the drop would poll the actor once more, in its inconsistent state
        // (`docs/decisions/0001-actix.md`).
        self.0.ctx().terminate();
    }
}

/// A running actix actor, to be guarded.
pub fn running_actor<A, C>(actor: ContextFut<A, C>) -> Box<dyn RunningActor>
where
    C: AsyncContextParts<A> + Unpin + 'static,
    A: Actor<Context = C>,
{
    Box::new(ActixActor(actor))
}

/// The guarded actor: a future that never panics and reports its end exactly once.
pub(super) struct Guard {
    actor: Option<Box<dyn RunningActor>>,
    handle: ActorHandle,
    /// `None` during the actor's turn.
    liveness: Option<Arc<Liveness>>,
    was_polled: bool,
    has_reported: bool,
    /// Whether a panic of its drop is ignored in its end reason.
    ends_before_its_drop: bool,
    /// The queue where the payloads of its panics are dropped.
    drop_queue: DropQueue,
    waker: SafeWaker,
}

impl Guard {
    /// Creates the guard of an actor that exists.
    pub(super) fn around(
        actor: Option<Box<dyn RunningActor>>,
        handle: ActorHandle,
        drop_queue: DropQueue,
    ) -> Self {
        let liveness = Some(handle.liveness().clone());
        let (was_polled, has_reported, ends_before_its_drop) = (false, false, false);
        let waker = SafeWaker::default();
        Self { actor, handle, liveness, was_polled, has_reported, ends_before_its_drop, drop_queue, waker }
    }

    /// Creates the guard of an overseer, which is complete when it ends: the values that it drops then are not its own.
    pub(super) fn around_overseer(actor: Box<dyn RunningActor>, handle: ActorHandle) -> Self {
        let mut guard = Self::around(Some(actor), handle, DropQueue::default());
        guard.ends_before_its_drop = true;
        guard
    }

    /// Creates an actor, on its thread. Returns `None` if its code panicked, which is reported.
    pub(super) fn make(
        launch: &Launch,
        ready: ReadyGate,
        handle: ActorHandle,
        drop_queue: DropQueue,
    ) -> Option<Self> {
        let mut guard = Self::around(None, handle, drop_queue);
        let made = Liveness::turn(&mut guard.liveness, Activity::Start, || {
            catch_unwind(AssertUnwindSafe(|| launch(ready)))
        });
        match made {
            Ok(actor) => {
                guard.actor = Some(actor);
                Some(guard)
            }
            Err(panic) => {
                guard.end_in(panic);
                None
            }
        }
    }

    /// Returns the activity of a turn before a more specific one is known.
    const fn activity(&self, stops: bool) -> Activity {
        match (self.was_polled, stops) {
            (_, true) => Activity::Stop,
            (false, false) => Activity::Start,
            (true, false) => Activity::Task,
        }
    }

    /// Ends the actor after a panic. The end is reported before the panic's payload is dropped.
    fn end_in(&mut self, panic: Box<dyn Any + Send>) {
        let Caught { message, payload } = Caught::new(panic);
        self.end(Reason::Panic(message));
        self.defer_payload_drop(payload);
    }

    fn defer_payload_drop(&self, payload: Option<Box<dyn Any + Send>>) {
        if let Some(payload) = payload {
            self.drop_queue.push(self.handle.liveness().name(), payload);
        }
    }

    fn end(&mut self, mut reason: Reason) {
        let mut payload = None;
        if let Some(actor) = self.actor.take() {
            let caught = Liveness::turn(&mut self.liveness, Activity::Drop, || drop_actor(actor));
            if let Some(caught) = caught {
                payload = caught.payload;
                // Not if it has failed already: the first failure is the reason.
                if !reason.is_failure() && !self.ends_before_its_drop {
                    reason = Reason::Panic(caught.message);
                }
            }
        }
        if !std::mem::replace(&mut self.has_reported, true) {
            let liveness = self.handle.liveness();
            // The message that a panicking actor was handling is not settled yet.
            liveness.settle(Outcome::Failed);
            // Another thread may hold its sender, which must not send beside the next incarnation.
            liveness.fence();
            liveness.set_ended();
            if let Some(since) = self.handle.blocked_since() {
                let (actor, blocked) = (liveness.name(), Time::now().since(since));
                crate::log::warn!(
                    actor,
                    ?blocked,
                    "the actor returned too late: it is dropped, and its thread ends"
                );
            }
            self.handle.report(ActorEvent::Ended(reason));
        }
        self.defer_payload_drop(payload);
    }
}

/// Drops an actor; its drop may panic, perhaps after an earlier panic. Returns that panic.
fn drop_actor(mut actor: Box<dyn RunningActor>) -> Option<Caught> {
    let dropped = catch_unwind(AssertUnwindSafe(|| {
        actor.terminate();
        drop(actor);
    }));
    let panic = dropped.err()?;
    // A fenced incarnation leaves its drop in the same way as a turn.
    (!panic.is::<FencedUnwind>()).then(|| Caught::new(panic))
}

impl Future for Guard {
    type Output = ();

    fn poll(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<()> {
        let this = &mut *self;
        // Every wake of the actor goes through this waker.
        let mut safe = std::mem::take(&mut this.waker);
        let mut cx = Context::from_waker(safe.of(cx.waker()));
        let orders = this.handle.take_orders(cx.waker());
        if orders.kill {
            this.end(Reason::Killed);
            return Poll::Ready(());
        }
        let activity = this.activity(orders.stop);
        this.was_polled = true;
        let Some(actor) = &mut this.actor else { return Poll::Ready(()) };
        let polled = Liveness::turn(&mut this.liveness, activity, || {
            catch_unwind(AssertUnwindSafe(|| {
                if orders.stop {
                    actor.stop();
                }
                actor.poll(&mut cx)
            }))
        });
        let reason = match polled {
            Ok(Poll::Pending) if !this.handle.liveness().is_fenced() => {
                this.waker = safe;
                return Poll::Pending;
            }
            Ok(Poll::Pending) => Reason::Killed,
            Err(panic) if panic.is::<FencedUnwind>() => Reason::Killed,
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
        // The arbiter's thread ends before the actor.
        self.end(Reason::ThreadEnded);
    }
}
