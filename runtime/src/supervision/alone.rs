//! One actor under a guard and under no supervisor: what a process that hosts a single application runs, and those who
//! supervise.

use std::sync::Mutex;

use actix::{Actor, Context};
use tokio::sync::oneshot;

use super::{
    Launch, ReadyGate, Reason,
    guard::{Guard, life},
    panics::install_hook,
    tenant::{Fate, Tenant},
    vitals::Vitals,
};
use crate::post::lock;

/// Stops an actor that was started [`alone`].
#[derive(Clone)]
pub struct AloneHandle(Tenant);

impl std::fmt::Debug for AloneHandle {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "AloneHandle({})", self.0.vitals().name())
    }
}

impl AloneHandle {
    /// Asks the actor to stop; its `stopping` may say that it goes on for a while.
    pub fn stop(&self) {
        self.0.stop();
    }
}

/// Makes an actor on the calling thread, which is an arbiter's or a system's. The future ends with it, and says how.
pub fn alone(launch: &Launch, ready: ReadyGate) -> (AloneHandle, impl Future<Output = Reason> + use<>) {
    let (tenant, ended) = tenant("alone");
    if let Some(guard) = Guard::make(launch, ready, tenant.clone()) {
        actix_rt::spawn(guard);
    }
    (AloneHandle(tenant), ended)
}

/// Runs an actor that supervises others, and is supervised by nobody, on the calling thread. The future ends with it, and
/// says how: a panic in it must not go unnoticed.
pub fn overseen<A>(name: &str, actor: A) -> impl Future<Output = Reason> + use<A>
where
    A: Actor<Context = Context<A>>,
{
    let (tenant, ended) = tenant(name);
    actix_rt::spawn(Guard::around(Some(life(Context::new().into_future(actor))), tenant));
    ended
}

fn tenant(name: &str) -> (Tenant, impl Future<Output = Reason> + use<>) {
    install_hook();
    let (say, ended) = oneshot::channel();
    let say = Mutex::new(Some(say));
    let report = Box::new(move |fate| {
        let (Fate::Hung(reason) | Fate::Ended(reason)) = fate;
        if let Some(say) = lock(&say).take() {
            // Whoever does not wait for the end does not want to know.
            let _ = say.send(reason);
        }
    });
    let tenant = Tenant::new(Vitals::new(name), None, None, report);
    (tenant, async { ended.await.unwrap_or(Reason::ThreadEnded) })
}
