//! `sinew down`: ends all nodes, and removes everything that `sinew up` has made.

use serde_json::json;

use super::{
    fleet::Fleet,
    plan,
    protocol::Request,
    robot::Robot,
    run::{Printer, stop},
    session::{Access, HostError},
};
use crate::{Report, system::SystemError};

/// Ends the nodes of all hosts that can be reached, in the reverse order of their start. Others are named.
pub(super) fn down(robot: &Robot, printer: Printer) -> Result<Report, SystemError> {
    let (mut fleet, errors) = Fleet::enter(robot, Access::Change);
    let mut faults: Vec<String> = errors.values().map(ToString::to_string).collect();
    let mut running = Vec::new();
    for (host, seen) in fleet.observe(false) {
        match seen {
            Ok(seen) => running.extend(seen.into_iter().map(|seen| (host.clone(), seen.order.name))),
            Err(why) => faults.push(why.to_string()),
        }
    }
    let after = robot.nodes.iter().map(|(name, node)| (name.as_str(), &node.after[..])).collect();
    let order = plan::levels(&after);
    let level = |name: &str| order.iter().position(|level| level.contains(&name));
    // Nodes that the file does not have any more are first.
    running.sort_by_key(|(_, name)| (level(name).is_some(), std::cmp::Reverse(level(name))));
    let mut stopped = Vec::new();
    for (host, node) in running {
        match end(robot, &mut fleet, &host, &node) {
            Ok(note) => {
                printer.line(&format!("{node}: {note}"));
                stopped.push(json!({ "node": node, "host": host, "note": note }));
            }
            Err(why) => faults.push(why.to_string()),
        }
    }
    for host in fleet.hosts() {
        faults.extend(fleet.order(&host, &Request::Sweep).err().map(|why| why.to_string()));
    }
    let is_fine = faults.is_empty();
    let shown: String = faults.iter().map(|fault| format!("{fault}\n")).collect();
    let end = if is_fine { "nothing is left" } else { "not everything is down; run `sinew down` again" };
    let text = format!("{shown}{}: {end}\n", robot.name);
    Ok(Report { text, json: json!({ "stopped": stopped, "faults": faults, "down": is_fine }), is_fine })
}

/// Ends a node and removes its files.
fn end(robot: &Robot, fleet: &mut Fleet, host: &str, node: &str) -> Result<String, HostError> {
    let note = fleet.order(host, &stop(robot, node))?;
    let left = fleet.order(host, &Request::Remove { node: node.to_owned() })?;
    Ok(if left.is_empty() { note } else { format!("{note}; {left}") })
}
