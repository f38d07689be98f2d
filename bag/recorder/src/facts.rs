//! Facts of a journal as events of a recording.

use serde_json::Value;
use sinew_bag::{ClockReading, Event, EventTopic, Level};
use sinew_record::{LogFact, NodeFact, PeerClock};
use sinew_runtime::{tid::Tid, wire::Kind};

use crate::{names::Names, sink::Sink};

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
            // The node does not report it: two readings give it.
            drift_ppb: 0,
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

/// Writes that facts are in no file.
pub(crate) fn lost(sink: &mut Sink, at_ns: u64, count: u64) {
    let text =
        format!("{count} events, clock readings or log lines were not recorded: the recorder was too slow");
    let data = serde_json::json!({ "lost": count });
    let (topic, level) = (EventTopic::Events, Level::Warning);
    sink.event(&Event { topic, at_ns, level, name: "sinew.record", text: &text, data: &data });
}
