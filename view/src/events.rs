//! The log of events: the differences between two snapshots, in sentences.

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use serde::Serialize;
use sinew::{NodeAddress, address::Incarnation, inspect::Missing, stop::StopState};

use crate::{
    nodes::{NodeLabels, State, bounded, rows},
    snapshot::{Answers, Snapshot},
    source::name_or_tid,
    stop,
};

/// Events that are kept. Older ones are dropped.
const EVENTS_MAX: usize = 512;
/// Facts of one snapshot. Further ones cause no events.
const FACTS_MAX: usize = 8_192;
/// Maximum number of nodes with a stored number of the last log line. Lines of further nodes may cause events again.
const LOGGED_MAX: usize = 1_024;
/// Characters of the text of an event.
const TEXT_MAX: usize = 400;

/// An event.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub(crate) struct Event {
    /// Its number, from 1 without gaps.
    pub(crate) number: u64,
    /// When it was seen, in milliseconds of the wall clock.
    pub(crate) wall_ms: u64,
    /// `node`, `stop`, `application`, `barrier`, `output`, `link`, `log` or `write`.
    pub(crate) topic: &'static str,
    /// The part of the system that it is about.
    pub(crate) subject: String,
    /// The new state, or the act.
    pub(crate) text: String,
    /// Whether it is a state that is wanted.
    pub(crate) is_fine: bool,
}

/// A state of a part of the system.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Fact {
    text: String,
    is_fine: bool,
    /// The node that reports it.
    node: NodeAddress,
}

type Facts = BTreeMap<(&'static str, String), Fact>;

/// The latest events, and the states that the next snapshot is compared with.
#[derive(Debug, Default)]
pub(crate) struct EventLog {
    events: VecDeque<Event>,
    last: u64,
    known: Option<Facts>,
    /// The number of the latest line of each node.
    logged: BTreeMap<NodeAddress, (Incarnation, u64)>,
}

impl EventLog {
    /// Compares a snapshot with the former one. The first one causes no events.
    pub(crate) fn observe(&mut self, snapshot: &Snapshot, wall_ms: u64) {
        if snapshot.entry.is_err() {
            // Nothing is known of anything.
            return;
        }
        self.observe_logs(snapshot, wall_ms);
        let mut new = facts(snapshot);
        let Some(known) = self.known.take() else {
            self.known = Some(new);
            return;
        };
        let silent: BTreeSet<_> =
            snapshot.nodes.iter().filter(|one| one.result.is_err()).map(|one| one.node).collect();
        let answers: BTreeSet<_> =
            snapshot.nodes.iter().filter(|one| one.result.is_ok()).map(|one| one.node).collect();
        // Beyond the bound a fact that is missing may only have been left out.
        let is_whole = new.len().max(known.len()) < FACTS_MAX;
        for (key, fact) in &new {
            let former = known.get(key);
            if former.map_or(is_whole, |former| (&former.text, former.is_fine) != (&fact.text, fact.is_fine))
            {
                self.push(wall_ms, key, fact.text.clone(), fact.is_fine);
            }
        }
        for (key, fact) in known {
            if new.contains_key(&key) {
                continue;
            }
            if silent.contains(&fact.node) {
                // Its node gives no answer, which is an event by itself.
                new.insert(key, fact);
            } else if is_whole && answers.contains(&fact.node) {
                let is_barrier = key.0 == "barrier";
                let text = if is_barrier { "nothing waits there any more" } else { "has gone" };
                self.push(wall_ms, &key, text.to_owned(), is_barrier);
            }
        }
        self.known = Some(new);
    }

    /// Adds the lines of all logs since the former snapshot. Those of the first one cause no events.
    fn observe_logs(&mut self, snapshot: &Snapshot, wall_ms: u64) {
        let (labels, is_first) = (NodeLabels::of(snapshot), self.known.is_none());
        if self.logged.len() > LOGGED_MAX {
            self.logged.clear();
        }
        for answers in snapshot.answers() {
            let (node, incarnation) = (answers.node.node, answers.node.incarnation);
            let former = self.logged.get(&node).filter(|(former, _)| *former == incarnation);
            let seen = former.map_or(0, |(_, number)| *number);
            let latest = answers.log.iter().map(|line| line.number).max().unwrap_or(0).max(seen);
            self.logged.insert(node, (incarnation, latest));
            let subject = ("log", labels.get(node));
            for line in answers.log.iter().filter(|line| !is_first && line.number > seen) {
                let text = format!("{} {}: {}", line.level, line.target, line.text);
                self.push(wall_ms, &subject, text, !["warn", "error"].contains(&line.level.as_str()));
            }
        }
    }

    /// Adds an event of this program, such as a set of parameters.
    pub(crate) fn write(&mut self, wall_ms: u64, subject: &str, text: String, is_fine: bool) {
        self.push(wall_ms, &("write", bounded(subject)), text, is_fine);
    }

    /// Returns the events after this number that are still kept.
    pub(crate) fn after(&self, number: u64) -> Vec<Event> {
        self.events.iter().filter(|event| event.number > number).cloned().collect()
    }

    fn push(&mut self, wall_ms: u64, (topic, subject): &(&'static str, String), text: String, is_fine: bool) {
        self.last += 1;
        if self.events.len() == EVENTS_MAX {
            self.events.pop_front();
        }
        let text = text.chars().take(TEXT_MAX).collect();
        let event = Event { number: self.last, wall_ms, topic, subject: subject.clone(), text, is_fine };
        self.events.push_back(event);
    }
}

fn facts(snapshot: &Snapshot) -> Facts {
    let labels = NodeLabels::of(snapshot);
    let mut facts = Facts::new();
    let mut add = |topic, subject: String, node, text: String, is_fine| {
        if facts.len() < FACTS_MAX {
            facts.insert((topic, bounded(&subject)), Fact { text, is_fine, node });
        }
    };
    for row in rows(snapshot, &labels) {
        let (text, is_fine) = match &row.state {
            State::Up => ("is up".to_owned(), true),
            State::Stops => ("stops".to_owned(), true),
            State::Lost(_, why) => (format!("is lost: {why}"), false),
            State::Silent(why) => (format!("gives no answer: {why}"), false),
        };
        add("node", row.label, row.node, text, is_fine);
    }
    for answers in snapshot.answers() {
        let label = labels.get(answers.node.node);
        if let Some(state) = answers.node.stop {
            let text = format!("is {}", stop::word(state));
            add("stop", label.clone(), answers.node.node, text, state == StopState::Released);
        }
        add_apps(&mut add, answers, snapshot);
        add_barriers(&mut add, answers, &label);
        add_outputs(&mut add, answers);
        for peer in &answers.node.peers {
            for link in &peer.links {
                let subject = format!("{label} to {} ({})", labels.get(peer.node), bounded(&link.class));
                let text = if link.is_up { "is connected" } else { "is not connected" };
                add("link", subject, answers.node.node, text.to_owned(), link.is_up);
            }
        }
    }
    facts
}

type Add<'f> = dyn FnMut(&'static str, String, NodeAddress, String, bool) + 'f;

fn add_apps(add: &mut Add<'_>, answers: &Answers, snapshot: &Snapshot) {
    let node = answers.node.node;
    let incarnation =
        |tid| answers.tree.lines.iter().find(|line| line.tid == Some(tid)).map(|line| line.life);
    for app in answers.apps.apps.iter().filter(|app| !snapshot.own.contains(&app.tid)) {
        // Commands have no name, and come and go.
        let Some(name) = &app.name else { continue };
        let text = match (app.ready, incarnation(app.tid)) {
            (true, Some(number)) if number > 1 => format!("is ready, incarnation {number}"),
            (true, _) => "is ready".to_owned(),
            (false, _) => match (&app.ended, missing(&app.missing)) {
                (Some(why), _) => format!("is not ready; its former incarnation has ended: {why}"),
                (None, Some(missing)) => format!("waits for {missing}"),
                (None, None) => "is not ready".to_owned(),
            },
        };
        add("application", name.clone(), node, text, app.ready);
    }
}

fn add_barriers(add: &mut Add<'_>, answers: &Answers, label: &str) {
    for barrier in &answers.apps.barriers {
        let subject = format!("{} on {label}", bounded(&barrier.name));
        let text = missing(&barrier.missing).map_or_else(
            || "applications wait there".to_owned(),
            |missing| format!("is blocked by {missing}"),
        );
        add("barrier", subject, answers.node.node, text, barrier.missing.is_empty());
    }
}

fn add_outputs(add: &mut Add<'_>, answers: &Answers) {
    let apps = &answers.apps.apps;
    for guard in &answers.node.guards {
        let app = apps.iter().find(|app| app.tid == guard.receiver);
        let name = name_or_tid(app.and_then(|app| app.name.as_deref()), guard.receiver);
        let text = match (&guard.safe, guard.is_safe_failed) {
            (_, true) => "its safe function has failed and is retried".to_owned(),
            (Some(why), false) => format!("is safe: {why}"),
            (None, false) => "is live".to_owned(),
        };
        let subject = format!("{name}, {}", bounded(&guard.kind_name));
        add("output", subject, answers.node.node, text, guard.safe.is_none() && !guard.is_safe_failed);
    }
}

/// Returns the missing names with their reasons.
fn missing(missing: &[Missing]) -> Option<String> {
    let all: Vec<_> = missing.iter().map(|one| format!("{} ({})", one.name, one.why)).collect();
    (!all.is_empty()).then(|| all.join(", "))
}

#[cfg(test)]
mod tests {
    use sinew::inspect::{AppReport, LogLine};

    use super::*;
    use crate::metrics::tests::{lost, snapshot};

    fn texts(log: &EventLog, after: u64) -> Vec<String> {
        let text = |event: &Event| format!("{} {}: {}", event.topic, event.subject, event.text);
        log.after(after).iter().map(text).collect()
    }

    #[test]
    fn first_and_same_snapshots_cause_no_events() {
        let mut log = EventLog::default();
        log.observe(&snapshot(), 1);
        log.observe(&snapshot(), 2);
        assert!(log.after(0).is_empty(), "{:?}", log.after(0));
    }

    #[test]
    fn lost_node_is_an_event_with_its_class() {
        let mut log = EventLog::default();
        log.observe(&snapshot(), 1);
        let mut next = snapshot();
        let gone = next.nodes.pop().expect("the knee").node;
        let Ok(entry) = &mut next.entry else { panic!("it has answered") };
        entry.lost.push(lost(gone, "knee", "crashed"));
        log.observe(&next, 2);
        let texts = texts(&log, 0);
        assert!(texts.contains(&"node knee: is lost: crashed".to_owned()), "{texts:?}");
    }

    #[test]
    fn new_lines_of_a_log_are_events_once() {
        let with = |numbers: &[u64], incarnation| {
            let mut all = snapshot();
            let Ok(hip) = &mut all.nodes[0].result else { panic!("it has answered") };
            hip.node.incarnation = Incarnation(incarnation);
            let [level, target] = ["warn", "sinew::gncl"].map(str::to_owned);
            let line = |number: &u64| LogLine {
                number: *number,
                at_ns: 1,
                level: level.clone(),
                target: target.clone(),
                text: format!("text {number}"),
            };
            hip.log = numbers.iter().map(line).collect();
            all
        };
        let mut log = EventLog::default();
        log.observe(&with(&[1, 2], 1), 1);
        assert!(log.after(0).is_empty(), "those before the first look");
        log.observe(&with(&[1, 2, 5], 1), 2);
        log.observe(&with(&[2, 5], 1), 3);
        log.observe(&with(&[], 1), 4);
        log.observe(&with(&[5], 1), 5);
        assert_eq!(texts(&log, 0), ["log hip: warn sinew::gncl: text 5"]);
        // A node that was started anew numbers its lines from 1.
        log.observe(&with(&[1], 2), 6);
        assert_eq!(texts(&log, 1), ["log hip: warn sinew::gncl: text 1"]);
    }

    #[test]
    fn stop_that_is_pressed_elsewhere_is_an_event() {
        let mut log = EventLog::default();
        let with = |state| {
            let mut all = snapshot();
            let Ok(hip) = &mut all.nodes[0].result else { panic!("it has answered") };
            hip.node.stop = Some(state);
            all
        };
        log.observe(&with(StopState::Released), 1);
        log.observe(&with(StopState::Stopped), 2);
        assert_eq!(texts(&log, 0), ["stop hip: is stopped"]);
    }

    #[test]
    fn silent_node_keeps_its_states() {
        let mut log = EventLog::default();
        log.observe(&snapshot(), 1);
        let mut next = snapshot();
        next.nodes[1].result = Err("no answer".to_owned());
        log.observe(&next, 2);
        let found = texts(&log, 0);
        assert_eq!(found, ["node knee: gives no answer: no answer"]);
        log.observe(&snapshot(), 3);
        assert_eq!(texts(&log, 1), ["node knee: is up"]);
    }

    #[test]
    fn facts_beyond_their_bound_cause_no_events() {
        let with = |count: usize| {
            let mut all = snapshot();
            let Ok(hip) = &mut all.nodes[0].result else { panic!("it has answered") };
            let app = hip.apps.apps.iter().find(|app| app.name.is_some()).expect("a name").clone();
            let name = |number| AppReport { name: Some(format!("app{number}")), ..app.clone() };
            hip.apps.apps = (0..count).map(name).collect();
            all
        };
        let mut log = EventLog::default();
        log.observe(&with(FACTS_MAX), 1);
        log.observe(&with(FACTS_MAX - 10), 2);
        assert!(log.after(0).is_empty(), "{:?}", texts(&log, 0));
        // And: below it they do
        let mut log = EventLog::default();
        log.observe(&with(10), 1);
        log.observe(&with(11), 2);
        assert_eq!(log.after(0).len(), 1, "{:?}", texts(&log, 0));
    }

    #[test]
    fn events_have_a_bound_and_numbers_without_gaps() {
        let mut log = EventLog::default();
        for number in 0..EVENTS_MAX as u64 + 3 {
            log.write(number, &"knee".repeat(TEXT_MAX), "x".repeat(2 * TEXT_MAX), true);
        }
        let events = log.after(0);
        assert_eq!((events.len(), events[0].number), (EVENTS_MAX, 4));
        assert!(events.iter().all(|event| event.text.len() == TEXT_MAX && event.subject.len() < TEXT_MAX));
        assert_eq!(log.after(EVENTS_MAX as u64 + 2).len(), 1);
    }
}
