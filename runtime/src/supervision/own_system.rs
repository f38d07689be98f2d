//! A thread's own system of actix: what an actor stops when it calls `actix::System::current().stop()` is that, and not its
//! node.

use std::cell::RefCell;

use actix_rt::{Runtime, System, SystemStop};

thread_local! {
    static OWN: RefCell<Option<System>> = const { RefCell::new(None) };
}

/// A thread's runtime, with a system that is the thread's own.
pub(super) struct OwnSystem(pub(super) tokio::runtime::Runtime);

impl From<OwnSystem> for Runtime {
    fn from(OwnSystem(runtime): OwnSystem) -> Self {
        let runner = System::with_tokio_rt(|| runtime);
        OWN.set(System::try_current());
        // The arbiter drives this runtime, and with it the system.
        let (runtime, stop) = runner.into_parts();
        runtime.spawn(tell_of_a_stop(stop));
        runtime
    }
}

/// Makes the thread's own system the current one. The arbiter has made that of whoever started it.
pub(super) fn settle_in() {
    if let Some(own) = OWN.take() {
        System::set_current(own);
    }
}

/// Registers the threads that are made on the calling one, the root's, with nobody who could end them all: an actor that
/// finds the system in which they were made stops nothing with it.
///
/// Call it within that thread's own system, once.
pub fn part_from_threads() {
    // Its controller ends here.
    drop(System::new());
}

/// Says it, when an actor stops a system that is not its own to stop.
pub async fn tell_of_a_stop(stop: SystemStop) {
    if stop.await.is_ok() {
        let thread = super::system::thread_id();
        crate::log::error!(
            thread,
            "an actor on this thread has called `actix::System::current().stop()`: it ends nothing but what that actor \
             has started on arbiters of its own; an application ends by `context.stop()`, its node by `NodeHandle::stop`"
        );
    }
}
