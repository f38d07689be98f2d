//! Facts and outcomes of a journal as events of a recording.

use serde_json::{Value, json};
use sinew_bag::{ClockReading, Event, EventTopic, Level};
use sinew_record::{LogFact, NodeFact, OutcomeEntry, PeerClock};
use sinew_runtime::{
    outcome::{Outcome, Ticket},
    tid::Tid,
    wire::Kind,
};

use crate::{channels::party, names::Names, sink::Sink};

/// Writes a change of nodes, applications or barriers.
pub(crate) fn node(sink: &mut Sink, at_ns: u64, fact: &NodeFact) {
    let data = serde_json::to_value(fact).unwrap_or(Value::Null);
    let (mut topic, mut level) = (EventTopic::Events, Level::Info);
    let (name, text) = match fact {
        NodeFact::Began { node, name, project, .. } => {
            (name, format!("the node {name} at {node}, of the project {project}, records"))
        }
        NodeFact::NodeFound { node, name, .. } => (name, format!("the node {name} at {node} is present")),
        NodeFact::NodeLost { node, name, why, .. } => {
            level = Level::Warning;
            let why = if why.is_empty() { String::new() } else { format!(": {why}") };
            (name, format!("the node {name} at {node} is lost{why}"))
        }
        NodeFact::AppNamed { node, app, name, is_ready } => {
            let state = if *is_ready { "is ready" } else { "is not ready" };
            (name, format!("the application {name} at {} {state}", Tid::new(*node, *app)))
        }
        NodeFact::AppGone { node, app, name } => {
            (name, format!("the application {name} at {} has ended", Tid::new(*node, *app)))
        }
        NodeFact::Restarted { name, restarts, why, .. } => {
            level = Level::Warning;
            (name, format!("the actor {name} is restarted (restart {restarts}); its last end: {why}"))
        }
        NodeFact::Barrier { name, generation, waiting, missing } => {
            topic = EventTopic::Barriers;
            let list = |names: &[String]| if names.is_empty() { "none".to_owned() } else { names.join(", ") };
            let (waiting, missing) = (list(waiting), list(missing));
            (name, format!("{name}, generation {generation}: waiting: {waiting}; missing: {missing}"))
        }
        NodeFact::Triggered { id, cause, .. } => {
            level = Level::Warning;
            (id, format!("the messages around this moment are frozen: {cause}"))
        }
        // It is a name, no event.
        NodeFact::TypeNamed { .. } => return,
    };
    sink.event(&Event { topic, at_ns, level, name, text: &text, data: &data });
}

/// Adds the names in a fact.
pub(crate) fn learn(names: &mut Names, fact: &NodeFact) {
    match fact {
        NodeFact::Began { node, name, .. } | NodeFact::NodeFound { node, name, .. } => {
            names.add_node(*node, name);
        }
        NodeFact::AppNamed { node, app, name, .. } => names.add_app(Tid::new(*node, *app), name),
        NodeFact::TypeNamed { kind, name } => {
            names.add_type(Kind::from_bits(*kind), name);
        }
        // Messages of it may still be in the journal.
        NodeFact::NodeLost { .. }
        | NodeFact::AppGone { .. }
        | NodeFact::Restarted { .. }
        | NodeFact::Barrier { .. }
        | NodeFact::Triggered { .. } => {}
    }
}

/// Writes the clocks of the other nodes.
pub(crate) fn clocks(sink: &mut Sink, at_ns: u64, peers: &[PeerClock], names: &Names) {
    for peer in peers {
        let reading = ClockReading {
            peer: peer.node.to_string(),
            name: names.node(peer.node).map(str::to_owned),
            incarnation: peer.incarnation.0,
            offset_ns: peer.theirs_minus_ours_ns,
            bound_ns: peer.bound_ns,
            drift_ppb: peer.drift_ppb,
            drift_bound_ppb: peer.drift_bound_ppb,
        };
        sink.clock(at_ns, &reading);
    }
}

/// Writes a line of the log.
pub(crate) fn log(sink: &mut Sink, at_ns: u64, fact: &LogFact) {
    let level = match fact.level.as_str() {
        "error" => Level::Error,
        "warn" => Level::Warning,
        "info" => Level::Info,
        _ => Level::Debug,
    };
    let event = Event {
        topic: EventTopic::Log,
        at_ns,
        level,
        name: &fact.target,
        text: &fact.text,
        data: &Value::Null,
    };
    sink.event(&event);
}

/// Writes the outcome of a confirmed message.
pub(crate) fn outcome(sink: &mut Sink, at_ns: u64, entry: &OutcomeEntry, names: &Names) {
    let Ticket { source, destination, correlation } = entry.ticket;
    let [from, to] = [source, destination].map(|tid| party(tid, names));
    let why = if let Outcome::Rejected(why) = entry.outcome { Some(why) } else { None };
    let word = if why.is_some() { "Rejected".to_owned() } else { format!("{:?}", entry.outcome) };
    let reason = why.map_or_else(String::new, |why| format!(" ({why:?})"));
    let text = format!("message {correlation} from {} to {}: {word}{reason}", from.label(), to.label());
    let data = json!({
        "source": from.text, "source_name": from.name, "destination": to.text, "destination_name": to.name,
        "correlation": correlation, "outcome": word, "why": why.map(|why| format!("{why:?}")),
    });
    let level = if entry.outcome == Outcome::Delivered { Level::Debug } else { Level::Warning };
    let (topic, name) = (EventTopic::Outcomes, from.label());
    sink.event(&Event { topic, at_ns, level, name, text: &text, data: &data });
}

/// Writes and counts the facts and outcomes that are in no file.
pub(crate) fn lost(sink: &mut Sink, at_ns: u64, facts: u64, outcomes: u64) {
    let lost = [(facts, "events, clock readings or log lines"), (outcomes, "outcomes")];
    for (count, of) in lost.into_iter().filter(|(count, _)| *count > 0) {
        let text = format!("{count} {of} were not recorded: the recorder was too slow");
        let data = json!({ "lost": count, "of": of });
        let (topic, level) = (EventTopic::Events, Level::Warning);
        sink.event(&Event { topic, at_ns, level, name: "sinew.record", text: &text, data: &data });
        sink.lose_events(count);
    }
}
