//! An actix system per thread: an actor that calls `actix::System::current().stop()` stops that system, and
//! not its node.

use std::{cell::RefCell, io};

use actix_rt::{Runtime, System, SystemStop};

thread_local! {
    static OWN: RefCell<Option<System>> = const { RefCell::new(None) };
}

/// The runtime of a thread, with an actix system of its own.
pub(super) struct OwnSystem(pub(super) tokio::runtime::Runtime);

impl From<OwnSystem> for Runtime {
    fn from(OwnSystem(runtime): OwnSystem) -> Self {
        let runner = System::with_tokio_rt(|| runtime);
        OWN.set(System::try_current());
        // The arbiter drives this runtime, and with it the system.
        let (runtime, stop) = runner.into_parts();
        runtime.spawn(log_system_stop(stop));
        runtime
    }
}

/// Makes the thread's own system the current one. The arbiter has set that of the creating thread.
pub(super) fn set_own_system() {
    if let Some(own) = OWN.take() {
        System::set_current(own);
    }
}

/// Registers the threads that are created on the calling one, the root thread, with a system that has no
/// controller. An actor that stops the system of their creation then stops nothing.
///
/// Call it once, within that thread's own system.
///
/// # Errors
/// The system refuses a descriptor or memory for a reactor.
pub fn detach_threads() -> io::Result<()> {
    let reactor = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    // The controller of this system ends here.
    drop(System::with_tokio_rt(|| reactor));
    Ok(())
}

/// Logs an actor's attempt to stop a system that it does not own.
pub async fn log_system_stop(stop: SystemStop) {
    if stop.await.is_ok() {
        let thread = crate::thread::system::thread_id();
        crate::log::error!(
            thread,
            "an actor on this thread has called `actix::System::current().stop()`: that ends only the tasks \
             that the actor has started on its own arbiters; an application ends by `context.stop()`, its node by `NodeHandle::stop`"
        );
    }
}
