//! Threads for what can wait: nicer than those that carry messages.

#[cfg(target_os = "linux")]
use rustix::process::{getpriority_process, setpriority_process};
use sinew_runtime::supervision::make_ordinary;

/// How much nicer they are: on a full CPU such a thread has a third of what others have. It need not be asked for, and lets those run on who
/// have just written or read something: what waits meanwhile goes in one.
#[cfg(target_os = "linux")]
const NICER: i32 = 5;

/// Makes the calling thread nicer than who made it, who may have a real-time priority besides.
pub(crate) fn give_way() {
    // Both are about the calling thread, whatever their names say. It goes on as it is where the system refuses it.
    #[cfg(target_os = "linux")]
    let nice = getpriority_process(None);
    make_ordinary();
    #[cfg(target_os = "linux")]
    if let Ok(nice) = nice {
        let _ = setpriority_process(None, nice + NICER);
    }
}
