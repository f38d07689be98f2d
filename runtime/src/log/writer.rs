//! The log thread, and its bounded queue.

use std::{
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{
        OnceLock,
        atomic::{AtomicU64, Ordering},
        mpsc::{Receiver, SyncSender, sync_channel},
    },
    time::{Duration, Instant},
};

use rustix::event::{PollFd, PollFlags, Timespec, poll};

use super::{event::immediately, stderr};

/// Maximum number of queued entries. Further ones are dropped and counted.
const QUEUE_MAX: usize = 1_024;

/// Time for a blocked standard error to become writable.
const WRITABLE_WITHIN: Timespec = Timespec { tv_sec: 0, tv_nsec: 20_000_000 };

/// Time between two checks of a full queue.
const PACE: Duration = Duration::from_millis(1);

/// Work for the log thread, of any duration.
type Entry = Box<dyn FnOnce() + Send>;

/// Number of dropped entries so far.
static LOST: AtomicU64 = AtomicU64::new(0);

/// Returns the number of events that were not written, because the log was blocked until its queue was full.
#[must_use]
pub fn lost() -> u64 {
    LOST.load(Ordering::Relaxed)
}

/// Starts the log thread, if it does not run. Otherwise the first thread that logs starts it, in the middle
/// of its own work.
pub fn begin() {
    let _ = queue();
}

/// Queues an entry, if there is room. Never blocks.
pub(crate) fn enqueue(entry: Entry) {
    if !try_enqueue(entry) {
        LOST.fetch_add(1, Ordering::Relaxed);
    }
}

/// Writes a line to the standard error, behind the queued log entries. For the text of an error that is
/// logged too. If the log itself goes to the standard error, nothing is added.
pub fn print(line: String) {
    enqueue(Box::new(move || {
        if !stderr::writes_errors() {
            stderr::write_text(&format!("{line}\n"));
        }
    }));
}

/// Waits until the current log entries are written, at most for `within`, for example before the process
/// ends. If the standard error is blocked, it returns almost at once.
pub fn flush(within: Duration) {
    let stderr = std::io::stderr();
    if poll(&mut [PollFd::new(&stderr, PollFlags::OUT)], Some(&WRITABLE_WITHIN)) == Ok(0) {
        return;
    }
    let until = Instant::now() + within;
    let (done, written) = sync_channel(1);
    let is_queued = || {
        let done = done.clone();
        try_enqueue(Box::new(move || _ = done.send(())))
    };
    // The queue has room as soon as an entry is written.
    while !is_queued() {
        if Instant::now() >= until {
            return;
        }
        std::thread::sleep(PACE);
    }
    let _ = written.recv_timeout(until.saturating_duration_since(Instant::now()));
}

fn try_enqueue(entry: Entry) -> bool {
    queue().is_some_and(|queue| queue.try_send(entry).is_ok())
}

/// Returns the queue, and starts its thread; `None` if the system gives none.
fn queue() -> Option<&'static SyncSender<Entry>> {
    static QUEUE: OnceLock<Option<SyncSender<Entry>>> = OnceLock::new();
    let start = || {
        let (queue, entries) = sync_channel(QUEUE_MAX);
        let thread = std::thread::Builder::new().name("log".to_owned());
        thread.spawn(move || write(&entries)).ok().map(|_| queue)
    };
    QUEUE.get_or_init(start).as_ref()
}

fn write(entries: &Receiver<Entry>) {
    crate::thread::mark_log_thread();
    // The thread that logged first may have an idle or a real-time schedule, which this thread inherits.
    crate::thread::reset_schedule();
    let mut reported = 0;
    for entry in entries {
        // A panic of a subscriber is reported by the panic hook, and the subscriber receives the next event.
        let _ = catch_unwind(AssertUnwindSafe(|| {
            let lost = lost();
            let new = lost - std::mem::replace(&mut reported, lost);
            if new > 0 {
                immediately(|| {
                    tracing::warn!(lost = new, "the log took nothing for a while: events are missing here");
                });
            }
            entry();
        }));
    }
}
