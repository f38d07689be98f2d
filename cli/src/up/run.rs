//! Carries out a plan: files first, then one step after the other.

use std::{collections::BTreeMap, fmt::Display};

use serde_json::{Value, json};

use super::{
    fleet::{Fleet, observed},
    gather::{Gathered, gather},
    plan::{self, Action, Plan, Step},
    protocol::{NodeSeen, Request},
    robot::Robot,
    session::{Access, HostError},
    status, wait,
};
use crate::{
    Report, output,
    system::SystemError,
    table::{Table, clean_lines},
};

/// Prints while the command works, unless its output is for programs.
#[derive(Clone, Copy, Debug)]
pub(super) struct Printer {
    pub(super) is_json: bool,
    pub(super) is_wide: bool,
}

impl Printer {
    pub(super) fn line(self, text: &str) {
        if !self.is_json {
            output::line(&clean_lines(text));
        }
    }
}

/// Returns the error of a start that is not complete.
pub(super) fn failed(why: impl Display) -> SystemError {
    SystemError::Up(format!("{why}\nWhat runs is shown by `sinew status`, and stopped by `sinew down`"))
}

/// Returns the error of faults that were found before anything was changed.
pub(super) fn unchanged(faults: &[String]) -> SystemError {
    SystemError::Up(format!("nothing was changed:\n{}", faults.join("\n")))
}

/// Starts the robot, or changes it to its file.
pub(super) fn up(robot: &Robot, is_dry: bool, printer: Printer) -> Result<Report, SystemError> {
    let gathered = gather(robot);
    if !gathered.faults.is_empty() {
        return Err(unchanged(&gathered.faults));
    }
    let (mut fleet, seen) = enter(robot, if is_dry { Access::Look } else { Access::Change })?;
    let plan = plan::plan(&gathered.wanted, &observed(&seen));
    let text = text(robot, &plan, printer.is_wide);
    if is_dry {
        return Ok(Report { text, json: json!({ "plan": rows_json(&plan) }), is_fine: true });
    }
    printer.line(&text);
    let prepared =
        check(&mut fleet, &plan, &gathered).and_then(|()| send(&mut fleet, &plan, &gathered, printer));
    if prepared.is_err() {
        fleet.sweep();
    }
    prepared?;
    for step in &plan.steps {
        take(step, robot, &mut fleet, &gathered, printer)?;
    }
    for host in fleet.hosts() {
        fleet.order(&host, &Request::Sweep).map_err(failed)?;
    }
    let ready = gathered.wanted.len();
    let text = format!("released: all {ready} nodes are ready\n");
    let nodes = status::of(robot, &mut fleet);
    let json = json!({ "plan": rows_json(&plan), "nodes": nodes.json(), "released": true });
    Ok(Report { text, json, is_fine: true })
}

/// Connects to all hosts, and returns the nodes on each. A robot of which one host is missing is not changed.
pub(super) fn enter(
    robot: &Robot,
    access: Access,
) -> Result<(Fleet, BTreeMap<String, Vec<NodeSeen>>), SystemError> {
    let (mut fleet, errors) = Fleet::enter(robot, access);
    let mut faults: Vec<_> = errors.values().map(ToString::to_string).collect();
    let mut seen = BTreeMap::new();
    if faults.is_empty() {
        for (host, nodes) in fleet.observe(false) {
            match nodes {
                Ok(nodes) => _ = seen.insert(host, nodes),
                Err(why) => faults.push(why.to_string()),
            }
        }
    }
    if faults.is_empty() {
        return Ok((fleet, seen));
    }
    if access == Access::Change {
        fleet.sweep();
    }
    Err(unchanged(&faults))
}

/// Checks that the ports and sockets of all nodes that are started are free.
fn check(fleet: &mut Fleet, plan: &Plan, gathered: &Gathered) -> Result<(), SystemError> {
    let mut faults = Vec::new();
    // The ports of a node that is started again are its own.
    for row in plan.rows.iter().filter(|row| row.action == Action::Start) {
        let Some(wanted) = gathered.wanted.get(&row.node) else { continue };
        let checked = fleet.order(&row.host, &Request::Check(wanted.order.clone()));
        faults.extend(checked.err().map(|why: HostError| why.to_string()));
    }
    if faults.is_empty() { Ok(()) } else { Err(unchanged(&faults)) }
}

/// Sends the files of all nodes that are started. Until this is done nothing is stopped.
fn send(fleet: &mut Fleet, plan: &Plan, gathered: &Gathered, printer: Printer) -> Result<(), SystemError> {
    for host in fleet.hosts() {
        let is_begun =
            |row: &&plan::Row| row.host == host && matches!(row.action, Action::Start | Action::Restart);
        let begun = plan.rows.iter().filter(is_begun);
        let orders: Vec<_> = begun.filter_map(|row| Some(&gathered.wanted.get(&row.node)?.order)).collect();
        if orders.is_empty() {
            continue;
        }
        let sent = fleet.send(&host, orders.into_iter(), &gathered.contents);
        let sent = sent.map_err(|why| unchanged(&[why.to_string()]))?;
        if sent.files > 0 {
            let (files, megabytes) = (sent.files, sent.bytes as f64 / 1e6);
            printer.line(&format!("{host}: {files} files sent, {megabytes:.1} MB"));
        }
    }
    Ok(())
}

/// Takes one step.
fn take(
    step: &Step,
    robot: &Robot,
    fleet: &mut Fleet,
    gathered: &Gathered,
    printer: Printer,
) -> Result<(), SystemError> {
    match step {
        Step::Stop { host, node } => {
            let note = fleet.order(host, &stop(robot, node)).map_err(failed)?;
            printer.line(&format!("{node}: stopped, {note}"));
        }
        Step::Remove { host, node } => {
            let note = fleet.order(host, &Request::Remove { node: node.clone() }).map_err(failed)?;
            let note = if note.is_empty() { note } else { format!("; {note}") };
            printer.line(&format!("{node}: removed from {host}{note}"));
        }
        Step::Start { host, node } => {
            let Some(wanted) = gathered.wanted.get(node) else { return Ok(()) };
            let note = fleet.order(host, &Request::Start(wanted.order.clone())).map_err(failed)?;
            printer.line(&format!("{node}: started on {host}, {note}"));
        }
        Step::Wait { nodes } => wait::wait(robot, fleet, nodes, printer)?,
    }
    Ok(())
}

/// Returns the request that stops a node.
pub(super) fn stop(robot: &Robot, node: &str) -> Request {
    let within_ms = u64::try_from(robot.stop_within.as_millis()).unwrap_or(u64::MAX);
    Request::Stop { node: node.to_owned(), within_ms }
}

/// Returns the plan for users.
fn text(robot: &Robot, plan: &Plan, is_wide: bool) -> String {
    let mut table = Table::new(["NODE", "HOST", "STEP", "REASON"]).whole(&["NODE", "STEP"]).wide(is_wide);
    for row in &plan.rows {
        table.row([row.node.clone(), row.host.clone(), row.action.word().to_owned(), row.why.clone()]);
    }
    let hosts = match robot.hosts.len() {
        1 => "one host".to_owned(),
        count => format!("{count} hosts"),
    };
    let done = if plan.is_done() { "; nothing has to be started" } else { "" };
    format!("plan of {}, {hosts}{done}:\n{}", robot.name, table.text())
}

fn rows_json(plan: &Plan) -> Vec<Value> {
    let row = |row: &plan::Row| json!({ "node": row.node, "host": row.host, "step": row.action.word(), "reason": row.why });
    plan.rows.iter().map(row).collect()
}
