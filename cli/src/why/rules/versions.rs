//! Checks whether two applications have the types of their messages in one version.

use sinew::inspect::MismatchReport;

use super::{State, Step, Steps, TrafficEnd};

impl Steps {
    /// Adds the types of messages from `from` that `to` has in another version. Refused ones block on the way that the
    /// user has asked for, all others are only reported.
    pub(super) fn versions(
        &mut self,
        (from, to): (&TrafficEnd, &TrafficEnd),
        mismatches: &[MismatchReport],
        is_asked_for: bool,
    ) {
        let Some(ends) = from.app_tid().zip(to.app_tid()) else { return };
        for one in mismatches.iter().filter(|one| (one.source.tid, one.target.tid) == ends) {
            let kind = one.name.clone().unwrap_or_else(|| format!("kind {}", one.kind));
            let is_blocking = is_asked_for && one.treatment == "refused";
            self.0.push(Step {
                what: format!("{} has the {kind} of {}", to.label(), from.label()),
                state: if is_blocking { State::Blocked } else { State::Note },
                detail: detail(one),
                fix: Some(fix(one, &kind)),
            });
        }
    }
}

fn detail(one: &MismatchReport) -> String {
    let MismatchReport { differences, policy, treatment, seen, .. } = one;
    let done = match treatment.as_str() {
        "refused" => "its messages are refused",
        "warned" => "the decoder decides on its messages",
        _ => "its messages are accepted",
    };
    let seen = if *seen == 1 { "1 message".to_owned() } else { format!("{seen} messages") };
    format!("{}; {done} by the policy {policy} of the receiver, {seen} so far", differences.join("; "))
}

fn fix(one: &MismatchReport, kind: &str) -> String {
    if one.treatment == "accepted" {
        return format!("none is needed; `sinew schema {kind}` shows both versions");
    }
    format!("build both programs with one version of the type; `sinew schema {kind}` shows both")
}
