//! The messages that wait in a mailbox, as the watchdog sees them.

use std::sync::{TryLockError, atomic::Ordering};

use super::{Mailbox, Shared};
use crate::time::Time;

/// The record of a moment from which messages wait.
#[derive(Clone, Copy, Debug)]
pub(super) struct WaitRecord {
    since: Time,
    /// Number of messages that were taken by then.
    taken: u64,
}

/// The messages that wait for the reader of a mailbox.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Backlog {
    /// Number of messages that it can take.
    pub(crate) waiting: usize,
    /// Number of messages that were taken so far.
    pub(crate) taken: u64,
    /// Since when messages wait and none was taken, if that is recorded.
    pub(crate) since: Option<Time>,
}

impl WaitRecord {
    fn now(shared: &Shared) -> Self {
        Self { since: Time::now(), taken: shared.taken_out }
    }
}

impl Mailbox {
    /// Returns the messages that wait. Returns `None` if the mailbox is locked.
    pub(crate) fn backlog(&self) -> Option<Backlog> {
        if let Some(source) = &self.source {
            let (waiting, taken) = source.backlog()?;
            return Some(Backlog { waiting, taken, since: None });
        }
        let shared = match self.shared.try_lock() {
            Ok(shared) => shared,
            Err(TryLockError::Poisoned(poisoned)) => poisoned.into_inner(),
            Err(TryLockError::WouldBlock) => return None,
        };
        let (waiting, taken) = (shared.takeable(), shared.taken_out);
        // An older record says nothing about the messages that were left when one was taken.
        let record = shared.waiting_since.filter(|record| record.taken == taken);
        Some(Backlog { waiting, taken, since: record.map(|record| record.since) })
    }

    /// Returns whether it can be recorded since when messages wait: they are queued here.
    pub(crate) const fn can_record_waits(&self) -> bool {
        self.source.is_none()
    }

    /// Sets whether it is recorded since when messages wait.
    pub(crate) fn set_records_waits(&self, records: bool) {
        // SYNC: Relaxed; see `Liveness::set_records`.
        self.records_waits.store(records, Ordering::Relaxed);
    }

    /// Records that messages wait from now on, if none waits yet. Before a message is added.
    pub(super) fn record_wait(&self, shared: &mut Shared) {
        if self.records_waits.load(Ordering::Relaxed) && shared.takeable() == 0 {
            shared.waiting_since = Some(WaitRecord::now(shared));
        }
    }

    /// Records that the messages left in the queue wait from now on. After a message is taken.
    pub(super) fn record_rest(&self, shared: &mut Shared) {
        if self.records_waits.load(Ordering::Relaxed) && shared.takeable() > 0 {
            shared.waiting_since = Some(WaitRecord::now(shared));
        }
    }
}
