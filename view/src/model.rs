//! The state of the system as JSON, for the page. Each list has a bound.

use std::collections::BTreeMap;

use serde_json::{Value, json};
use sinew::{
    Payload as _, Tid,
    audit::{Account, Entry, Place},
    inspect::{AppReport, BarrierReport, GuardReport, LostReport, Missing, NodeReport, PeerReport, TreeLine},
    parameters::AskParameters,
};

use crate::{
    nodes::{NodeLabels, NodeRow, State, rows},
    snapshot::{Answers, NODES_MAX, Snapshot},
    source::{AppParameters, name_or_tid},
};

/// Rows of each table, over all nodes. Further ones are counted.
const ROWS_MAX: usize = 2_048;
/// Other nodes in the report of one node. Further ones are left out.
const PEERS_MAX: usize = NODES_MAX;

/// Returns the rows of one node.
type Rows = fn(&Answers, &NodeLabels, &Snapshot) -> Vec<Value>;

/// Returns the state of the system. `wall_ms` is the time of the snapshot on the wall clock.
pub(crate) fn state(snapshot: &Snapshot, wall_ms: u64) -> Value {
    let labels = NodeLabels::of(snapshot);
    let answers = |row: &NodeRow| snapshot.answers().find(|answers| answers.node.node == row.node);
    let lost = snapshot.entry.iter().flat_map(|entry| &entry.lost);
    let lost: BTreeMap<_, _> = lost.map(|lost| (lost.node, lost)).collect();
    let nodes: Vec<_> = rows(snapshot, &labels)
        .iter()
        .map(|row| node(row, answers(row), lost.get(&row.node).copied(), &labels))
        .collect();
    let mut left_out = snapshot.left_out;
    let mut each = |of: Rows| {
        let mut all = Vec::new();
        for answers in snapshot.answers() {
            let part = of(answers, &labels, snapshot);
            let room = ROWS_MAX - all.len();
            left_out += part.len().saturating_sub(room) as u64;
            all.extend(part.into_iter().take(room));
        }
        all
    };
    let (apps, barriers) = (each(apps), each(barriers));
    let (outputs, outcomes) = (each(outputs), each(outcomes));
    json!({
        "wall_ms": wall_ms,
        "took_ms": snapshot.took.as_secs_f64() * 1e3,
        "fault": snapshot.entry.as_ref().err(),
        "entry": snapshot.entry.as_ref().ok().map(|entry| labels.get(entry.node)),
        "project": snapshot.entry.as_ref().ok().map(|entry| &entry.project),
        "nodes": nodes, "apps": apps, "barriers": barriers, "outputs": outputs, "outcomes": outcomes,
        "left_out": left_out,
    })
}

fn node(row: &NodeRow, answers: Option<&Answers>, lost: Option<&LostReport>, labels: &NodeLabels) -> Value {
    let (word, class, why) = match &row.state {
        State::Up => ("up", None, None),
        State::Stops => ("stops", None, None),
        State::Lost(class, why) => ("lost", Some(*class), Some(why)),
        State::Silent(why) => ("silent", None, Some(why)),
    };
    json!({
        "node": row.node.to_string(), "label": row.label, "state": word, "class": class, "why": why,
        "report": answers.map(|answers| report(&answers.node, labels)),
        "lost": lost.filter(|_| matches!(row.state, State::Lost(..))).map(|lost| json!({
            "ago_s": seconds(lost.lost_us), "silent_ms": lost.silent_us as f64 / 1e3,
            "bound_ms": lost.bound_us.map(|micros| micros as f64 / 1e3),
        })),
    })
}

fn report(node: &NodeReport, labels: &NodeLabels) -> Value {
    let troubles = node.troubles.iter().map(|one| format!("{} {}", one.name, one.trouble));
    json!({
        "version": node.version, "pid": node.pid, "up_s": seconds(node.up_us), "refused": node.refused,
        "is_open": node.security.as_ref().map(|security| security.certificate.is_none()),
        "troubled": node.troubled, "troubles": troubles.collect::<Vec<_>>(),
        "stalls": node.own_stalls.map(|stalls| stalls.count),
        "real_time": node.real_time.as_ref().map(|found| json!({
            "granted": found.granted, "wanted": found.wanted, "max_us": found.max_ns as f64 / 1e3,
            "refusals": found.refusals, "memory": found.memory,
        })),
        "recording": node.recording.as_ref().map(|found| json!({
            "is_configured": found.is_configured, "programs": found.programs,
            "written_bytes": found.written_bytes, "seen": found.seen, "dropped": found.dropped,
        })),
        "peers": node.peers.iter().take(PEERS_MAX).map(|one| peer(one, labels)).collect::<Vec<_>>(),
    })
}

fn peer(peer: &PeerReport, labels: &NodeLabels) -> Value {
    let links = peer.links.iter().map(|link| {
        json!({
            "class": link.class, "is_up": link.is_up, "waiting": link.waiting, "unconfirmed": link.unconfirmed,
        })
    });
    json!({
        "node": peer.node.to_string(), "label": labels.get(peer.node), "is_there": peer.is_there,
        "silent_ms": peer.silent_us.map(|micros| micros as f64 / 1e3),
        "bound_ms": peer.bound_us.map(|micros| micros as f64 / 1e3),
        "round_trip_us": peer.round_trip_ns.map(|nanos| nanos as f64 / 1e3),
        "offset_us": peer.offset_ns.map(|nanos| nanos as f64 / 1e3),
        "offset_bound_us": peer.offset_bound_ns.map(|nanos| nanos as f64 / 1e3),
        "dial_error": peer.dial.as_ref().map(|dial| &dial.error),
        "links": links.collect::<Vec<_>>(),
    })
}

/// Returns the applications of a node, without those of this program and the other inspection commands.
fn apps(answers: &Answers, labels: &NodeLabels, snapshot: &Snapshot) -> Vec<Value> {
    let label = labels.get(answers.node.node);
    let shown = answers.apps.apps.iter().filter(|app| !snapshot.own.contains(&app.tid));
    shown.map(|app| self::app(app, line_of(answers, app.tid), &label)).collect()
}

fn line_of(answers: &Answers, tid: Tid) -> Option<&TreeLine> {
    answers.tree.lines.iter().find(|line| line.tid == Some(tid))
}

fn app(app: &AppReport, line: Option<&TreeLine>, label: &str) -> Value {
    let kinds = app.kinds.iter().map(|kind| kind.name.clone().unwrap_or_else(|| kind.kind.to_string()));
    json!({
        "tid": app.tid.to_string(), "name": app.name, "node": label, "ready": app.ready,
        "waits_s": app.waits_us.map(seconds), "missing": missing(&app.missing), "ended": app.ended,
        "has_parameters": app.kinds.iter().any(|kind| kind.kind == AskParameters::KIND),
        "kinds": kinds.filter(|kind| !kind.starts_with("sinew.")).collect::<Vec<_>>(),
        "state": line.map(|line| &line.state), "restarts": line.map(|line| line.restarts),
        "last_reason": line.and_then(|line| line.last_reason.as_ref()),
        "place": line.and_then(|line| line.place.as_ref()),
        "waiting": line.and_then(|line| line.waiting), "waiting_most": line.and_then(|line| line.waiting_most),
        "oldest_ms": line.and_then(|line| line.oldest_us).map(|micros| micros as f64 / 1e3),
    })
}

fn barriers(answers: &Answers, labels: &NodeLabels, _: &Snapshot) -> Vec<Value> {
    let label = labels.get(answers.node.node);
    answers.apps.barriers.iter().map(|one| barrier(one, &label)).collect()
}

fn barrier(barrier: &BarrierReport, label: &str) -> Value {
    let waiting =
        barrier.waiting.iter().map(|one| json!({ "name": one.name, "waits_s": seconds(one.waits_us) }));
    json!({
        "name": barrier.name, "node": label, "is_phase": barrier.is_phase, "generation": barrier.generation,
        "parties": barrier.parties, "waiting": waiting.collect::<Vec<_>>(), "missing": missing(&barrier.missing),
    })
}

fn missing(missing: &[Missing]) -> Vec<Value> {
    let one =
        |one: &Missing| json!({ "name": one.name, "why": one.why, "since_s": one.since_us.map(seconds) });
    missing.iter().map(one).collect()
}

fn outputs(answers: &Answers, labels: &NodeLabels, _: &Snapshot) -> Vec<Value> {
    let label = labels.get(answers.node.node);
    answers.node.guards.iter().map(|one| output(one, answers, &label)).collect()
}

fn output(guard: &GuardReport, answers: &Answers, label: &str) -> Value {
    let app = answers.apps.apps.iter().find(|app| app.tid == guard.receiver);
    json!({
        "app": name_or_tid(app.and_then(|app| app.name.as_deref()), guard.receiver), "node": label,
        "sender": guard.sender.to_string(), "kind": guard.kind_name, "safe": guard.safe,
        "is_safe_failed": guard.is_safe_failed,
    })
}

/// Returns the outcomes of messages at each place of a node that had any.
fn outcomes(answers: &Answers, labels: &NodeLabels, _: &Snapshot) -> Vec<Value> {
    let label = labels.get(answers.node.node);
    let row = |Entry { place, account }: &Entry| {
        let place = match place {
            Place::ToNode { node, .. } => format!("to {}", labels.get(*node)),
            Place::FromNode { node, .. } => format!("from {}", labels.get(*node)),
            Place::Mailbox { name, .. } | Place::Client { name, .. } => name.clone(),
            Place::DirectLink { to_name, .. } => format!("direct link to {to_name}"),
            Place::OtherMailboxes
            | Place::OtherClients
            | Place::ToFormerNodes
            | Place::FromFormerNodes
            | Place::OtherDirectLinks => place.to_string(),
        };
        json!({ "node": label, "place": place, "counts": counts(account) })
    };
    let has_any = |entry: &&Entry| entry.account.taken + entry.account.refused > 0;
    answers.audit.entries.iter().filter(has_any).map(row).collect()
}

fn counts(account: &Account) -> Value {
    json!({
        "taken": account.taken, "delivered": account.delivered, "superseded": account.superseded,
        "rejected": account.rejected, "expired": account.expired, "failed": account.failed,
        "lost": account.lost, "unknown": account.unknown, "refused": account.refused,
        "waiting": account.waiting,
    })
}

/// Returns the parameters of all applications.
pub(crate) fn parameters(apps: &[AppParameters]) -> Value {
    let of = |one: &AppParameters| match &one.result {
        Ok(list) => json!({ "app": one.app, "list": list }),
        Err(why) => json!({ "app": one.app, "fault": why }),
    };
    json!({ "apps": apps.iter().map(of).collect::<Vec<_>>() })
}

fn seconds(micros: u64) -> f64 {
    micros as f64 / 1e6
}

#[cfg(test)]
mod tests {
    use sinew::{Time, parameters::ParameterList};

    use super::*;
    use crate::metrics::tests::snapshot;

    #[test]
    fn state_has_nodes_with_their_loss_classes() {
        let state = state(&snapshot(), 7);
        let nodes = state["nodes"].as_array().expect("a list");
        let words: Vec<_> = nodes.iter().map(|one| one["state"].as_str().unwrap_or_default()).collect();
        assert_eq!(words, ["up", "up", "lost"]);
        assert_eq!((&nodes[2]["class"], &nodes[2]["report"]), (&json!("gave up"), &Value::Null));
        assert_eq!((&nodes[2]["lost"]["ago_s"], &nodes[1]["lost"]), (&json!(0.000_001), &Value::Null));
        assert_eq!((&state["entry"], &state["wall_ms"]), (&json!("hip"), &json!(7)));
        assert!(nodes[0]["report"]["peers"][0]["links"].is_array());
    }

    #[test]
    fn state_says_which_party_blocks_a_barrier_and_why() {
        let state = state(&snapshot(), 7);
        let barriers = state["barriers"].as_array().expect("a list");
        assert!(!barriers.is_empty());
        let missing = &barriers[0]["missing"][0];
        assert!(missing["name"].is_string() && missing["why"].is_string(), "{missing}");
    }

    #[test]
    fn applications_of_this_program_are_not_shown() {
        let all = snapshot();
        let state = state(&all, 7);
        let apps = state["apps"].as_array().expect("a list");
        let own: Vec<_> = all.own.iter().map(ToString::to_string).collect();
        assert!(!apps.is_empty());
        assert!(apps.iter().all(|app| !own.contains(&app["tid"].as_str().unwrap_or_default().to_owned())));
    }

    #[test]
    fn tables_have_a_bound_and_further_rows_are_counted() {
        let mut all = snapshot();
        let Ok(hip) = &mut all.nodes[0].result else { panic!("it has answered") };
        let app = hip.apps.apps[0].clone();
        hip.apps.apps = vec![app; ROWS_MAX + 3];
        let state = state(&all, 7);
        assert_eq!(state["apps"].as_array().map(Vec::len), Some(ROWS_MAX));
        // Three of the hip, and the four of the knee.
        assert_eq!(state["left_out"], json!(3 + 4));
    }

    #[test]
    fn unreachable_entry_node_is_a_fault_of_the_state() {
        let state = state(&Snapshot::without_entry(Time::from_nanos(0), "it has ended".to_owned()), 1);
        assert_eq!((&state["fault"], &state["nodes"]), (&json!("it has ended"), &json!([])));
    }

    #[test]
    fn parameters_that_are_not_known_have_a_reason() {
        let list = ParameterList { parameters: Vec::new(), has_ticks: true, undoable: 2 };
        let found = parameters(&[
            AppParameters { app: "knee".to_owned(), result: Ok(list) },
            AppParameters { app: "hip".to_owned(), result: Err("no answer".to_owned()) },
        ]);
        assert_eq!(found["apps"][0]["list"]["undoable"], json!(2));
        assert_eq!(found["apps"][1]["fault"], json!("no answer"));
    }
}
