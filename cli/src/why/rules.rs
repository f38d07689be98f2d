//! Derives the steps between two ends from the collected facts. Pure: no queries and no waits.

mod access;
mod address;
mod direct;
mod groups;
mod guards;
mod keys;
mod many;
mod nearest_group;
mod places;
mod silent;
mod stream;
mod types;
mod unfound;
mod unnamed;
mod version;
mod versions;

use std::collections::BTreeSet;

use sinew::{
    inspect::{Missing, NodeReport, PeerReport, RefusalReport},
    message::Rejection,
};

pub(crate) use self::silent::lost_in_words;
use self::unfound::why_unknown;
use super::facts::{App, Facts, Namesakes, TrafficEnd};
use crate::table::time;

/// A step of the path, and its state.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Step {
    /// The check.
    pub(super) what: String,
    pub(super) state: State,
    /// The result, as text.
    pub(super) detail: String,
    /// The suggested fix, if there is one.
    pub(super) fix: Option<String>,
}

/// The state of a step.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum State {
    /// The step works.
    Fine,
    /// The step does not block, but is worth knowing.
    Note,
    /// The step blocks.
    Blocked,
}

/// Maximum age of a refusal that counts as current, in microseconds.
const RECENT_US: u64 = 60_000_000;
/// Maximum number of further applications of one name that are listed by their TIDs.
const NAMESAKES_SHOWN: usize = 4;

/// Returns every step from the first end to the second and back, in the order in which a message passes them.
pub(super) fn judge(facts: &Facts) -> Vec<Step> {
    let mut steps = Steps(Vec::new());
    if let Some(many) = &facts.many {
        steps.towards_many(many, facts);
        return steps.0;
    }
    let [a, b] = &facts.ends;
    for (end, other) in [(a, b), (b, a)] {
        steps.there(end, other, facts);
        steps.meant(end);
    }
    steps.address(facts);
    if a.node.is_some() && a.node != b.node {
        steps.project(a, b);
        steps.keys(a, b);
        for ((from, to), value) in [(a, b), (b, a)].into_iter().zip(&facts.streams) {
            steps.known(from, to);
            steps.linked(from, to);
            steps.streamed(from, to, value.as_ref());
        }
    }
    let [there, back] = facts.pings.each_ref().map(Option::as_ref);
    for ((end, other), ping) in [(a, b), (b, a)].into_iter().zip([back, there]) {
        steps.application((end, other), ping, facts);
    }
    steps.direct(a, b);
    steps.direct(b, a);
    steps.handled((a, b), true);
    steps.handled((b, a), false);
    steps.versions((a, b), &facts.mismatches, true);
    steps.versions((b, a), &facts.mismatches, false);
    steps.guarded(a, b);
    steps.access(a, b, facts);
    steps.by_groups(a, b, facts);
    let [there, back] = &facts.pings;
    for (ping, ends, is_asked_for) in [(there, (a, b), true), (back, (b, a), false)] {
        steps.ping(ping.as_ref(), ends, is_asked_for);
    }
    steps.0
}

struct Steps(Vec<Step>);

impl Steps {
    fn fine(&mut self, what: impl Into<String>, detail: impl Into<String>) {
        self.0.push(Step { what: what.into(), state: State::Fine, detail: detail.into(), fix: None });
    }

    fn note(&mut self, what: impl Into<String>, detail: impl Into<String>, fix: impl Into<String>) {
        let (what, detail) = (what.into(), detail.into());
        self.0.push(Step { what, state: State::Note, detail, fix: Some(fix.into()) });
    }

    /// Adds a blocking step that is fixed by the remedy of another step.
    fn explained(&mut self, what: impl Into<String>, detail: impl Into<String>) {
        self.0.push(Step { what: what.into(), state: State::Blocked, detail: detail.into(), fix: None });
    }

    fn is_blocked(&self) -> bool {
        self.0.iter().any(|step| step.state == State::Blocked)
    }

    fn blocked(&mut self, what: impl Into<String>, detail: impl Into<String>, fix: impl Into<String>) {
        let (what, detail) = (what.into(), detail.into());
        self.0.push(Step { what, state: State::Blocked, detail, fix: Some(fix.into()) });
    }

    /// Checks whether the end's node runs and can be asked. A later step has the cause of its silence if the other
    /// end's node knows that.
    fn there(&mut self, end: &TrafficEnd, other: &TrafficEnd, facts: &Facts) {
        let what = format!("{} is there", end.label());
        // It may be the node's own socket.
        let shut: String = facts.shut.iter().map(|socket| format!("; {socket}")).collect();
        match (&end.report, end.node) {
            (Some(report), _) if report.stopping => self.blocked(
                what,
                "its node is about to end",
                "wait until it is started again, or start it",
            ),
            (Some(report), _) => {
                let NodeReport { node, name, pid, up_us, .. } = report;
                self.fine(what, format!("node {name} at {node}, process {pid}, up {}", time(*up_us)));
            }
            (None, Some(node)) if silent::is_cause_known(other, node) => {
                let why = end.silence.as_deref().unwrap_or("no answer");
                let detail = format!("its node {node} cannot be asked: {why}; {} knows the cause{shut}", other.node_label());
                self.0.push(Step { what, state: State::Note, detail, fix: None });
            }
            (None, Some(node)) => self.blocked(
                what,
                format!("its node {node} cannot be asked: {}{shut}", end.silence.as_deref().unwrap_or("no answer")),
                "is it running? Start it; if it runs on another host, run `sinew why` there, too; if its socket is elsewhere on this one: \
                 --other-socket PATH",
            ),
            (None, None) => self.nowhere(what, &end.wanted, facts, &shut),
        }
    }

    /// Notes which application is checked if several have the name.
    fn meant(&mut self, end: &TrafficEnd) {
        let Some(Namesakes { tid, seen_from, others }) = &end.namesakes else { return };
        let named: Vec<_> = others.iter().take(NAMESAKES_SHOWN).map(ToString::to_string).collect();
        let more = others.len() - named.len();
        let more = if more > 0 { format!(" and {more} more") } else { String::new() };
        self.note(
            format!("{} is one of {}", end.label(), others.len() + 1),
            format!("from node {seen_from} the name stands for {tid}, not for {}{more}", named.join(", ")),
            "`sinew why` with the TID of another one looks at that",
        );
    }

    fn project(&mut self, a: &TrafficEnd, b: &TrafficEnd) {
        let (Some(ours), Some(theirs)) = (&a.report, &b.report) else { return };
        let what = "both are of one project";
        if ours.project == theirs.project {
            self.fine(what, format!("'{}'", ours.project));
        } else {
            self.blocked(
                what,
                format!("{} is of '{}', {} of '{}'", a.label(), ours.project, b.label(), theirs.project),
                "set the same `project` under [node] in both configurations",
            );
        }
    }

    /// Checks whether `from` has found `to` and still receives from it.
    fn known(&mut self, from: &TrafficEnd, to: &TrafficEnd) {
        let (Some(report), Some(node)) = (&from.report, to.node) else { return };
        let what = format!("{} knows {}", from.label(), to.label());
        if let Some(peer) = from.peer(node).filter(|peer| peer.is_there) {
            let mut detail = last_received(peer);
            if let Some(name) = peer.routes.first().and_then(|route| route.interface.as_deref()) {
                detail += &format!(", over {name}");
            }
            if to.report.is_none()
                && let Some((cause, fix)) = silent::cause(peer)
            {
                return self.blocked(what, format!("{detail}; {cause}"), fix);
            }
            if peer.missed == 0 {
                return self.fine(what, detail);
            }
            let fix =
                "is it stopped, or its host overloaded? `sinew ping` it, `sinew tree` shows what it does";
            return self.note(what, format!("{detail}; missed its last {} answers", peer.missed), fix);
        }
        if let Some(lost) = report.lost.iter().find(|lost| lost.node == node) {
            let (detail, fix) = lost_in_words(lost);
            return self.blocked(what, detail, fix);
        }
        match why_unknown(report, to) {
            (detail, Some(fix)) => self.blocked(what, detail, fix),
            (detail, None) => self.explained(what, detail),
        }
    }

    /// Checks whether messages flow from `from` to `to`.
    fn linked(&mut self, from: &TrafficEnd, to: &TrafficEnd) {
        let Some(node) = to.node else { return };
        let Some(peer) = from.peer(node) else { return };
        let what = format!("{} is connected to {}", from.label(), to.label());
        let down: Vec<_> =
            peer.links.iter().filter(|link| !link.is_up).map(|link| link.class.as_str()).collect();
        if peer.links.is_empty() || !down.is_empty() {
            let which = if peer.links.is_empty() {
                "never connected".to_owned()
            } else {
                format!("{} down", down.join(", "))
            };
            let since = peer.broken_us.map_or_else(String::new, |us| format!(", broken {} ago", time(us)));
            let (dial, fix) = dial_in_words(peer);
            let refused = refused_just_now(from, to);
            let refusals: String = refused
                .iter()
                .map(|(end, refusal)| {
                    format!("; {} refused: {} ({})", end.label(), refusal.detail, refusal.cause)
                })
                .collect();
            let proof = keys::remedy_of(refused.iter().map(|(_, refusal)| *refusal));
            let fix = match &peer.dial {
                None => proof.unwrap_or(fix),
                Some(_) => fix,
            };
            self.blocked(what, format!("{which}{since}{dial}{refusals}"), fix);
            return;
        }
        let since = peer.linked_us.map_or_else(String::new, |us| format!(" since {}", time(us)));
        let sum = |count: fn(&sinew::inspect::LinkReport) -> u64| peer.links.iter().map(count).sum::<u64>();
        let (waiting, unconfirmed) = (sum(|link| link.waiting), sum(|link| link.unconfirmed));
        let mut detail = format!("{} up{since}", peer.links.len());
        if waiting + unconfirmed > 0 {
            detail += &format!(", {waiting} messages wait, {unconfirmed} are not confirmed yet");
        }
        self.fine(what, detail);
    }

    /// Checks whether the requested application accepts messages; `ping` is the result of one to it.
    fn application(
        &mut self,
        (end, other): (&TrafficEnd, &TrafficEnd),
        ping: Option<&Result<u64, String>>,
        facts: &Facts,
    ) {
        let Some(app) = &end.app else { return };
        let what = format!("{} takes messages", end.label());
        let Some(report) = &app.report else {
            if end.report.is_some() {
                self.unnamed(what, app.unreported.as_ref(), ping);
            }
            return;
        };
        if let Some(circle) = report.name.as_ref().and_then(|name| circle(name, facts)) {
            return self.blocked(
                what,
                format!("requirements in a circle: {}", circle.join(" -> ")),
                "take one of these `requires` away: none of them can start before the others",
            );
        }
        if !report.ready {
            let why = crate::apps::why(report);
            let why = if why.is_empty() { "not ready".to_owned() } else { why };
            let is_other = |missing: &Missing| missing.name == other.wanted;
            if self.is_blocked() && !report.missing.is_empty() && report.missing.iter().all(is_other) {
                return self.explained(what, why);
            }
            return self.blocked(what, why, unnamed::fix_of_wait(&report.missing));
        }
        if let Some((detail, fix)) = troubled(app) {
            return self.blocked(what, detail, fix);
        }
        if !report.missing.is_empty() {
            let fix = "`sinew apps` shows its state; `on_requirement_lost` decides what the application does meanwhile";
            return self.note(what, format!("ready, but it lost {}", crate::apps::lacks(report)), fix);
        }
        let mailbox = app.line.as_ref().and_then(|line| line.waiting.zip(line.waiting_most));
        let mailbox = mailbox
            .map_or_else(String::new, |(now, most)| format!(", {now} messages wait for it (at most {most})"));
        let refused = app.refused;
        if refused > 0 {
            let fix = "`sinew watch` shows each refusal with its reason, `sinew audit` the sums; is it slower than its senders?";
            return self.note(what, format!("ready{mailbox}; {refused} messages were refused so far"), fix);
        }
        self.fine(what, format!("ready{mailbox}"));
    }

    /// Adds the result of the message that this command sent. `is_asked_for`: it took the way that the user has asked
    /// for, not the way back.
    fn ping(
        &mut self,
        ping: Option<&Result<u64, String>>,
        (from, to): (&TrafficEnd, &TrafficEnd),
        is_asked_for: bool,
    ) {
        let what = format!("a message goes from {} to {}", from.node_label(), to.label());
        // None was sent, because it would only wait there; the fix is in another step.
        if from.report.is_some()
            && !matches!(ping, Some(Ok(_)))
            && let Some(why) = to.not_ready()
        {
            let detail = format!("not tried: {why}");
            return self.0.push(Step { what, state: State::Note, detail, fix: None });
        }
        match ping {
            Some(Ok(micros)) => self.fine(what, format!("confirmed after {}", time(*micros))),
            Some(Err(why)) if *why == Rejection::NotAllowed.to_string() => {
                let may = access::may_send(from, to);
                let detail = "the access list there does not let this command send";
                if !is_asked_for {
                    let detail = format!("{detail}, and nothing on the way needs that");
                    return self.0.push(Step { what, state: State::Note, detail, fix: None });
                }
                if self.0.iter().any(|step| step.what == may) {
                    // The list was checked for the two applications; this command is a third one.
                    let fix =
                        "a [[rule]] for this command, if it is to; what the list says of the two is above";
                    self.note(what, detail, fix);
                } else {
                    // The list's verdict is not known for any sender.
                    let to = to.label();
                    let fix = format!(
                        "`sinew why SENDER {to}`, with an application for SENDER, names the rule; or have a [[rule]] let this command send"
                    );
                    self.blocked(what, detail, fix);
                }
            }
            Some(Err(why)) => {
                // An earlier finding explains it.
                let is_explained = self.is_blocked();
                let fix = "`sinew tree` of its node shows what it does; is it busy, or does it hang?";
                let fix = (!is_explained).then(|| fix.to_owned());
                self.0.push(Step { what, state: State::Blocked, detail: why.clone(), fix });
            }
            // It cannot be asked, or its node is unknown: an earlier step reports that it blocks.
            None if from.report.is_none() || to.node.is_none() => {}
            None => {
                let node = from.node_label();
                self.note(
                    what,
                    format!("not tried from there: this command has no socket of {node}, which is known from other nodes"),
                    format!(
                        "`sinew why {} {}` on the host of {node}; if its socket is on this one: --other-socket PATH",
                        from.label(),
                        to.label()
                    ),
                );
            }
        }
    }
}

fn last_received(peer: &PeerReport) -> String {
    let silent = peer.silent_us.map_or_else(|| "heard".to_owned(), |us| format!("heard {} ago", time(us)));
    let found = peer.found_us.map_or_else(String::new, |us| format!(", found {} ago", time(us)));
    format!("{silent}{found} by {}", joined(&peer.found_by))
}

fn joined(words: &[String]) -> String {
    if words.is_empty() { "another way".to_owned() } else { words.join(", ") }
}

fn dial_in_words(peer: &PeerReport) -> (String, String) {
    let Some(dial) = &peer.dial else {
        return (
            String::new(),
            "is it just starting? Else its log and that of the other say which of them refuses the connection".to_owned(),
        );
    };
    let detail = format!(
        "; {} failed dials, the last of {} {} ago: {}",
        dial.failed,
        dial.address,
        time(dial.ago_us),
        dial.error
    );
    let address = &dial.address;
    let fix = match dial.fault.as_str() {
        "not proven" => {
            format!(
                "TCP reaches {address}, and the node there is not authenticated: {}",
                keys::remedy(&dial.error)
            )
        }
        "hung up" => format!(
            "TCP reaches {address}, and the other end closed the connection: is that its node, and what does its log say?"
        ),
        "refused" => nobody_listens(address),
        // From a version without this field.
        "" if dial.error.contains("refused") => nobody_listens(address),
        _ => format!(
            "TCP does not reach {address}: is there a route (`ip route get {}`), does a firewall drop it?",
            address.rsplit_once(':').map_or(address.as_str(), |(host, _)| host)
        ),
    };
    (detail, fix)
}

fn nobody_listens(address: &str) -> String {
    format!(
        "nothing listens at {address}: does `gncl.announce` of the other name its real address, does a firewall reject TCP there?"
    )
}

/// Returns the current refusals of each of the two because of the other.
fn refused_just_now<'a>(
    from: &'a TrafficEnd,
    to: &'a TrafficEnd,
) -> Vec<(&'a TrafficEnd, &'a RefusalReport)> {
    let of = |end: &'a TrafficEnd, other: &'a TrafficEnd| {
        let node = other.node.map(|node| node.to_string());
        let refusals = end.report.iter().flat_map(|report| &report.refusals);
        let concerns = refusals.filter(move |refusal| {
            refusal.ago_us < RECENT_US && node.as_ref().is_some_and(|node| speaks_of(&refusal.detail, node))
        });
        concerns.map(move |refusal| (end, refusal))
    };
    of(from, to).chain(of(to, from)).collect()
}

/// Returns whether a text contains this address, not only as a part of a longer one: `10.0.0.1` is not in `10.0.0.10`.
fn speaks_of(text: &str, address: &str) -> bool {
    text.match_indices(address).any(|(at, _)| {
        let (before, behind) = (&text[..at], &text[at + address.len()..]);
        !before.ends_with(char::is_alphanumeric) && !behind.starts_with(char::is_alphanumeric)
    })
}

/// Returns the trouble of an application that counts as ready but does not handle its messages.
fn troubled(app: &App) -> Option<(String, &'static str)> {
    let line = app.line.as_ref()?;
    let is_well = line.state == "ready";
    (!is_well).then(|| {
        let reason = line
            .last_reason
            .as_ref()
            .map_or_else(String::new, |reason| format!(", the last incarnation {reason}"));
        let detail = format!("{} for {}{reason}", line.state, time(line.since_us));
        (detail, "`sinew tree` shows its supervisor, its log says more")
    })
}

/// Returns the names that wait for each other in a circle with `name`, with `name` at both ends.
fn circle<'a>(name: &'a str, facts: &'a Facts) -> Option<Vec<&'a str>> {
    let mut ways = vec![vec![name]];
    let mut been = BTreeSet::new();
    while let Some(way) = ways.pop() {
        let last = way.last().copied()?;
        for next in facts.waits.get(last).into_iter().flatten() {
            let longer: Vec<_> = way.iter().copied().chain([next.as_str()]).collect();
            if next == name {
                return Some(longer);
            }
            if been.insert(next.as_str()) {
                ways.push(longer);
            }
        }
    }
    None
}

#[cfg(test)]
mod tests;
