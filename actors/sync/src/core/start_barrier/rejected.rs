//! The releases and the events about requirements that their receivers rejected.

use std::collections::BTreeSet;

use sinew_runtime::{tid::AppAddress, time::Time};

use crate::core::{Output, outputs::Outputs, retry::RetryTimer};

/// The rejected outputs. They are kept without their content, which may change before they are sent again.
#[derive(Debug, Default)]
pub(super) struct RejectedOutputs {
    /// The release of an application (`None`), or its event about a name.
    outputs: BTreeSet<(AppAddress, Option<String>)>,
    /// The pause of the releases: the root's queue gives no signal of room.
    retry: RetryTimer,
}

impl RejectedOutputs {
    /// Adds an event about the requirement `name`.
    pub(super) fn add_event(&mut self, app: AppAddress, name: String) {
        self.outputs.insert((app, Some(name)));
    }

    /// Adds a release, and the pending events that follow it.
    pub(super) fn add_release(&mut self, now: Time, app: AppAddress, outputs: &mut Outputs) {
        self.outputs.insert((app, None));
        self.retry.start(now);
        let is_its = |output: &Output| matches!(output, Output::Notify { app: other, .. } if *other == app);
        for output in outputs.withdraw(is_its) {
            if let Output::Notify { app, event, .. } = output {
                self.outputs.insert((app, Some(event.name().to_owned())));
            }
        }
    }

    /// Returns whether the release of an application was rejected.
    pub(super) fn has_release(&self, app: AppAddress) -> bool {
        self.outputs.contains(&(app, None))
    }

    /// Forgets an outdated event.
    pub(super) fn forget_event(&mut self, app: AppAddress, name: &str) {
        self.outputs.remove(&(app, Some(name.to_owned())));
    }

    /// Removes all outputs to an application. Returns the names of its events.
    pub(super) fn take(&mut self, app: AppAddress) -> Vec<String> {
        let (its, others): (BTreeSet<_>, BTreeSet<_>) =
            std::mem::take(&mut self.outputs).into_iter().partition(|(other, _)| *other == app);
        self.outputs = others;
        its.into_iter().filter_map(|(_, name)| name).collect()
    }

    /// Removes and returns the events of the applications without a rejected release.
    pub(super) fn take_events(&mut self) -> BTreeSet<(AppAddress, Option<String>)> {
        let unreleased = self.outputs.iter().filter(|(_, name)| name.is_none());
        let unreleased: BTreeSet<AppAddress> = unreleased.map(|(app, _)| *app).collect();
        self.outputs.extract_if(.., |(app, _)| !unreleased.contains(app)).collect()
    }

    /// Removes and returns all outputs, if it is time to send the releases again.
    pub(super) fn take_due(&mut self, now: Time) -> BTreeSet<(AppAddress, Option<String>)> {
        if self.retry.take_expired(now) { std::mem::take(&mut self.outputs) } else { BTreeSet::new() }
    }

    /// Returns the time at which the releases are sent again.
    pub(super) const fn next_wake(&self) -> Option<Time> {
        self.retry.next_wake()
    }
}
