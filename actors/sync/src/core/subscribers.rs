//! The applications that subscribed to the directory, and the entries that each has received.

use std::collections::BTreeMap;

use sinew_model::directory::{DirectoryEntry, DirectoryEvent};
use sinew_runtime::{
    tid::{AppAddress, Tid},
    wire::Kind,
};

use super::{Output, directory::Directory, outputs::Outputs};

/// The applications that subscribed to the directory.
#[derive(Debug, Default)]
pub(super) struct Subscribers {
    subscribers: BTreeMap<AppAddress, Subscriber>,
    /// Whether the directory may have changed since the last query of this flag.
    has_changed: bool,
}

/// Readiness and kinds of an application as last reported. `None`: the last event was rejected, so that the
/// subscriber has an older state or none.
type LastReported = Option<(bool, Vec<Kind>)>;

/// The entries that one subscriber has accepted.
#[derive(Debug, Default)]
struct Subscriber {
    known: BTreeMap<(String, Tid), LastReported>,
    /// Whether the directory may have changed since the last events.
    is_behind: bool,
    /// Whether its mailbox rejected an event, and has had no room since.
    is_full: bool,
}

impl Subscribers {
    /// Adds a subscriber that has received no entries yet.
    pub(super) fn add(&mut self, app: AppAddress) {
        self.subscribers.insert(app, Subscriber { is_behind: true, ..Subscriber::default() });
    }

    /// Removes a subscriber, after its life has ended.
    pub(super) fn remove(&mut self, app: AppAddress) {
        self.subscribers.remove(&app);
    }

    /// Records that an entry of the directory may have been added, removed or changed.
    pub(super) fn directory_changed(&mut self) {
        self.has_changed = true;
        for subscriber in self.subscribers.values_mut() {
            subscriber.is_behind = true;
        }
    }

    /// Returns whether the directory may have changed since the last call.
    pub(super) const fn take_changed(&mut self) -> bool {
        std::mem::replace(&mut self.has_changed, false)
    }

    /// Sends the changes of the directory to the subscribers. spec: SYNC-14
    pub(super) fn notify(&mut self, directory: Directory<'_>, outputs: &mut Outputs) {
        if !self.are_due() {
            return;
        }
        let entries = directory.entries();
        for (app, subscriber) in &mut self.subscribers {
            if subscriber.is_due() {
                subscriber.is_behind = false;
                let events = subscriber.catch_up(&entries).into_iter();
                outputs.extend(events.map(|event| Output::NotifyDirectory { app: *app, event }));
            }
        }
    }

    /// Returns whether an event can be sent now. Only then is the whole directory read.
    pub(super) fn are_due(&self) -> bool {
        self.subscribers.values().any(Subscriber::is_due)
    }

    /// Withdraws all pending events of an application that rejected one. The difference is sent later. The
    /// pending outputs alone are scanned: a directory may be much longer than a mailbox.
    pub(super) fn rejected(&mut self, app: AppAddress, event: DirectoryEvent, outputs: &mut Outputs) {
        let is_its =
            |output: &Output| matches!(output, Output::NotifyDirectory { app: to, .. } if *to == app);
        let mut rejected = outputs.withdraw(is_its);
        let Some(subscriber) = self.subscribers.get_mut(&app) else { return };
        (subscriber.is_behind, subscriber.is_full) = (true, true);
        rejected.push(Output::NotifyDirectory { app, event });
        for output in rejected {
            let Output::NotifyDirectory { event, .. } = output else { continue };
            let (DirectoryEvent::Is(DirectoryEntry { name, tid, .. }) | DirectoryEvent::Gone { name, tid }) =
                event;
            subscriber.known.insert((name, tid), None);
        }
    }

    /// Records that a subscriber with a full mailbox has room again.
    pub(super) fn room_made(&mut self) {
        self.subscribers.values_mut().for_each(|subscriber| subscriber.is_full = false);
    }
}

impl Subscriber {
    const fn is_due(&self) -> bool {
        self.is_behind && !self.is_full
    }

    /// Returns the events that bring the subscriber to the state of `directory`.
    fn catch_up(&mut self, directory: &[DirectoryEntry]) -> Vec<DirectoryEvent> {
        let mut former = std::mem::take(&mut self.known);
        let mut events = Vec::new();
        for entry in directory {
            let key = (entry.name.clone(), entry.tid);
            let is = Some((entry.ready, entry.kinds.clone()));
            if former.remove(&key).as_ref() != Some(&is) {
                events.push(DirectoryEvent::Is(entry.clone()));
            }
            self.known.insert(key, is);
        }
        events.extend(former.into_keys().map(|(name, tid)| DirectoryEvent::Gone { name, tid }));
        events
    }
}
