//! One actor under a guard and under no supervisor: what a process that hosts a single application runs.

use std::panic::{AssertUnwindSafe, catch_unwind};

use tokio::sync::oneshot;

use super::{
    Launch, ReadyGate, Reason,
    guard::{Guard, Leash, words},
};

/// Stops an actor that was started [`alone`].
#[derive(Clone, Debug)]
pub struct AloneHandle(Leash);

impl AloneHandle {
    /// Asks the actor to stop; its `stopping` may say that it goes on for a while.
    pub fn stop(&self) {
        self.0.stop();
    }
}

/// Makes an actor on the calling thread, which is an arbiter's or a system's. The future ends with it, and says how.
pub fn alone(launch: &Launch, ready: ReadyGate) -> (AloneHandle, impl Future<Output = Reason> + use<>) {
    let leash = Leash::default();
    let (say, ended) = oneshot::channel();
    let report: Box<dyn FnOnce(Reason) + Send> = Box::new(move |reason| {
        // Whoever does not wait for the end does not want to know.
        let _ = say.send(reason);
    });
    match catch_unwind(AssertUnwindSafe(|| launch(ready))) {
        Ok(life) => {
            actix_rt::spawn(Guard::new(life, leash.clone(), report));
        }
        Err(panic) => report(Reason::Panic(words(&*panic))),
    }
    (AloneHandle(leash), async { ended.await.unwrap_or(Reason::ThreadEnded) })
}
