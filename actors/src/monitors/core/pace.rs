//! How often a watcher is told that nobody is there: a burst at once, then one at a time.

use std::collections::BTreeMap;

use sinew_runtime::{tid::AppAddress, time::Time};

use super::{NOBODY_EVERY, PER_WATCHER_MAX};

/// Each watcher has [`PER_WATCHER_MAX`] answers at once, and one more each [`NOBODY_EVERY`].
#[derive(Debug, Default)]
pub(super) struct Pace {
    /// When each watcher will have all of them again. Who has them is not here: no more entries than applications.
    whole_at: BTreeMap<AppAddress, Time>,
}

impl Pace {
    /// Takes one answer of this watcher's; when it may be told, if not now.
    pub(super) fn next(&mut self, watcher: AppAddress, now: Time) -> Option<Time> {
        self.whole_at.retain(|_, at| *at > now);
        let whole_at = self.whole_at.entry(watcher).or_insert(now);
        *whole_at = *whole_at + NOBODY_EVERY;
        let owed = whole_at.since(now);
        let most = NOBODY_EVERY * PER_WATCHER_MAX as u32;
        (owed > most).then(|| now + (owed - most))
    }

    /// This life of the watcher is over: the next one owes nothing.
    pub(super) fn forget(&mut self, watcher: AppAddress) {
        self.whole_at.remove(&watcher);
    }
}
