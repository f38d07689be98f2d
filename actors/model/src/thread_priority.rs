//! Threads with a lower priority than those that carry messages.

#[cfg(target_os = "linux")]
use rustix::process::{getpriority_process, setpriority_process};
use sinew_runtime::supervision::set_normal_schedule;

/// The nice value added: on a full CPU such a thread gets a third of the time of others. It needs no
/// privilege. Threads that have just written or read run first, and the work that accumulates meanwhile is
/// done in one batch.
#[cfg(target_os = "linux")]
const NICE_ADDED: i32 = 5;

/// Gives the calling thread a lower priority than the thread that created it, which may also have a real-time priority.
pub fn lower_priority() {
    // Both calls affect the calling thread, despite their names. The thread continues unchanged if the system
    // refuses them.
    #[cfg(target_os = "linux")]
    let nice = getpriority_process(None);
    set_normal_schedule();
    #[cfg(target_os = "linux")]
    if let Ok(nice) = nice {
        let _ = setpriority_process(None, nice + NICE_ADDED);
    }
}
