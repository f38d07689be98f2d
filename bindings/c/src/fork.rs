//! Distinguishes a child of `fork` from the process that registered.
//!
//! Parent and child would both write into one connection. So a child's calls on its parent's endpoints are
//! rejected. The check costs one load per call; asking the system for the process ID would be a system call
//! each time.

use std::{
    ffi::c_int,
    sync::{
        OnceLock,
        atomic::{AtomicU32, Ordering},
    },
};

use crate::status::{CallError, Status};

static FORKS: AtomicU32 = AtomicU32::new(0);

type Handler = Option<extern "C" fn()>;

// SAFETY: this is POSIX's own declaration.
unsafe extern "C" {
    fn pthread_atfork(prepare: Handler, parent: Handler, child: Handler) -> c_int;
}

/// Runs in every child, when it has only one thread and must not wait for a lock.
extern "C" fn count_in_child() {
    FORKS.fetch_add(1, Ordering::Relaxed);
}

/// Starts counting forks.
pub(crate) fn watch() -> Result<(), CallError> {
    static WATCHED: OnceLock<c_int> = OnceLock::new();
    let error = *WATCHED.get_or_init(|| {
        // SAFETY: the handler only counts, which is allowed in a child. This library is not unloaded before
        // the process ends; if it is, the C library removes the handler with it.
        unsafe { pthread_atfork(None, None, Some(count_in_child)) }
    });
    if error == 0 {
        return Ok(());
    }
    Err(CallError::new(Status::SinewErrorTooMany, "the system has no memory to watch for forks"))
}

/// The number of forks between this process and the one that loaded the library.
pub(crate) fn generation() -> u32 {
    FORKS.load(Ordering::Relaxed)
}
