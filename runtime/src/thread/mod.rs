//! The calling thread: its role, its schedule, and operations of the system on it.

use std::cell::Cell;

use thread_priority::{
    NormalThreadSchedulePolicy, ThreadPriority, ThreadSchedulePolicy, set_thread_priority_and_policy,
    thread_native_id,
};

#[cfg(not(target_os = "linux"))]
pub(crate) mod elsewhere;
#[cfg(target_os = "linux")]
pub(crate) mod linux;

#[cfg(not(target_os = "linux"))]
pub(crate) use self::elsewhere as system;
#[cfg(target_os = "linux")]
pub(crate) use self::linux as system;

/// The role of a thread.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Role {
    /// A thread that is unknown here.
    Foreign,
    /// A thread of the runtime: blocking it blocks actors, or their watchdog.
    Runtime,
    /// The log thread.
    Log,
}

thread_local! {
    static ROLE: Cell<Role> = const { Cell::new(Role::Foreign) };
}

/// Returns the role of the calling thread.
pub(crate) fn role() -> Role {
    // A thread at its end may have destroyed this variable.
    ROLE.try_with(Cell::get).unwrap_or(Role::Foreign)
}

/// Marks the calling thread as one of the runtime: its panics are reported by the log thread.
pub(crate) fn mark_runtime_thread() {
    ROLE.set(Role::Runtime);
}

/// Marks the calling thread as the log thread.
pub(crate) fn mark_log_thread() {
    ROLE.set(Role::Log);
}

/// The middle of `thread_priority`'s scale of 0 to 99, which is a niceness of 0.
const MIDDLE: u8 = 48;

/// Sets the calling thread to the ordinary schedule: a new thread inherits that of its creator.
pub fn set_normal_schedule() {
    let policy = ThreadSchedulePolicy::Normal(NormalThreadSchedulePolicy::Other);
    let level = ThreadPriority::Crossplatform(MIDDLE.try_into().expect("it is on the scale"));
    // The schedule itself is never refused; the niceness may stay unchanged.
    let _ = set_thread_priority_and_policy(thread_native_id(), level, policy);
}

/// Same as [`set_normal_schedule`], and sets the affinity to the CPUs that the process was started with.
pub(crate) fn reset_schedule() {
    // If it is refused, the thread keeps the inherited affinity.
    let _ = system::restore_affinity();
    set_normal_schedule();
}
