//! Tells a child of `fork` from the process that registered.
//!
//! Both would write into one connection. So what a process registered is refused to its children, at the cost of one load
//! a call; asking the system for the process id would be a system call each time.

use std::{
    ffi::c_int,
    sync::{
        OnceLock,
        atomic::{AtomicU32, Ordering},
    },
};

use crate::status::{Fault, Status};

static FORKS: AtomicU32 = AtomicU32::new(0);

type Handler = Option<extern "C" fn()>;

// SAFETY: this is POSIX's own declaration.
unsafe extern "C" {
    fn pthread_atfork(prepare: Handler, parent: Handler, child: Handler) -> c_int;
}

/// Runs in every child, when only one thread is there and no lock may be waited for.
extern "C" fn count_in_child() {
    FORKS.fetch_add(1, Ordering::Relaxed);
}

/// From now on, forks are counted.
pub(crate) fn watch() -> Result<(), Fault> {
    static WATCHED: OnceLock<c_int> = OnceLock::new();
    let error = *WATCHED.get_or_init(|| {
        // SAFETY: the handler only counts, which is allowed in a child; this library is not unloaded before the process
        // ends or, if it is, the C library takes the handler out with it.
        unsafe { pthread_atfork(None, None, Some(count_in_child)) }
    });
    if error == 0 {
        return Ok(());
    }
    Err(Fault::new(Status::SinewErrorTooMany, "the system has no memory to watch for forks"))
}

/// How many forks lie between this process and the one that loaded the library.
pub(crate) fn generation() -> u32 {
    FORKS.load(Ordering::Relaxed)
}
