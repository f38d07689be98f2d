//! Checks whether an application handles the types of the messages that it receives.

use sinew::{
    Tid,
    inspect::{NodeReport, UnhandledReport},
};

use super::{
    super::facts::{Many, Member},
    RECENT_US, State, Step, Steps, TrafficEnd,
};
use crate::table::time;

impl Steps {
    /// Adds the messages that `to` did not handle or could not read: those of `from` block on the way that the user has
    /// asked for, all others are only reported.
    pub(super) fn handled(&mut self, (from, to): (&TrafficEnd, &TrafficEnd), is_asked_for: bool) {
        if let Some((receiver, report)) = to.app_tid().zip(to.report.as_ref()) {
            let mut steps = unhandled(from, report, (receiver, to.label()));
            if !is_asked_for {
                unblock(&mut steps);
            }
            self.0.extend(steps);
        }
    }

    /// Adds the messages that members did not handle or could not read. Those of `from` block if no member takes them.
    pub(super) fn handled_by_many(&mut self, many: &Many, from: &TrafficEnd) {
        let mut steps = Vec::new();
        let mut is_for_nobody = true;
        for on in &many.places {
            let Some(report) = &on.node.report else { continue };
            is_for_nobody &= on.left_out == 0;
            for Member { label, app, .. } in &on.members {
                let of_member = unhandled(from, report, (*app, label));
                is_for_nobody &= of_member.iter().any(|step| step.state == State::Blocked);
                steps.extend(of_member);
            }
        }
        if !is_for_nobody {
            unblock(&mut steps);
        }
        self.0.extend(steps);
    }
}

fn unblock(steps: &mut [Step]) {
    steps.iter_mut().filter(|step| step.state == State::Blocked).for_each(|step| step.state = State::Note);
}

/// Returns the steps of an application, by its label: messages of `from` that it did not handle recently block, all
/// others are notes.
fn unhandled(from: &TrafficEnd, report: &NodeReport, (receiver, label): (Tid, &str)) -> Vec<Step> {
    let of_it = report.unhandled.iter().filter(|entry| entry.receiver == receiver);
    let steps = of_it.map(|entry| {
        let is_of_sender = from.app_tid() == Some(entry.sender);
        let kind = entry.kind_name.clone().or_else(|| name_at(from, entry));
        let is_in_the_way = is_of_sender && entry.ago_us < RECENT_US;
        Step {
            what: format!("{label} handles what it is sent"),
            state: if is_in_the_way { State::Blocked } else { State::Note },
            detail: detail(entry, kind, is_of_sender.then(|| from.label())),
            fix: Some(entry.remedy.clone()),
        }
    });
    steps.collect()
}

/// Returns the name of the type at its sender: a receiver that does not handle a type does not know its name.
fn name_at(sender: &TrafficEnd, entry: &UnhandledReport) -> Option<String> {
    let mut known = sender.report.iter().flat_map(|report| &report.unhandled);
    known.find(|known| known.kind == entry.kind)?.kind_name.clone()
}

fn detail(entry: &UnhandledReport, name: Option<String>, sender: Option<&str>) -> String {
    let UnhandledReport { sender: tid, kind, count, ago_us, is_malformed, .. } = entry;
    let kind = name.unwrap_or_else(|| format!("kind {kind}"));
    let sender = sender.map_or_else(|| tid.to_string(), str::to_owned);
    let ago = time(*ago_us);
    let messages = if *count == 1 { "1 message".to_owned() } else { format!("{count} messages") };
    if *is_malformed {
        format!("{messages} of {kind} could not be read, the last one {ago} ago from {sender}")
    } else {
        format!("{kind} is not handled: {messages}, the last one {ago} ago from {sender}")
    }
}
