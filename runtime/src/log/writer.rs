//! The log's thread, and the bounded queue to it.

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

use super::{event::at_once, stderr};

/// What waits to be written, at most. What comes then is dropped and counted.
const QUEUE_MAX: usize = 1_024;

/// Time for a standard error that takes nothing to take something after all.
const PATIENCE: Timespec = Timespec { tv_sec: 0, tv_nsec: 20_000_000 };

/// Time between two looks whether a full queue has room.
const PACE: Duration = Duration::from_millis(1);

/// Something to be done on the log's thread, however long it takes.
type Entry = Box<dyn FnOnce() + Send>;

/// What was dropped so far.
static LOST: AtomicU64 = AtomicU64::new(0);

/// How many events were not written, because the log took nothing for so long that its queue was full.
#[must_use]
pub fn lost() -> u64 {
    LOST.load(Ordering::Relaxed)
}

/// Starts the log's thread, where it does not run. The first one who logs does it otherwise, in whatever he is in the middle of.
pub fn begin() {
    let _ = queue();
}

/// Puts this at the end of the queue, if there is room. Never waits.
pub(crate) fn enter(entry: Entry) {
    if !is_entered(entry) {
        LOST.fetch_add(1, Ordering::Relaxed);
    }
}

/// Writes a line to the standard error, behind what is logged already: the words of an error that the log has too. Where the log is written
/// there anyway, nothing is added.
pub fn print(line: String) {
    enter(Box::new(move || {
        if !stderr::writes_errors() {
            stderr::write_text(&format!("{line}\n"));
        }
    }));
}

/// Waits until what was logged so far is written, and no longer than this: before the process ends, say. Where the standard
/// error takes nothing, hardly at all.
pub fn flush(within: Duration) {
    let stderr = std::io::stderr();
    if poll(&mut [PollFd::new(&stderr, PollFlags::OUT)], Some(&PATIENCE)) == Ok(0) {
        return;
    }
    let until = Instant::now() + within;
    let (say, written) = sync_channel(1);
    let is_there = || {
        let say = say.clone();
        is_entered(Box::new(move || _ = say.send(())))
    };
    // There is room as soon as something is written.
    while !is_there() {
        if Instant::now() >= until {
            return;
        }
        std::thread::sleep(PACE);
    }
    let _ = written.recv_timeout(until.saturating_duration_since(Instant::now()));
}

fn is_entered(entry: Entry) -> bool {
    queue().is_some_and(|queue| queue.try_send(entry).is_ok())
}

/// The queue, with its thread; `None` if the system gives none.
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
    crate::supervision::writes_the_log();
    // Who logged first may be one that all others give way to.
    crate::supervision::make_like_any_other();
    let mut said = 0;
    for entry in entries {
        // A subscriber that panics is told by the panic hook, and has the next event all the same.
        let _ = catch_unwind(AssertUnwindSafe(|| {
            let lost = lost();
            let new = lost - std::mem::replace(&mut said, lost);
            if new > 0 {
                at_once(|| {
                    tracing::warn!(lost = new, "the log took nothing for a while: events are missing here");
                });
            }
            entry();
        }));
    }
}
