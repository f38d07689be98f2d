//! One actor under a guard and under no supervisor: what a process that hosts a single application runs.

use std::sync::Mutex;

use tokio::sync::oneshot;

use super::{
    Launch, ReadyGate, Reason,
    guard::Guard,
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
    let tenant = Tenant::new(Vitals::new("alone"), None, None, report);
    if let Some(guard) = Guard::make(launch, ready, tenant.clone()) {
        actix_rt::spawn(guard);
    }
    (AloneHandle(tenant), async { ended.await.unwrap_or(Reason::ThreadEnded) })
}
