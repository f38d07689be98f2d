//! Timers for whoever polls a future of this crate's: by tokio, with or without a runtime of tokio's on the polling thread.

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

/// A timer that ends after `within`. `None` where there is no runtime, and the system gives none: that is logged.
pub(super) fn sleep(within: Duration) -> Option<Pin<Box<Sleep>>> {
    if Handle::try_current().is_ok() {
        return Some(Box::pin(tokio::time::sleep(within)));
    }
    let kept = kept()?;
    let _entered = kept.enter();
    Some(Box::pin(tokio::time::sleep(within)))
}

/// The runtime that is kept for those who have none. It has nothing but timers, and is made when the first one needs it.
fn kept() -> Option<Handle> {
    static KEPT: Mutex<Option<Handle>> = Mutex::new(None);
    // Whoever panicked with it has left it whole.
    let mut kept = KEPT.lock().unwrap_or_else(PoisonError::into_inner);
    if kept.is_none() {
        match begin() {
            Ok(handle) => *kept = Some(handle),
            Err(error) => {
                let remedy = remedy(Wanted::Reactor, &error);
                crate::log::error!(%error, %remedy, "no timer, so that a wait without a runtime ends at once");
            }
        }
    }
    kept.clone()
}

fn begin() -> std::io::Result<Handle> {
    let runtime = Builder::new_current_thread().enable_time().build()?;
    let handle = runtime.handle().clone();
    std::thread::Builder::new().name("deadlines".to_owned()).spawn(move || {
        // Who is woken is foreign, and may panic over it: the others have their timers all the same.
        while catch_unwind(|| runtime.block_on(pending::<()>())).is_err() {}
    })?;
    Ok(handle)
}
