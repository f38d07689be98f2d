//! The log queue of the thread that makes outputs safe. That thread must not wait for a lock that ordinary
//! threads hold, and both the log's queue and the memory allocator have such locks. It therefore hands its
//! log entries, and objects to drop, to another thread.

use std::{
    io,
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{
        Mutex, OnceLock, PoisonError, TryLockError,
        atomic::{AtomicU64, Ordering},
    },
    thread::{self, Thread},
};

use super::{Cause, safe_output::Discarded};
use crate::{
    incident::{self, IncidentKind},
    thread::reset_schedule,
    tid::Tid,
    time::Time,
};

/// Maximum number of pending log entries. Further ones are counted.
const PENDING_MAX: usize = 256;

/// A log entry about one output.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct LogEntry {
    pub(super) source: Tid,
    /// The name of the type that controls the output.
    pub(super) name: &'static str,
    pub(super) cause: Cause,
    pub(super) event: OutputEvent,
}

/// The event that the entry reports.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum OutputEvent {
    MadeSafe,
    SafeFailed,
}

impl LogEntry {
    /// Logs the entry. This may wait for the lock of the log's queue.
    pub(super) fn log(self) {
        let (Self { source, name, cause, event }, now) = (self, Time::now());
        match event {
            OutputEvent::MadeSafe => {
                incident::report(
                    now,
                    IncidentKind::Symptom,
                    format_args!("the guard of {name} from {source} is shut: {cause}"),
                );
                crate::log::warn!(%source, of = name, %cause, "a guard is shut; its output, if it has one, is safe");
            }
            OutputEvent::SafeFailed => {
                incident::report(
                    now,
                    IncidentKind::Failure,
                    format_args!("an output of {name} from {source} cannot be made safe: {cause}"),
                );
                crate::log::error!(%source, of = name, %cause, "the safe function of an output panicked or failed; it is retried each millisecond");
            }
        }
    }
}

/// The log entries that the thread `safe-output` has not handed over yet.
pub(super) struct PendingLog {
    entries: Vec<LogEntry>,
    /// Number of entries that were discarded.
    lost: u64,
}

struct Handover {
    entries: Vec<LogEntry>,
    /// Objects to drop.
    discarded: Vec<Discarded>,
}

/// The entries and objects that were handed over.
static HANDOVER: Mutex<Handover> = Mutex::new(Handover { entries: Vec::new(), discarded: Vec::new() });
static LOST: AtomicU64 = AtomicU64::new(0);
static LOGGER: OnceLock<Thread> = OnceLock::new();

impl Default for PendingLog {
    fn default() -> Self {
        Self { entries: Vec::with_capacity(PENDING_MAX), lost: 0 }
    }
}

impl PendingLog {
    pub(super) fn note(&mut self, log_entry: Option<LogEntry>) {
        let Some(log_entry) = log_entry else { return };
        if self.entries.len() < PENDING_MAX {
            self.entries.push(log_entry);
        } else {
            self.lost += 1;
        }
    }

    /// Hands the log entries and the objects to drop to the logging thread, as far as there is room. Returns
    /// `false` if another thread has the list locked, or if entries remain.
    pub(super) fn hand_over(&mut self, discarded: &mut Vec<Discarded>) -> bool {
        if self.entries.is_empty() && discarded.is_empty() {
            return true;
        }
        let mut handover = match HANDOVER.try_lock() {
            Ok(handover) => handover,
            Err(TryLockError::Poisoned(poisoned)) => poisoned.into_inner(),
            Err(TryLockError::WouldBlock) => return false,
        };
        let room = PENDING_MAX.saturating_sub(handover.entries.len()).min(self.entries.len());
        handover.entries.extend(self.entries.drain(..room));
        let room = PENDING_MAX.saturating_sub(handover.discarded.len()).min(discarded.len());
        handover.discarded.extend(discarded.drain(..room));
        drop(handover);
        LOST.fetch_add(std::mem::take(&mut self.lost), Ordering::Relaxed);
        if let Some(logger) = LOGGER.get() {
            logger.unpark();
        }
        self.entries.is_empty()
    }
}

/// Starts the logging thread. Must be called by one thread at a time.
///
/// # Errors
/// The thread cannot be started.
pub(super) fn begin() -> io::Result<()> {
    if LOGGER.get().is_some() {
        return Ok(());
    }
    let mut handover = HANDOVER.lock().unwrap_or_else(PoisonError::into_inner);
    handover.entries.reserve(PENDING_MAX);
    handover.discarded.reserve(PENDING_MAX);
    drop(handover);
    let logger = thread::Builder::new().name("safe-output-log".to_owned()).spawn(run_logger)?;
    LOGGER.get_or_init(|| logger.thread().clone());
    Ok(())
}

fn run_logger() {
    reset_schedule();
    let mut entries = Vec::with_capacity(PENDING_MAX);
    let mut discarded = Vec::with_capacity(PENDING_MAX);
    loop {
        {
            let mut handover = HANDOVER.lock().unwrap_or_else(PoisonError::into_inner);
            entries.append(&mut handover.entries);
            discarded.append(&mut handover.discarded);
        }
        entries.drain(..).for_each(LogEntry::log);
        // The dropped objects belong to the user, and their drop may panic.
        discarded.drain(..).for_each(|object| _ = catch_unwind(AssertUnwindSafe(|| drop(object))));
        let lost = LOST.swap(0, Ordering::Relaxed);
        if lost > 0 {
            crate::log::warn!(lost, "log entries about safe outputs were discarded: their queue was full");
        }
        thread::park();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tid::{AppAddress, NodeAddress};

    #[test]
    fn entries_wait_while_the_list_is_locked() {
        let source = Tid::new(NodeAddress::new(7), AppAddress::new(1));
        let log_entry =
            LogEntry { source, name: "test.torque", cause: Cause::Tripped, event: OutputEvent::MadeSafe };
        let mut pending_log = PendingLog::default();
        (0..PENDING_MAX + 2).for_each(|_| pending_log.note(Some(log_entry)));
        let locked = HANDOVER.lock().expect("nobody panics with it");
        let mut discarded = Vec::new();
        assert!(!pending_log.hand_over(&mut discarded), "it does not wait");
        assert_eq!((pending_log.entries.len(), pending_log.lost), (PENDING_MAX, 2));
        drop(locked);
        begin().expect("there is a thread");
        while !pending_log.hand_over(&mut discarded) {
            thread::yield_now();
        }
        assert_eq!(pending_log.lost, 0);
    }
}
