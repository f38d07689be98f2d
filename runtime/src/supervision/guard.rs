//! The guard around a supervised actor: catches its panics, takes its stop order, and says how it ended.

use std::{
    any::Any,
    panic::{AssertUnwindSafe, catch_unwind},
    pin::Pin,
    sync::{Arc, Mutex},
    task::{Context, Poll, Waker},
};

use actix::{
    Actor,
    dev::{AsyncContextParts, ContextFut},
};

use crate::{post::lock, supervision::Reason};

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

/// How a supervisor reaches an actor from another thread. Not through the actor's queue: that may be full, or unread.
#[derive(Clone, Debug, Default)]
pub(super) struct Leash(Arc<Mutex<LeashState>>);

#[derive(Debug, Default)]
struct LeashState {
    stop: bool,
    kill: bool,
    /// The actor is gone.
    ended: bool,
    waker: Option<Waker>,
}

impl Leash {
    /// Asks the actor to stop.
    pub(super) fn stop(&self) {
        self.pull(|state| state.stop = true);
    }

    /// Takes the actor's life the next time that its thread is free.
    pub(super) fn kill(&self) {
        self.pull(|state| state.kill = true);
    }

    /// Whether the actor is gone.
    pub(super) fn has_ended(&self) -> bool {
        lock(&self.0).ended
    }

    fn pull(&self, order: impl FnOnce(&mut LeashState)) {
        let waker = {
            let mut state = lock(&self.0);
            order(&mut state);
            state.waker.take()
        };
        if let Some(waker) = waker {
            waker.wake();
        }
    }
}

/// The guarded actor: a future that never panics and reports its end exactly once.
pub(super) struct Guard {
    life: Option<Box<dyn Life>>,
    leash: Leash,
    report: Option<Box<dyn FnOnce(Reason) + Send>>,
}

impl Guard {
    pub(super) fn new(life: Box<dyn Life>, leash: Leash, report: Box<dyn FnOnce(Reason) + Send>) -> Self {
        Self { life: Some(life), leash, report: Some(report) }
    }

    fn end(&mut self, reason: Reason) {
        if let Some(life) = self.life.take() {
            bury(life);
        }
        lock(&self.leash.0).ended = true;
        if let Some(report) = self.report.take() {
            report(reason);
        }
    }
}

/// Drops an actor whose code may panic once more while it is dropped.
fn bury(mut life: Box<dyn Life>) {
    let buried = catch_unwind(AssertUnwindSafe(|| {
        life.terminate();
        drop(life);
    }));
    if let Err(panic) = buried {
        tracing::error!(said = words(&*panic), "an actor panicked while it was dropped");
        // Dropping what a panic carries may panic too; there is nothing left to be done about that.
        let _ = catch_unwind(AssertUnwindSafe(|| drop(panic)));
    }
}

impl Future for Guard {
    type Output = ();

    fn poll(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<()> {
        let (stop, kill) = {
            let mut state = lock(&self.leash.0);
            state.waker = Some(cx.waker().clone());
            (std::mem::take(&mut state.stop), state.kill)
        };
        if kill {
            self.end(Reason::Killed);
            return Poll::Ready(());
        }
        let Some(life) = &mut self.life else { return Poll::Ready(()) };
        let polled = catch_unwind(AssertUnwindSafe(|| {
            if stop {
                life.stop();
            }
            life.poll(cx)
        }));
        match polled {
            Ok(Poll::Pending) => Poll::Pending,
            Ok(Poll::Ready(reason)) => {
                self.end(reason);
                Poll::Ready(())
            }
            Err(panic) => {
                self.end(Reason::Panic(words(&*panic)));
                Poll::Ready(())
            }
        }
    }
}

impl Drop for Guard {
    fn drop(&mut self) {
        // The arbiter's thread ends with the actor still in it.
        self.end(Reason::ThreadEnded);
    }
}

/// What a panic said.
pub(super) fn words(panic: &(dyn Any + Send)) -> String {
    let text = panic.downcast_ref::<&str>().map(|text| (*text).to_owned());
    text.or_else(|| panic.downcast_ref::<String>().cloned())
        .unwrap_or_else(|| "something that is not text".to_owned())
}
