//! What became of the messages that a peer's session brought: each is counted in, and ends once, whatever panics.

use std::sync::atomic::{AtomicU64, Ordering};

/// How a message ended that had come from a peer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum End {
    /// It stood for one that had lost its use.
    Void,
    /// A mailbox or a client's queue of this node has it, and counts it from here on.
    HandedOn,
    /// It was for whoever is told here: a layer, a group whose members have copies, one who waited for an outcome or a reply.
    Told,
    Expired,
    /// Nobody took it, or it was not what may come.
    Refused,
    /// What handled it panicked.
    Failed,
}

/// Counters of one session.
#[derive(Debug, Default)]
pub(super) struct Arrivals {
    taken: AtomicU64,
    ends: [AtomicU64; 6],
}

/// A message in hand. If nobody says how it ended, it has failed.
pub(super) struct Hand<'a> {
    arrivals: &'a Arrivals,
    end: Option<End>,
}

impl Arrivals {
    /// One more has come.
    pub(super) fn take(&self) -> Hand<'_> {
        self.taken.fetch_add(1, Ordering::Relaxed);
        self.take_again()
    }

    /// One that has waited for its application is in hand again.
    pub(super) const fn take_again(&self) -> Hand<'_> {
        Hand { arrivals: self, end: Some(End::Failed) }
    }

    /// Messages that have come.
    pub(super) fn taken(&self) -> u64 {
        self.taken.load(Ordering::Relaxed)
    }

    /// Messages that have ended so.
    pub(super) fn ended(&self, end: End) -> u64 {
        self.ends[end as usize].load(Ordering::Relaxed)
    }
}

impl Hand<'_> {
    /// It has ended so; `None`: it waits for its application.
    pub(super) fn ends(mut self, end: Option<End>) {
        self.end = end;
    }
}

impl Drop for Hand<'_> {
    fn drop(&mut self) {
        if let Some(end) = self.end {
            self.arrivals.ends[end as usize].fetch_add(1, Ordering::Relaxed);
        }
    }
}
