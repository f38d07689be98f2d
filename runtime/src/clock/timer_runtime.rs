//! Tokio timers for futures on the host's clock, with or without a tokio runtime on the polling thread.

use std::{
    future::pending,
    panic::catch_unwind,
    pin::Pin,
    sync::{Mutex, PoisonError},
    time::Duration,
};

use crate::remedy::{Wanted, remedy};
use tokio::{
    runtime::{Builder, Handle},
    time::Sleep,
};

/// Creates a timer that ends after `within`. Returns `None`, and logs that, if the thread has no runtime and
/// none can be created.
pub(super) fn sleep(within: Duration) -> Option<Pin<Box<Sleep>>> {
    if Handle::try_current().is_ok() {
        return Some(Box::pin(tokio::time::sleep(within)));
    }
    let runtime = shared_runtime()?;
    let _entered = runtime.enter();
    Some(Box::pin(tokio::time::sleep(within)))
}

/// Returns the shared runtime for threads without one. It has only timers, and is created at its first use.
fn shared_runtime() -> Option<Handle> {
    static SHARED: Mutex<Option<Handle>> = Mutex::new(None);
    // A thread that panicked with the lock cannot leave the value inconsistent.
    let mut runtime = SHARED.lock().unwrap_or_else(PoisonError::into_inner);
    if runtime.is_none() {
        match start_runtime() {
            Ok(handle) => *runtime = Some(handle),
            Err(error) => {
                let remedy = remedy(Wanted::Reactor, &error);
                crate::log::error!(%error, %remedy, "no timer, so that a wait without a runtime ends at once");
            }
        }
    }
    runtime.clone()
}

fn start_runtime() -> std::io::Result<Handle> {
    let runtime = Builder::new_current_thread().enable_time().build()?;
    let handle = runtime.handle().clone();
    std::thread::Builder::new().name("deadlines".to_owned()).spawn(move || {
        // A woken task is foreign code and may panic; other timers must continue.
        while catch_unwind(|| runtime.block_on(pending::<()>())).is_err() {}
    })?;
    Ok(handle)
}
