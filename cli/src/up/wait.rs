//! Waits until nodes are ready, and names those that block, with the reasons.

use std::{collections::BTreeMap, thread, time::Duration};

use sinew::{Time, nearest::nearest};

use super::{
    fleet::Fleet,
    protocol::{AppSeen, Apps, NodeSeen},
    robot::Robot,
    run::{Printer, failed},
};
use crate::system::SystemError;

/// Interval between two looks at the nodes.
const LOOK: Duration = Duration::from_millis(250);
/// Interval at which changed reasons are printed.
const PRINTED: Duration = Duration::from_secs(2);

/// The state of a node in a wait.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum NodeState {
    Ready,
    /// It runs, and is not ready for these reasons.
    Waits(Vec<String>),
    /// Its process has ended; the last lines of its log.
    Ended(String),
    /// Nothing is known of it, for this reason.
    Unknown(String),
}

/// Judges a node by its host's report. `ready` are the applications that count; empty: all named ones.
pub(super) fn judge(ready: &[String], seen: Option<&NodeSeen>) -> NodeState {
    let Some(seen) = seen else { return NodeState::Unknown("it was not started".to_owned()) };
    if seen.process.is_none() {
        return NodeState::Ended(seen.last_lines.clone());
    }
    let apps = match &seen.apps {
        // A process that is no node.
        Apps::NotAsked => return NodeState::Ready,
        Apps::Silent(why) => return NodeState::Waits(vec![format!("the node does not answer: {why}")]),
        Apps::Listed(apps) => apps,
    };
    let unready = |app: &AppSeen| (!app.is_ready).then(|| format!("{}: {}", app.name, app.why));
    let reasons: Vec<_> = if ready.is_empty() {
        apps.iter().filter_map(unready).collect()
    } else {
        let of = |name: &String| match apps.iter().find(|app| app.name == *name) {
            Some(app) => unready(app),
            None => Some(absent(name, apps)),
        };
        ready.iter().filter_map(of).collect()
    };
    if reasons.is_empty() { NodeState::Ready } else { NodeState::Waits(reasons) }
}

fn absent(name: &str, apps: &[AppSeen]) -> String {
    let near = nearest(name, apps.iter().map(|app| app.name.as_str()), |name| name);
    let near = if near.is_empty() { String::new() } else { format!("; nearest: {}", near.join(", ")) };
    format!("{name}: the node has no such application{near}")
}

/// Waits until these nodes are ready.
///
/// # Errors
/// One of them has ended, a host is lost, or the time is over: each with the reasons of all nodes that block.
pub(super) fn wait(
    robot: &Robot,
    fleet: &mut Fleet,
    nodes: &[String],
    printer: Printer,
) -> Result<(), SystemError> {
    let end = Time::now() + robot.ready_within;
    let (mut printed, mut due) = (String::new(), Time::now() + PRINTED);
    loop {
        let states = look(robot, fleet, nodes)?;
        if states.values().all(|state| *state == NodeState::Ready) {
            return Ok(());
        }
        let reasons = reasons(&states);
        if states.values().any(|state| matches!(state, NodeState::Ended(_))) {
            return Err(failed(format!("a node has ended that others need:\n{reasons}")));
        }
        let now = Time::now();
        if now >= end {
            let within = robot.ready_within;
            return Err(failed(format!(
                "the robot is not released, as these are not ready within {within:?} (ready_within_ms):\n{reasons}"
            )));
        }
        if now >= due && reasons != printed {
            printer.line(&format!("waits for:\n{reasons}"));
            due = now + PRINTED;
            printed = reasons;
        }
        thread::sleep(LOOK.min(end.since(now)));
    }
}

/// Returns the states of these nodes.
pub(super) fn look(
    robot: &Robot,
    fleet: &mut Fleet,
    nodes: &[String],
) -> Result<BTreeMap<String, NodeState>, SystemError> {
    let mut seen = BTreeMap::new();
    for (host, result) in fleet.observe(true) {
        seen.insert(host, result.map_err(|error| failed(error.to_string()))?);
    }
    let state = |name: &String| {
        let node = robot.nodes.get(name)?;
        let seen = seen.get(&node.host).and_then(|seen| seen.iter().find(|seen| seen.order.name == *name));
        Some((name.clone(), judge(&node.ready, seen)))
    };
    Ok(nodes.iter().filter_map(state).collect())
}

/// Returns the nodes that block, each reason on a line.
fn reasons(states: &BTreeMap<String, NodeState>) -> String {
    let lines = |(name, state): (&String, &NodeState)| match state {
        NodeState::Ready => Vec::new(),
        NodeState::Waits(reasons) => reasons.iter().map(|reason| format!("  {name}: {reason}")).collect(),
        NodeState::Ended(lines) if lines.is_empty() => {
            vec![format!("  {name}: its process has ended, and its log is empty")]
        }
        NodeState::Ended(lines) => {
            let lines = lines.lines().map(|line| format!("    {line}"));
            std::iter::once(format!("  {name}: its process has ended; its last lines:"))
                .chain(lines)
                .collect()
        }
        NodeState::Unknown(why) => vec![format!("  {name}: {why}")],
    };
    states.iter().flat_map(lines).collect::<Vec<_>>().join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::up::{order::tests::order, protocol::ProcessSeen};

    fn seen(is_running: bool, apps: Apps) -> NodeSeen {
        let process = is_running.then_some(ProcessSeen { pid: 7, up_s: 1 });
        NodeSeen { order: order("knee", 1), process, last_lines: "no encoder".to_owned(), apps }
    }

    fn app(name: &str, is_ready: bool) -> AppSeen {
        let why = if is_ready { String::new() } else { "has waited 3.0 s for ankle (not there)".to_owned() };
        AppSeen { name: name.to_owned(), is_ready, why }
    }

    fn judged(ready: &[&str], seen: Option<&NodeSeen>) -> NodeState {
        judge(&ready.iter().map(|name| (*name).to_owned()).collect::<Vec<_>>(), seen)
    }

    #[test]
    fn node_is_ready_with_all_applications_or_the_named() {
        let apps = Apps::Listed(vec![app("knee.drive", true), app("knee.log", false)]);
        let knee = seen(true, apps);
        let waits = NodeState::Waits(vec!["knee.log: has waited 3.0 s for ankle (not there)".to_owned()]);
        assert_eq!(judged(&[], Some(&knee)), waits);
        assert_eq!(judged(&["knee.drive"], Some(&knee)), NodeState::Ready);
        let absent = "knee.driver: the node has no such application; nearest: knee.drive, knee.log";
        assert_eq!(judged(&["knee.driver"], Some(&knee)), NodeState::Waits(vec![absent.to_owned()]));
    }

    #[test]
    fn process_without_socket_is_ready_while_it_runs() {
        assert_eq!(judged(&[], Some(&seen(true, Apps::NotAsked))), NodeState::Ready);
        assert_eq!(
            judged(&[], Some(&seen(false, Apps::NotAsked))),
            NodeState::Ended("no encoder".to_owned())
        );
        assert_eq!(judged(&[], None), NodeState::Unknown("it was not started".to_owned()));
    }

    #[test]
    fn reasons_name_node_application_and_cause() {
        let states = BTreeMap::from([
            ("ankle".to_owned(), NodeState::Ended("no encoder\nthe node gave up".to_owned())),
            ("hip".to_owned(), NodeState::Ready),
            ("knee".to_owned(), NodeState::Waits(vec!["knee.drive: it starts".to_owned()])),
        ]);
        let text = "  ankle: its process has ended; its last lines:\n    no encoder\n    the node gave up\n  knee: knee.drive: it starts";
        assert_eq!(reasons(&states), text);
    }
}
