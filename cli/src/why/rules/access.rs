//! Checks whether an access list blocks.

use sinew::inspect::{AccessReport, AccessVerdict};

use super::{
    super::facts::{Facts, TrafficEnd},
    Steps,
    guards::are_echoes_refused,
};

impl Steps {
    /// Adds the verdicts of the lists at both ends. A refusal blocks in the direction from the first to the second. A
    /// refusal of the other direction is often intended: replies and confirmations need no rule, and echoes of
    /// protected messages do.
    pub(super) fn access(&mut self, a: &TrafficEnd, b: &TrafficEnd, facts: &Facts) {
        let [there, back] = &facts.access;
        if let Some(report) = there {
            self.may_send_there(report, a, b);
        }
        if let Some(report) = back {
            self.may_send_back(report, b, a);
        }
    }

    fn may_send_there(&mut self, report: &AccessReport, from: &TrafficEnd, to: &TrafficEnd) {
        let what = may_send(from, to);
        let detail = detail(report, to);
        match refused(report) {
            0 => self.fine(what, detail),
            all if all == report.verdicts.len() => self.blocked(what, detail, fix(report, (from, to), None)),
            _ => self.note(what, detail, fix(report, (from, to), None)),
        }
    }

    fn may_send_back(&mut self, report: &AccessReport, from: &TrafficEnd, to: &TrafficEnd) {
        let (what, detail) = (may_send(from, to), detail(report, to));
        if refused(report) == 0 {
            return self.fine(what, detail);
        }
        if are_echoes_refused(from, to) {
            let detail =
                format!("{detail}; the echoes of protected messages from {} need a rule", to.label());
            return self.note(what, detail, fix(report, (from, to), Some("stream")));
        }
        let detail =
            format!("not needed: replies and confirmations to {} need no rule ({detail})", to.label());
        self.fine(what, detail);
    }
}

/// Returns the question to the list of the second.
pub(super) fn may_send(from: &TrafficEnd, to: &TrafficEnd) -> String {
    format!("{} may send to {}", from.label(), to.label())
}

fn refused(report: &AccessReport) -> usize {
    report.verdicts.iter().filter(|verdict| !verdict.is_allowed).count()
}

fn detail(report: &AccessReport, to: &TrafficEnd) -> String {
    if report.is_given {
        in_words(&report.verdicts)
    } else {
        format!("node {} has no access list", to.node_label())
    }
}

/// Returns the fix: the rule that lets messages of this class, or of every class, through.
fn fix(report: &AccessReport, (from, to): (&TrafficEnd, &TrafficEnd), class: Option<&str>) -> String {
    let list =
        report.path.as_deref().map_or_else(|| "that list".to_owned(), |path| format!("the list {path}"));
    let classes = class.map_or_else(String::new, |class| format!("\nclasses = [\"{class}\"]"));
    let rule = format!("[[rule]]\nfrom = [\"{}\"]\nto = [\"{}\"]{classes}", sender(from), receiver(to));
    format!(
        "put these lines into {list}{}, then `sinew reload` on its host:\n{rule}",
        place(&report.verdicts)
    )
}

/// Returns where a rule must be put: the first one that covers a message decides.
pub(super) fn place(verdicts: &[AccessVerdict]) -> &'static str {
    let is_by_a_rule = |verdict: &AccessVerdict| !verdict.is_allowed && verdict.why.starts_with("rule ");
    if verdicts.iter().any(is_by_a_rule) { ", before the rule that refuses" } else { "" }
}

/// Returns a sender as the rules of a list on another node name it.
pub(super) fn sender(end: &TrafficEnd) -> String {
    on_its_node(end).unwrap_or_else(|| number(end))
}

/// Returns a receiver as the rules of the list of its own node name it.
fn receiver(end: &TrafficEnd) -> String {
    // A list reads other names without a node as addresses.
    let is_plain = |name: &&str| !name.contains(['/', '@']) && name.contains(char::is_alphabetic);
    let plain = name(end).filter(is_plain).map(str::to_owned);
    plain.or_else(|| on_its_node(end)).unwrap_or_else(|| number(end))
}

fn on_its_node(end: &TrafficEnd) -> Option<String> {
    Some(format!("{}@{}", name(end)?, end.node?))
}

fn number(end: &TrafficEnd) -> String {
    end.app_tid().map_or_else(|| end.wanted.clone(), |tid| tid.to_string())
}

fn name(end: &TrafficEnd) -> Option<&str> {
    end.app.as_ref()?.report.as_ref()?.name.as_deref()
}

/// Returns the verdict on each class, or on all at once if they are equal.
pub(super) fn in_words(verdicts: &[AccessVerdict]) -> String {
    let judged = |verdict: &AccessVerdict| {
        format!("{}: {}", if verdict.is_allowed { "allowed" } else { "refused" }, verdict.why)
    };
    match verdicts.split_first() {
        Some((first, others)) if others.iter().all(|other| judged(other) == judged(first)) => {
            format!("access list of its node: {}", judged(first))
        }
        _ => {
            let each = verdicts.iter().map(|one| format!("{:?} {}", one.class, judged(one)));
            format!("access list of its node: {}", each.collect::<Vec<_>>().join("; "))
        }
    }
}
