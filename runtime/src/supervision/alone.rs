//! One actor under a guard and under no supervisor: what a process that hosts a single application runs, and those who
//! supervise.

use std::{
    sync::{Arc, Mutex},
    time::Duration,
};

use actix::{Actor, Context};
use tokio::sync::oneshot;

use super::{
    Burials, Launch, ReadyGate, Reason,
    guard::{Guard, life},
    panics::{install_hook, is_the_runtimes},
    place::Place,
    tenant::{Fate, Report, Tenant},
    threads::{Seat, Turn},
    vitals::Vitals,
    watchdog::Watchdog,
};
use crate::{post::lock, tid::Tid};

/// Who sees whether an actor that has no supervisor hangs: a thread, which is there from the beginning.
#[derive(Debug)]
pub struct Watcher(Arc<Watchdog>);

impl Watcher {
    /// Makes the thread, if the actor `is_watched`: has a progress budget. To be called before the calling one is [prepared](Place::prepare): an actor that hangs in its first turn, on a thread
    /// with a real-time priority and one CPU, would keep a thread that is made there from ever beginning.
    #[must_use]
    pub fn begin(is_watched: bool) -> Self {
        let watchdog = Arc::new(Watchdog::default());
        if is_watched {
            watchdog.begin();
        }
        Self(watchdog)
    }
}

/// How an actor that has no supervisor is watched.
pub struct Alone {
    /// Who watches it.
    pub watcher: Watcher,
    /// Its name, for people.
    pub name: String,
    /// Its address, if it is an application.
    pub tid: Option<Tid>,
    /// The calling thread's place.
    pub place: Place,
    /// Longest time that one turn may take; `None`: as long as it likes.
    pub progress_within: Option<Duration>,
    /// Called from another thread when the actor does not come back, with who does not, since when and in what. It is then
    /// over: it sends nothing and takes nothing any more.
    pub on_hung: Box<dyn Fn(&Reason) + Send + Sync>,
}

impl std::fmt::Debug for Alone {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Alone({} {:?})", self.name, self.progress_within)
    }
}

/// Stops an actor that was started [`alone`]. While it lives the actor is watched.
#[derive(Clone)]
pub struct AloneHandle {
    tenant: Tenant,
    _watchdog: Arc<Watchdog>,
}

impl std::fmt::Debug for AloneHandle {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "AloneHandle({})", self.tenant.vitals().name())
    }
}

impl AloneHandle {
    /// Asks the actor to stop; its `stopping` may say that it goes on for a while.
    pub fn stop(&self) {
        self.tenant.stop();
    }

    /// What the actor does now. Reads what its thread writes, and does not wait for it.
    #[must_use]
    pub fn turn(&self) -> Turn {
        Turn::of(&self.tenant)
    }
}

/// Makes an actor on the calling thread, which is a system's of actix. The future ends with it, and says how.
pub fn alone(
    launch: &Launch,
    ready: ReadyGate,
    alone: Alone,
) -> (AloneHandle, impl Future<Output = Reason> + use<>) {
    let Alone { watcher: Watcher(watchdog), name, tid, place, progress_within, on_hung } = alone;
    let (report, ended) = report(on_hung);
    let vitals = Vitals::of(name, tid);
    let seat = Seat::of_this_thread(&place);
    let tenant = Tenant::new(vitals.clone(), Some(seat), progress_within, report);
    watchdog.watch(&tenant);
    let ready = ReadyGate::new(move || {
        vitals.set_ready();
        ready.reached();
    });
    if let Some(guard) = Guard::make(launch, ready, tenant.clone(), Burials::default()) {
        actix_rt::spawn(guard);
    }
    (AloneHandle { tenant, _watchdog: watchdog }, ended)
}

/// Runs an actor that supervises others, and is supervised by nobody, on the calling thread. The future ends with it, and
/// says how: a panic in it must not go unnoticed.
pub fn overseen<A>(name: &str, actor: A) -> impl Future<Output = Reason> + use<A>
where
    A: Actor<Context = Context<A>>,
{
    // Nobody watches it, so nobody says that it hangs: what it does waits for nothing, not even for its own log.
    is_the_runtimes();
    let (report, ended) = report(Box::new(|_| {}));
    let tenant = Tenant::new(Vitals::new(name), None, None, report);
    actix_rt::spawn(Guard::around_overseer(life(Context::new().into_future(actor)), tenant));
    ended
}

/// Takes what befalls a life; the future ends with its end.
fn report(on_hung: Box<dyn Fn(&Reason) + Send + Sync>) -> (Report, impl Future<Output = Reason>) {
    install_hook();
    let (say, ended) = oneshot::channel();
    let say = Mutex::new(Some(say));
    let report: Report = Box::new(move |fate| match fate {
        Fate::Hung(reason) => on_hung(&reason),
        Fate::Ended(reason) => {
            if let Some(say) = lock(&say).take() {
                // Whoever does not wait for the end does not want to know.
                let _ = say.send(reason);
            }
        }
    });
    (report, async { ended.await.unwrap_or(Reason::ThreadEnded) })
}
