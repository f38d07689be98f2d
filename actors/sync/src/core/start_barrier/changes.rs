//! The events about requirements, and whether an application may start without some of them.

use sinew_runtime::{
    app::{Requirement, RequirementEvent},
    time::Time,
};

use super::UNREACHABLE_MAX;
use crate::core::{Reason, apps::App, grace_period::Moment};

/// Returns whether a waiting application may start. All that it lacks must be optional requirements with an
/// expired wait limit. Sets the time of the next check. spec: SYNC-5
pub(super) fn is_free(judged: Time, app: &mut App, unready: &[(String, Reason)]) -> bool {
    let Some(since) = app.wait().map(|wait| wait.since) else { return false };
    let lacks = |requirement: &&Requirement| unready.iter().any(|(text, _)| text == requirement.as_str());
    let limits: Vec<Option<Time>> = app
        .requires
        .iter()
        .filter(lacks)
        .map(|requirement| requirement.wait_max().map(|wait| since + wait))
        .filter(|limit| limit.is_none_or(|limit| judged < limit))
        .collect();
    app.next_limit = limits.iter().flatten().min().copied();
    limits.is_empty()
}

/// Returns the event for a requirement that is not met.
pub(super) fn absence(requirement: &Requirement) -> RequirementEvent {
    let name = requirement.to_string();
    match requirement.wait_max() {
        None => RequirementEvent::Lost { name },
        Some(_) => RequirementEvent::Without { name },
    }
}

/// Returns the events for a running application: each requirement with a state other than the last reported
/// one. spec: SYNC-8
pub(super) fn changes(
    Moment { now, judged }: Moment,
    app: &mut App,
    unready: &[(String, Reason)],
) -> Vec<(RequirementEvent, Option<Reason>)> {
    let App { requires, lost, inherited_losses, unreachable, .. } = app;
    let mut changes = Vec::new();
    for requirement in requires.iter() {
        let name = requirement.as_str();
        let reason = unready.iter().find(|(other, _)| other == name).map(|(_, reason)| *reason);
        let is_reported = lost.contains(name);
        match reason {
            Some(_) if is_reported => {}
            Some(reason)
                if reason.is_unreachable()
                    && judged < *unreachable.entry(name.to_owned()).or_insert(now + UNREACHABLE_MAX) => {}
            Some(reason) => {
                unreachable.remove(name);
                inherited_losses.remove(name);
                lost.insert(name.to_owned());
                changes.push((absence(requirement), Some(reason)));
            }
            None => {
                unreachable.remove(name);
                if lost.remove(name) | inherited_losses.remove(name) {
                    changes.push((RequirementEvent::Met { name: name.to_owned() }, None));
                }
            }
        }
    }
    changes
}
