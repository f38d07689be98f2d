//! Who wants to hear of the directory, and what each has been told of it.

use std::collections::BTreeMap;

use sinew_runtime::{
    tid::{AppAddress, NodeAddress, Tid},
    time::Time,
    wire::Kind,
};

use super::{Core, Input, Output, barrier::RETRY};
use crate::{
    access::Said,
    sync::facts::{DirectoryEntry, DirectoryEvent},
};

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
    /// Whether the directory may have changed since it was told.
    is_behind: bool,
    /// It had no room: until then it is told nothing.
    rests: Option<Time>,
}

impl Watchers {
    /// It knows nothing yet.
    pub(super) fn add(&mut self, app: AppAddress) {
        self.0.insert(app, Watcher { is_behind: true, ..Watcher::default() });
    }

    /// The directory may have changed.
    pub(super) fn directory_changed(&mut self) {
        for watcher in self.0.values_mut() {
            watcher.is_behind = true;
        }
    }

    pub(super) fn remove(&mut self, app: AppAddress) {
        self.0.remove(&app);
    }

    /// What it did not take it does not know: the difference is told again later.
    fn not_taken(&mut self, now: Time, app: AppAddress, events: Vec<DirectoryEvent>) {
        let Some(watcher) = self.0.get_mut(&app) else { return };
        watcher.is_behind = true;
        watcher.rests.get_or_insert(now + RETRY);
        for event in events {
            let (DirectoryEvent::Is(DirectoryEntry { name, tid, .. }) | DirectoryEvent::Gone { name, tid }) =
                event;
            watcher.told.insert((name, tid), None);
        }
    }

    /// Whether anybody can be told something now: the whole directory is read for it.
    pub(super) fn are_due(&self, now: Time) -> bool {
        self.0.values().any(|watcher| watcher.is_due(now))
    }

    pub(super) fn next_wake(&self) -> Option<Time> {
        self.0.values().filter_map(|watcher| watcher.rests).min()
    }
}

impl Watcher {
    fn is_due(&self, now: Time) -> bool {
        self.is_behind && self.rests.is_none_or(|until| until <= now)
    }

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

/// Whose names an input may change.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::sync) enum Named {
    Nobody,
    By(NodeAddress),
    Anybody,
}

impl Input {
    /// Whose names elsewhere this may change.
    pub(in crate::sync) const fn may_name(&self) -> Named {
        match self {
            Self::ListReceived { from, .. } => Named::By(*from),
            // One may be forgotten for another.
            Self::LinkChanged(_) | Self::MembershipChanged(_) => Named::Anybody,
            Self::AppChanged(_)
            | Self::GroupsChanged(_)
            | Self::Arrived { .. }
            | Self::Left { .. }
            | Self::AnswerNotTaken { .. }
            | Self::ArrivalsReceived { .. }
            | Self::ArrivalsNotTaken { .. }
            | Self::ListNotTaken { .. }
            | Self::DirectoryWanted { .. }
            | Self::DirectoryNotTaken { .. }
            | Self::ReleaseNotTaken { .. }
            | Self::EventNotTaken { .. }
            | Self::TimePassed => Named::Nobody,
        }
    }
}

impl Core {
    /// Somebody may be in the directory who was not, or otherwise.
    pub(super) fn directory_changed(&mut self) {
        self.has_changed = true;
        self.watchers.directory_changed();
    }

    /// Who is called how on other nodes, or on this one of them, as they have said last.
    pub(in crate::sync) fn names_elsewhere(
        &self,
        node: Option<NodeAddress>,
    ) -> impl Iterator<Item = Said<'_>> {
        self.peers.said_names(node)
    }

    /// Tells everybody who wants to hear of it what has changed in the directory. spec: SYNC-14
    pub(super) fn tell_watchers(&mut self, now: Time) {
        if !self.watchers.are_due(now) {
            return;
        }
        let directory = self.directory();
        for (app, watcher) in self.watchers.0.iter_mut().filter(|(_, watcher)| watcher.is_due(now)) {
            (watcher.is_behind, watcher.rests) = (false, None);
            let events = watcher.catch_up(&directory);
            self.outputs.extend(events.into_iter().map(|event| Output::TellDirectory { app: *app, event }));
        }
    }

    /// An application did not take this event, and has no room for those that are on their way to it either. It is told all of it
    /// later. Nothing else is looked at: a directory may be much longer than a mailbox.
    pub(super) fn directory_not_taken(&mut self, now: Time, app: AppAddress, event: DirectoryEvent) {
        let mut not_taken = vec![event];
        self.outputs.retain(|output| {
            let Output::TellDirectory { app: to, event } = output else { return true };
            let is_for_others = *to != app;
            if !is_for_others {
                not_taken.push(event.clone());
            }
            is_for_others
        });
        self.watchers.not_taken(now, app, not_taken);
    }
}
