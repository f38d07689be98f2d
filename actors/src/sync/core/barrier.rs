//! The barrier: who may start, who waits for what, and who is told that something was lost.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::Duration,
};

use sinew_runtime::{
    app::{Requirement, RequirementEvent},
    tid::AppAddress,
    time::Time,
};

use super::{
    Core, Output, Reason,
    apps::{App, State},
    cycles::Graph,
    respite::Moment,
};
use crate::sync::facts::{Absence, Waiting};

/// Time for which a requirement may be out of hearing, its node not lost, before a running application is told. A layer that is
/// restarted, here or there, is heard of again within a few milliseconds; the application behind it has not stopped meanwhile.
pub(super) const SILENCE: Duration = Duration::from_millis(50);
/// Time until an output that was not taken is offered again.
pub(super) const RETRY: Duration = Duration::from_millis(10);

impl Core {
    /// Releases whoever has all that it requires, and tells running applications what they lost or got back.
    pub(super) fn evaluate(&mut self, moment: Moment) {
        self.find_cycles();
        let mut missing = self.find_missing();
        let in_cycle: BTreeSet<&str> = self.cycles.iter().flatten().map(String::as_str).collect();
        let mut released = Vec::new();
        for (address, app) in self.apps.iter_mut() {
            let unready = missing.remove(&address).unwrap_or_default();
            app.note_absent(moment.now, &unready);
            if self.not_taken.contains(&(address, None)) {
                // That it may start it hears first.
            } else if app.wait().is_none() {
                for (event, why) in changes(moment, app, &unready) {
                    // What it did not take about this name before is out of date.
                    self.not_taken.remove(&(address, Some(event.name().to_owned())));
                    self.outputs.push_back(Output::Tell { app: address, event, why });
                }
            } else if let Some(wait) = app.wait().copied()
                && is_free(moment.judged, app, &unready)
                && !app.name.as_deref().is_some_and(|name| in_cycle.contains(name))
            {
                // spec: SYNC-5
                app.state = State::Released(wait);
                released.push(Output::Release { app: address });
                let met = app.begin_life(&unready).into_iter().map(|name| RequirementEvent::Met { name });
                released.extend(met.map(|event| Output::Tell { app: address, event, why: None }));
            }
        }
        self.outputs.extend(released);
    }

    /// What each application lacks of what it requires. Remembers which of the names that are required, or waited for at a barrier,
    /// somebody had at some time, and forgets those that nobody asks for any more.
    fn find_missing(&mut self) -> BTreeMap<AppAddress, Vec<(String, Reason)>> {
        let (mut missing, mut seen) = (BTreeMap::new(), BTreeSet::new());
        for (address, app) in self.apps.iter().filter(|(_, app)| !app.requires.is_empty()) {
            let mut unmet = Vec::new();
            for requirement in &app.requires {
                let standing = self.standing(address, requirement);
                if let Some(why) = standing.why_not(requirement) {
                    unmet.push((requirement.to_string(), why));
                }
                let remembered = requirement.alternatives().iter().filter(|name| self.seen.contains(*name));
                seen.extend(remembered.cloned().chain(standing.had));
            }
            missing.insert(address, unmet);
        }
        for party in self.rendezvous.awaited().chain(self.phases.awaited()) {
            let remembered = party.alternatives().iter().filter(|name| self.seen.contains(*name));
            seen.extend(remembered.cloned().chain(self.standing(AppAddress::NONE, party).had));
        }
        self.seen = seen;
        missing
    }

    /// Looks for circles among what waiting applications require. spec: SYNC-7
    fn find_cycles(&mut self) {
        let mut starts = Vec::new();
        for (_, app, _) in self.apps.waiting() {
            starts.extend(app.requires.iter().cloned());
        }
        let providers = |name: &str| {
            let here = self.apps.called(name).map(|(_, app)| app.requires.clone());
            here.into_iter().chain(self.peers.requirements(name)).collect()
        };
        let cycles =
            if starts.is_empty() { BTreeSet::new() } else { Graph::reach(starts, providers).cycles() };
        for cycle in cycles.difference(&self.cycles) {
            let names = cycle.iter().chain(cycle.first()).cloned().collect();
            self.outputs.push_back(Output::Cycle { names });
        }
        self.cycles = cycles;
    }

    pub(super) fn wait_of(&self, now: Time, address: AppAddress) -> Option<Waiting> {
        let app = self.apps.get(address)?;
        let since = app.wait()?.since;
        let missing = app.requires.iter().flat_map(|requirement| {
            let absences = self.absences(now, address, requirement);
            if absences.is_empty() {
                self.held_by_circle(now.since(since), app, requirement)
            } else {
                absences
            }
        });
        Some(Waiting { application: app.title(address), missing: missing.collect(), since: now.since(since) })
    }

    /// Of a requirement that is met, as whoever it names runs by chance: why `app` is held all the same. spec: SYNC-7
    fn held_by_circle(&self, since: Duration, app: &App, requirement: &Requirement) -> Vec<Absence> {
        let Some(own) = app.name.as_deref() else { return Vec::new() };
        let has = |circle: &Vec<String>, name: &str| circle.iter().any(|other| other == name);
        let names = requirement
            .alternatives()
            .iter()
            .filter(|name| self.cycles.iter().any(|circle| has(circle, own) && has(circle, name)));
        names.map(|name| Absence { name: name.clone(), why: Reason::Cycle.words().into(), since }).collect()
    }

    /// Whether such a circle stands, spelled as [`Output::Cycle`] spells it.
    pub(crate) fn has_cycle(&self, closed: &[String]) -> bool {
        closed.split_last().is_some_and(|(_, names)| self.cycles.contains(names))
    }

    /// Reports who has waited for its deadline, and each time that it passes again. spec: SYNC-9
    pub(super) fn report_overdue(&mut self, Moment { now, judged }: Moment) {
        let deadline = self.requirement_deadline;
        let mut overdue = Vec::new();
        for (address, app) in self.apps.iter_mut() {
            if let State::Waiting(wait) = &mut app.state
                && wait.overdue <= judged
            {
                wait.overdue = now + deadline;
                overdue.push(address);
            }
        }
        let reports: Vec<_> = overdue.into_iter().filter_map(|app| self.wait_of(now, app)).collect();
        self.outputs.extend(reports.into_iter().map(Output::Overdue));
    }

    /// Keeps an output that was not taken.
    pub(super) fn keep(&mut self, now: Time, app: AppAddress, name: Option<String>) {
        self.not_taken.insert((app, name));
        self.retry.get_or_insert(now + RETRY);
    }

    /// Offers again what was not taken, as it is true now: what changed back meanwhile is still told, in its last form.
    pub(super) fn offer_again(&mut self, now: Time) {
        if self.retry.is_none_or(|retry| retry > now) {
            return;
        }
        self.retry = None;
        for (address, name) in std::mem::take(&mut self.not_taken) {
            let may_start = name.is_none() && self.may_start(now, address);
            let output = match name {
                None if may_start => Output::Release { app: address },
                None => {
                    self.apps.get_mut(address).into_iter().for_each(App::put_back);
                    continue;
                }
                Some(name) => {
                    // One that waits again hears the end of it in the life that its next release begins.
                    let waiting = self.apps.get_mut(address).filter(|app| app.wait().is_some());
                    if let Some(app) = waiting {
                        app.lost.insert(name);
                        continue;
                    }
                    let Some(app) = self.apps.get(address) else { continue };
                    let requirement = app.requires.iter().find(|requirement| requirement.as_str() == name);
                    match requirement.filter(|_| app.lost.contains(&name)) {
                        Some(requirement) => {
                            let why = self.standing(address, requirement).why_not(requirement);
                            Output::Tell { app: address, event: absence(requirement), why }
                        }
                        None => {
                            let event = RequirementEvent::Met { name };
                            Output::Tell { app: address, event, why: None }
                        }
                    }
                }
            };
            self.outputs.push_back(output);
        }
    }

    /// Whether a released application lacks nothing, but for what it can do without and has waited for. // spec: SYNC-5
    fn may_start(&self, now: Time, address: AppAddress) -> bool {
        let Some(app) = self.apps.get(address) else { return false };
        let State::Released(wait) = app.state else { return false };
        app.requires.iter().all(|requirement| {
            let is_awaited = requirement.wait_max().is_none_or(|most| now < wait.since + most);
            !is_awaited || self.standing(address, requirement).why_not(requirement).is_none()
        })
    }

    /// The release of an application was not taken: what it would have been told behind it waits, too.
    pub(super) fn release_not_taken(&mut self, now: Time, app: AppAddress) {
        self.keep(now, app, None);
        let not_taken = &mut self.not_taken;
        self.outputs.retain(|output| {
            let Output::Tell { app: other, event, .. } = output else { return true };
            let is_its = *other == app;
            if is_its {
                not_taken.insert((app, Some(event.name().to_owned())));
            }
            !is_its
        });
    }

    pub(super) fn forget_not_taken(&mut self, app: AppAddress) {
        self.not_taken.retain(|(other, _)| *other != app);
    }
}

/// Whether nothing keeps a waiting application: what it lacks it can do without, and has waited for long enough. Sets when to look
/// again. spec: SYNC-5
fn is_free(judged: Time, app: &mut App, unready: &[(String, Reason)]) -> bool {
    let Some(since) = app.wait().map(|wait| wait.since) else { return false };
    let lacks = |requirement: &&Requirement| unready.iter().any(|(text, _)| text == requirement.as_str());
    let limits: Vec<Option<Time>> = app
        .requires
        .iter()
        .filter(lacks)
        .map(|requirement| requirement.wait_max().map(|wait| since + wait))
        .filter(|limit| limit.is_none_or(|limit| judged < limit))
        .collect();
    app.patience = limits.iter().flatten().min().copied();
    limits.is_empty()
}

/// How an application is told that what it requires is not there.
fn absence(requirement: &Requirement) -> RequirementEvent {
    let name = requirement.to_string();
    match requirement.wait_max() {
        None => RequirementEvent::Lost { name },
        Some(_) => RequirementEvent::Without { name },
    }
}

/// What a running application is told: each requirement whose state differs from what it knows. spec: SYNC-8
fn changes(
    Moment { now, judged }: Moment,
    app: &mut App,
    unready: &[(String, Reason)],
) -> Vec<(RequirementEvent, Option<Reason>)> {
    let App { requires, lost, owed, silent, .. } = app;
    let mut changes = Vec::new();
    for requirement in requires.iter() {
        let name = requirement.as_str();
        let reason = unready.iter().find(|(other, _)| other == name).map(|(_, reason)| *reason);
        let is_told = lost.contains(name);
        match reason {
            Some(_) if is_told => {}
            Some(reason)
                if reason.is_silence()
                    && judged < *silent.entry(name.to_owned()).or_insert(now + SILENCE) => {}
            Some(reason) => {
                silent.remove(name);
                owed.remove(name);
                lost.insert(name.to_owned());
                changes.push((absence(requirement), Some(reason)));
            }
            None => {
                silent.remove(name);
                if lost.remove(name) | owed.remove(name) {
                    changes.push((RequirementEvent::Met { name: name.to_owned() }, None));
                }
            }
        }
    }
    changes
}
