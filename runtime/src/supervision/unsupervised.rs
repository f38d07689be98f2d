//! One actor with a guard and without a supervisor: the actor of a process that hosts one application, or a
//! supervisor itself.

use std::{
    pin::Pin,
    sync::{Arc, Mutex},
    task::{Context, Poll, ready},
    time::Duration,
};

use actix::Actor;
use tokio::sync::oneshot;

use super::{
    DropQueue, Launch, ReadyGate, Reason,
    actor_handle::{ActorEvent, ActorHandle, Report},
    guard::{Guard, running_actor},
    liveness::Liveness,
    panics::install_hook,
    place::Place,
    threads::{ThreadSlot, Turn},
    watchdog::Watchdog,
};
use crate::{lock, thread::mark_runtime_thread, tid::Tid};

/// The watchdog of an actor without a supervisor: its thread is started in advance.
#[derive(Debug)]
pub struct WatchdogHandle(Arc<Watchdog>);

impl WatchdogHandle {
    /// Starts the watchdog thread, if the actor `is_watched`, so if it has a progress budget. Call it before
    /// the calling thread is [prepared](Place::prepare). The actor may hang in its first turn, with a
    /// real-time priority and one CPU. A thread that is created there would then never start.
    #[must_use]
    pub fn begin(is_watched: bool) -> Self {
        let watchdog = Arc::new(Watchdog::default());
        if is_watched {
            watchdog.begin();
        }
        Self(watchdog)
    }
}

/// The watch parameters of an actor without a supervisor.
pub struct Unsupervised {
    /// The watchdog.
    pub watchdog_handle: WatchdogHandle,
    /// The name of the actor, for people.
    pub name: String,
    /// The address of the actor, if it is an application.
    pub tid: Option<Tid>,
    /// The place of the calling thread.
    pub place: Place,
    /// Maximum duration of one turn; `None`: no limit.
    pub progress_within: Option<Duration>,
    /// Called from another thread when the actor hangs; the reason has the actor, the start and the activity.
    /// The actor is fenced then: it sends and receives nothing any more.
    pub on_hung: Box<dyn Fn(&Reason) + Send + Sync>,
}

impl std::fmt::Debug for Unsupervised {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Unsupervised({} {:?})", self.name, self.progress_within)
    }
}

/// A handle to stop an actor that was started by [`run_unsupervised`]. The actor is watched while the handle
/// exists.
#[derive(Clone)]
pub struct UnsupervisedHandle {
    handle: ActorHandle,
    _watchdog: Arc<Watchdog>,
}

impl std::fmt::Debug for UnsupervisedHandle {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "UnsupervisedHandle({})", self.handle.liveness().name())
    }
}

impl UnsupervisedHandle {
    /// Requests that the actor stops; its `stopping` may delay that.
    pub fn stop(&self) {
        self.handle.stop();
    }

    /// Returns the current activity of the actor. Reads the state that its thread writes, without waiting for it.
    #[must_use]
    pub fn turn(&self) -> Turn {
        Turn::of(&self.handle)
    }
}

/// Starts an actor on the calling thread, which must be that of an actix system. The future ends with the
/// actor, and returns the reason.
pub fn run_unsupervised(
    launch: &Launch,
    ready: ReadyGate,
    actor: Unsupervised,
) -> (UnsupervisedHandle, impl Future<Output = Reason> + use<>) {
    let Unsupervised {
        watchdog_handle: WatchdogHandle(watchdog),
        name,
        tid,
        place,
        progress_within,
        on_hung,
    } = actor;
    let (report, ended) = report(on_hung);
    let liveness = Liveness::of(name, tid);
    let slot = ThreadSlot::of_this_thread(&place);
    let handle = ActorHandle::new(liveness.clone(), Some(slot), progress_within, report);
    watchdog.watch(&handle);
    let ready = ReadyGate::new(move || {
        liveness.set_ready();
        ready.reached();
    });
    if let Some(guard) = Guard::make(launch, ready, handle.clone(), DropQueue::default()) {
        actix_rt::spawn(guard);
    }
    (UnsupervisedHandle { handle, _watchdog: watchdog }, ended)
}

/// Runs a supervising actor that has no supervisor itself, on the calling thread. The future ends with the
/// actor, and returns the reason, so that a panic is not lost.
pub fn overseen<A>(name: &str, actor: A) -> impl Future<Output = Reason> + use<A>
where
    A: Actor<Context = actix::Context<A>>,
{
    // This actor has no watchdog, so it must never block, not even on its own log.
    mark_runtime_thread();
    let (report, ended) = report(Box::new(|_| {}));
    let handle = ActorHandle::new(Liveness::new(name), None, None, report);
    actix_rt::spawn(Guard::around_overseer(running_actor(actix::Context::new().into_future(actor)), handle));
    ended
}

/// An actor without a supervisor that its owner polls: it is no task, so its owner knows when it has no work.
pub struct PolledActor {
    /// `None` after its end.
    guard: Option<Guard>,
    ended: Pin<Box<dyn Future<Output = Reason>>>,
}

impl std::fmt::Debug for PolledActor {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "PolledActor({})", if self.guard.is_some() { "running" } else { "ended" })
    }
}

impl PolledActor {
    /// Creates the actor called `name` on the calling thread, which must be that of an actix system. No watchdog
    /// watches it.
    #[must_use]
    pub fn start(launch: &Launch, ready: ReadyGate, name: &str, tid: Tid) -> Self {
        let (report, ended) = report(Box::new(|_| {}));
        let handle = ActorHandle::new(Liveness::of(name, Some(tid)), None, None, report);
        let guard = Guard::make(launch, ready, handle, DropQueue::default());
        Self { guard, ended: Box::pin(ended) }
    }

    /// Polls the actor. Ready when it has ended, with the reason; it must not be polled again then.
    pub fn poll(&mut self, task: &mut Context<'_>) -> Poll<Reason> {
        if let Some(guard) = &mut self.guard {
            ready!(Pin::new(guard).poll(task));
            self.guard = None;
        }
        self.ended.as_mut().poll(task)
    }
}

/// Creates the report function of an incarnation; the future ends with that incarnation.
fn report(on_hung: Box<dyn Fn(&Reason) + Send + Sync>) -> (Report, impl Future<Output = Reason>) {
    install_hook();
    let (reason_sender, ended) = oneshot::channel();
    let reason_sender = Mutex::new(Some(reason_sender));
    let report: Report = Box::new(move |event| match event {
        ActorEvent::Hung(reason) => on_hung(&reason),
        ActorEvent::Ended(reason) => {
            if let Some(reason_sender) = lock(&reason_sender).take() {
                // The send fails only if the caller does not wait for the end.
                let _ = reason_sender.send(reason);
            }
        }
    });
    (report, async { ended.await.unwrap_or(Reason::ThreadEnded) })
}
