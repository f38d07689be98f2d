//! Who wants to hear of the directory, and what each has been told of it.

use std::collections::BTreeMap;

use sinew_runtime::{
    tid::{AppAddress, Tid},
    time::Time,
    wire::Kind,
};

use super::{Core, Output, barrier::RETRY};
use crate::sync::facts::{DirectoryEntry, DirectoryEvent};

/// Applications that want to hear of the directory.
#[derive(Debug, Default)]
pub(super) struct Watchers(BTreeMap<AppAddress, Watcher>);

/// Whether an application is ready, and what it handles. `None`: the last news of it was not taken, so that what was before is known,
/// or nothing.
type Known = Option<(bool, Vec<Kind>)>;

/// What one of them knows: what it was told and has taken.
#[derive(Debug, Default)]
struct Watcher {
    told: BTreeMap<(String, Tid), Known>,
    /// It had no room: until then it is told nothing.
    rests: Option<Time>,
}

impl Watchers {
    /// It knows nothing yet.
    pub(super) fn add(&mut self, app: AppAddress) {
        self.0.insert(app, Watcher::default());
    }

    pub(super) fn remove(&mut self, app: AppAddress) {
        self.0.remove(&app);
    }

    /// What it did not take it does not know: the difference is told again later.
    pub(super) fn not_taken(&mut self, now: Time, app: AppAddress, event: DirectoryEvent) {
        let Some(watcher) = self.0.get_mut(&app) else { return };
        watcher.rests.get_or_insert(now + RETRY);
        let (DirectoryEvent::Is(DirectoryEntry { name, tid, .. }) | DirectoryEvent::Gone { name, tid }) =
            event;
        watcher.told.insert((name, tid), None);
    }

    pub(super) fn next_wake(&self) -> Option<Time> {
        self.0.values().filter_map(|watcher| watcher.rests).min()
    }
}

impl Watcher {
    /// What it is told, so that it knows `directory`.
    fn catch_up(&mut self, directory: &[DirectoryEntry]) -> Vec<DirectoryEvent> {
        let mut former = std::mem::take(&mut self.told);
        let mut events = Vec::new();
        for entry in directory {
            let key = (entry.name.clone(), entry.tid);
            let is = Some((entry.ready, entry.kinds.clone()));
            if former.remove(&key).as_ref() != Some(&is) {
                events.push(DirectoryEvent::Is(entry.clone()));
            }
            self.told.insert(key, is);
        }
        events.extend(former.into_keys().map(|(name, tid)| DirectoryEvent::Gone { name, tid }));
        events
    }
}

impl Core {
    /// Tells everybody who wants to hear of it what has changed in the directory. spec: SYNC-14
    pub(super) fn tell_watchers(&mut self, now: Time) {
        if self.watchers.0.is_empty() {
            return;
        }
        let directory = self.directory();
        for (app, watcher) in &mut self.watchers.0 {
            if watcher.rests.is_some_and(|until| now < until) {
                continue;
            }
            watcher.rests = None;
            let events = watcher.catch_up(&directory);
            self.outputs.extend(events.into_iter().map(|event| Output::TellDirectory { app: *app, event }));
        }
    }
}
