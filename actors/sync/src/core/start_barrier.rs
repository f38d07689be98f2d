//! The start-up barrier: releases of waiting applications, and reports of lost requirements to running ones.

mod changes;
mod cycles;
mod rejected;
mod unknown_names;

use std::{
    collections::{BTreeMap, BTreeSet},
    time::Duration,
};

use sinew_runtime::{
    app::{Requirement, RequirementEvent},
    tid::AppAddress,
    time::Time,
};

pub use self::cycles::cycle_of;
use self::{
    changes::{absence, changes, is_free},
    cycles::Graph,
    rejected::RejectedOutputs,
    unknown_names::UnknownNames,
};
use super::{
    Output, Reason,
    apps::{Apps, State},
    directory::Directory,
    grace_period::Moment,
    outputs::Outputs,
    peers::Peers,
    readiness::{Findings, Readiness},
};

/// Time for which a requirement may be unreachable, its node not lost, before a running application is
/// notified. A restarted layer is reachable again within a few milliseconds. The required application has
/// kept running meanwhile.
pub const UNREACHABLE_MAX: Duration = Duration::from_millis(50);

/// The start-up barrier of this node's applications.
#[derive(Debug, Default)]
pub(super) struct StartBarrier {
    findings: Findings,
    rejected: RejectedOutputs,
    unknown_names: UnknownNames,
}

impl StartBarrier {
    /// Returns the results of the last evaluation.
    pub(super) const fn findings(&self) -> &Findings {
        &self.findings
    }

    /// Forgets the reports to an application, after it was registered anew or unregistered.
    pub(super) fn forget(&mut self, app: AppAddress) {
        self.rejected.take(app);
        self.unknown_names.forget(app);
    }

    /// Handles the end of a life. The next one must receive a `Met` event about each rejected event: the
    /// `Met` event was rejected, and the loss may have been accepted.
    pub(super) fn ended(&mut self, app: AppAddress, apps: &mut Apps) {
        let rejected = self.rejected.take(app);
        if let Some(app) = apps.get_mut(app) {
            app.lost.extend(rejected);
        }
    }

    /// Keeps an event that the application's mailbox rejected, until there is room.
    pub(super) fn event_rejected(&mut self, app: AppAddress, name: String) {
        self.rejected.add_event(app, name);
    }

    /// Keeps the release of an application that the root rejected. The events that follow the release wait
    /// with it.
    pub(super) fn release_rejected(&mut self, now: Time, app: AppAddress, outputs: &mut Outputs) {
        self.rejected.add_release(now, app, outputs);
    }

    /// Returns the time at which rejected releases are sent again.
    pub(super) const fn next_retry(&self) -> Option<Time> {
        self.rejected.next_wake()
    }

    /// Returns the time of the next deadline that [`StartBarrier::evaluate`] judges.
    pub(super) fn next_deadline(&self, apps: &Apps) -> Option<Time> {
        [apps.next_deadline(), self.unknown_names.next_wake()].into_iter().flatten().min()
    }

    /// Returns whether this cycle exists, in the notation of [`Output::Cycle`].
    pub(super) fn has_cycle(&self, closed: &[String]) -> bool {
        closed.split_last().is_some_and(|(_, names)| self.findings.cycles.contains(names))
    }

    /// Releases each application when all its requirements are met. Notifies running applications of
    /// requirements that were lost or are met again. Reports applications that wait too long, or for a name
    /// that no application has. `awaited` are the parties for which applications wait at run-time barriers.
    pub(super) fn evaluate<'awaited>(
        &mut self,
        moment: Moment,
        (apps, peers): (&mut Apps, &Peers),
        awaited: impl Iterator<Item = &'awaited Requirement>,
        outputs: &mut Outputs,
    ) {
        self.find_cycles(Directory { apps, peers }, outputs);
        let missing = self.find_missing(Directory { apps, peers }, awaited);
        self.release(moment, apps, missing, outputs);
        let overdue = apps.take_overdue(moment);
        let readiness = Readiness { directory: Directory { apps, peers }, findings: &self.findings };
        let reports = overdue.into_iter().filter_map(|app| readiness.wait_of(moment.now, app));
        outputs.extend(reports.map(Output::Overdue));
        self.unknown_names.report(moment, readiness, outputs);
    }

    /// Releases the applications that may start, and notifies those that run.
    fn release(
        &mut self,
        moment: Moment,
        apps: &mut Apps,
        mut missing: BTreeMap<AppAddress, Vec<(String, Reason)>>,
        outputs: &mut Outputs,
    ) {
        let in_cycle: BTreeSet<&str> = self.findings.cycles.iter().flatten().map(String::as_str).collect();
        let mut released = Vec::new();
        for (address, app) in apps.iter_mut() {
            let unready = missing.remove(&address).unwrap_or_default();
            app.record_absent(moment.now, &unready);
            if self.rejected.has_release(address) {
                // The application receives its release first.
            } else if app.wait().is_none() {
                for (event, why) in changes(moment, app, &unready) {
                    // A rejected earlier event about this name is outdated.
                    self.rejected.forget_event(address, event.name());
                    outputs.push(Output::Notify { app: address, event, why });
                }
            } else if let Some(wait) = app.wait().copied()
                && is_free(moment.judged, app, &unready)
                && !app.name.as_deref().is_some_and(|name| in_cycle.contains(name))
            {
                // spec: SYNC-5
                app.state = State::Released(wait);
                released.push(Output::Release { app: address });
                let met = app.begin_life(&unready).into_iter().map(|name| RequirementEvent::Met { name });
                released.extend(met.map(|event| Output::Notify { app: address, event, why: None }));
            }
        }
        outputs.extend(released);
    }

    /// Returns the unmet requirements of each application. Remembers which of the names that are required, or
    /// awaited at a barrier, were ever registered. Forgets names that nothing requires any more.
    fn find_missing<'awaited>(
        &mut self,
        directory: Directory<'_>,
        awaited: impl Iterator<Item = &'awaited Requirement>,
    ) -> BTreeMap<AppAddress, Vec<(String, Reason)>> {
        let readiness = Readiness { directory, findings: &self.findings };
        let former_names = &self.findings.former_names;
        let (mut missing, mut seen) = (BTreeMap::new(), BTreeSet::new());
        for (address, app) in directory.apps.iter().filter(|(_, app)| !app.requires.is_empty()) {
            let mut unmet = Vec::new();
            for requirement in &app.requires {
                let state = readiness.state_of(address, requirement);
                if let Some(why) = state.why_not(requirement) {
                    unmet.push((requirement.to_string(), why));
                }
                let remembered =
                    requirement.alternatives().iter().filter(|name| former_names.contains(*name));
                seen.extend(remembered.cloned().chain(state.registered));
            }
            missing.insert(address, unmet);
        }
        for party in awaited {
            let remembered = party.alternatives().iter().filter(|name| former_names.contains(*name));
            seen.extend(remembered.cloned().chain(readiness.state_of(AppAddress::NONE, party).registered));
        }
        self.findings.former_names = seen;
        missing
    }

    /// Finds cycles among the requirements of waiting applications. spec: SYNC-7
    fn find_cycles(&mut self, directory: Directory<'_>, outputs: &mut Outputs) {
        let mut starts = Vec::new();
        for (_, app, _) in directory.apps.waiting() {
            starts.extend(app.requires.iter().cloned());
        }
        let cycles = if starts.is_empty() {
            BTreeSet::new()
        } else {
            Graph::reach(starts, |name| directory.requirements(name)).cycles()
        };
        for cycle in cycles.difference(&self.findings.cycles) {
            let names = cycle.iter().chain(cycle.first()).cloned().collect();
            outputs.push(Output::Cycle { names });
        }
        self.findings.cycles = cycles;
    }

    /// Sends the rejected events again, after an application has room again. Those of an unreleased application
    /// wait for its release.
    pub(super) fn room_made(&mut self, now: Time, apps: &mut Apps, peers: &Peers, outputs: &mut Outputs) {
        let events = self.rejected.take_events();
        self.send_again(now, events, (apps, peers), outputs);
    }

    /// Sends the rejected releases again when that is due, and all events.
    pub(super) fn offer_again(&mut self, now: Time, apps: &mut Apps, peers: &Peers, outputs: &mut Outputs) {
        let due = self.rejected.take_due(now);
        self.send_again(now, due, (apps, peers), outputs);
    }

    /// Sends rejected outputs again, in their current state. A change that was reverted meanwhile is still
    /// reported, in its latest form.
    fn send_again(
        &self,
        now: Time,
        rejected: BTreeSet<(AppAddress, Option<String>)>,
        (apps, peers): (&mut Apps, &Peers),
        outputs: &mut Outputs,
    ) {
        for (address, name) in rejected {
            let readiness = Readiness { directory: Directory { apps, peers }, findings: &self.findings };
            let again = match name {
                None => may_start(now, address, readiness).then_some(Output::Release { app: address }),
                Some(ref name) => latest(address, name, readiness),
            };
            match (again, name, apps.get_mut(address)) {
                (Some(output), ..) => outputs.push(output),
                (None, None, Some(app)) => app.withdraw_release(),
                // The application receives the event in the life that its next release starts.
                (None, Some(name), Some(app)) => drop(app.lost.insert(name)),
                (None, _, None) => {}
            }
        }
    }
}

/// Returns whether a released application lacks nothing except optional requirements with an expired wait
/// limit. spec: SYNC-5
fn may_start(now: Time, address: AppAddress, readiness: Readiness<'_>) -> bool {
    let Some(app) = readiness.directory.apps.get(address) else { return false };
    let State::Released(wait) = app.state else { return false };
    app.requires.iter().all(|requirement| {
        let is_awaited = requirement.wait_max().is_none_or(|most| now < wait.since + most);
        !is_awaited || readiness.state_of(address, requirement).why_not(requirement).is_none()
    })
}

/// Returns the latest event about a requirement of an application, unless the application waits.
fn latest(address: AppAddress, name: &str, readiness: Readiness<'_>) -> Option<Output> {
    let app = readiness.directory.apps.get(address).filter(|app| app.wait().is_none())?;
    let is_it = |requirement: &&Requirement| requirement.as_str() == name && app.lost.contains(name);
    let (event, why) = match app.requires.iter().find(is_it) {
        Some(requirement) => {
            (absence(requirement), readiness.state_of(address, requirement).why_not(requirement))
        }
        None => (RequirementEvent::Met { name: name.to_owned() }, None),
    };
    Some(Output::Notify { app: address, event, why })
}
