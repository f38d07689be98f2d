//! The plan of a start: from the wanted nodes and the observed ones to the steps between them. Pure.

#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, BTreeSet};

use super::order::NodeOrder;

/// A node that has to run.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Wanted {
    pub(super) host: String,
    pub(super) order: NodeOrder,
    /// Nodes that have to be ready before.
    pub(super) after: Vec<String>,
}

/// A node with files on a host.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Observed {
    pub(super) host: String,
    pub(super) order: NodeOrder,
    pub(super) is_running: bool,
}

/// The plan.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Plan {
    /// One for each node and host, in the order of their names.
    pub(super) rows: Vec<Row>,
    /// The steps, in their order.
    pub(super) steps: Vec<Step>,
}

/// The fate of a node.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Row {
    pub(super) node: String,
    pub(super) host: String,
    pub(super) action: Action,
    pub(super) why: String,
}

/// The action for a node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Action {
    /// It runs as wanted.
    Keep,
    /// It does not run.
    Start,
    /// It runs in another way.
    Restart,
    /// It is not wanted here.
    Remove,
}

impl Action {
    /// Returns its name.
    pub(super) const fn word(self) -> &'static str {
        match self {
            Self::Keep => "keep",
            Self::Start => "start",
            Self::Restart => "restart",
            Self::Remove => "remove",
        }
    }
}

/// A step.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Step {
    /// Ends a node, and waits for its end.
    Stop { host: String, node: String },
    /// Removes the files of a node.
    Remove { host: String, node: String },
    /// Waits until these nodes are ready.
    Wait { nodes: Vec<String> },
    /// Starts a node.
    Start { host: String, node: String },
}

/// Returns the plan to get from the observed nodes to the wanted ones. The wanted ones have no circle.
///
/// Nodes that are not wanted end first. Then the others follow level by level: a node's level is higher than those of
/// the nodes in its `after`. At the end all have to be ready.
pub(super) fn plan(wanted: &BTreeMap<String, Wanted>, observed: &[Observed]) -> Plan {
    let mut plan = Plan { rows: Vec::new(), steps: Vec::new() };
    let is_wanted = |seen: &Observed| wanted.get(&seen.order.name).is_some_and(|node| node.host == seen.host);
    for Observed { host, order, is_running } in observed.iter().filter(|seen| !is_wanted(seen)) {
        let (host, node) = (host.clone(), order.name.clone());
        let why = wanted.get(&node).map_or_else(
            || "the robot file has no such node".to_owned(),
            |other| format!("it belongs to host {}", other.host),
        );
        if *is_running {
            plan.steps.push(Step::Stop { host: host.clone(), node: node.clone() });
        }
        plan.steps.push(Step::Remove { host: host.clone(), node: node.clone() });
        plan.rows.push(Row { node, host, action: Action::Remove, why });
    }
    let decided: BTreeMap<&str, (Action, String)> = wanted
        .iter()
        .map(|(name, node)| {
            let seen = observed.iter().find(|seen| seen.host == node.host && seen.order.name == *name);
            (name.as_str(), decide(node, seen))
        })
        .collect();
    plan.rows.extend(wanted.iter().map(|(name, node)| {
        let (action, why) = decided[name.as_str()].clone();
        Row { node: name.clone(), host: node.host.clone(), action, why }
    }));
    plan.rows.sort_by(|one, next| (&one.node, &one.host).cmp(&(&next.node, &next.host)));
    let after = wanted.iter().map(|(name, node)| (name.as_str(), &node.after[..])).collect();
    for level in levels(&after) {
        let begun =
            || level.iter().filter(|name| matches!(decided[**name].0, Action::Start | Action::Restart));
        let before: BTreeSet<&String> = begun().flat_map(|name| &wanted[*name].after).collect();
        if !before.is_empty() {
            plan.steps.push(Step::Wait { nodes: before.into_iter().cloned().collect() });
        }
        let place = |name: &str| (wanted[name].host.clone(), name.to_owned());
        for name in begun().filter(|name| decided[**name].0 == Action::Restart) {
            let (host, node) = place(name);
            plan.steps.push(Step::Stop { host, node });
        }
        for name in begun() {
            let (host, node) = place(name);
            plan.steps.push(Step::Start { host, node });
        }
    }
    plan.steps.push(Step::Wait { nodes: wanted.keys().cloned().collect() });
    plan
}

/// Returns the action for a wanted node, and its reason.
fn decide(wanted: &Wanted, seen: Option<&Observed>) -> (Action, String) {
    let Some(seen) = seen.filter(|seen| seen.is_running) else {
        let why = if seen.is_some() { "it has ended" } else { "it does not run" };
        return (Action::Start, why.to_owned());
    };
    let changes = seen.order.changes(&wanted.order);
    match &changes[..] {
        [] => (Action::Keep, "nothing changed".to_owned()),
        [one] => (Action::Restart, format!("{one} changed")),
        [first, ..] => {
            let rest = changes.len() - 1;
            let more = if rest == 1 { changes[1].clone() } else { format!("{rest} other parts") };
            (Action::Restart, format!("{first} and {more} changed"))
        }
    }
}

/// Returns the names of nodes level by level. Each node is given with those that come before it.
pub(super) fn levels<'n>(after: &BTreeMap<&'n str, &[String]>) -> Vec<Vec<&'n str>> {
    let (mut done, mut levels): (BTreeSet<&str>, Vec<Vec<&str>>) = (BTreeSet::new(), Vec::new());
    while done.len() < after.len() {
        let is_free = |before: &[String]| before.iter().all(|other| done.contains(other.as_str()));
        let left = || after.iter().filter(|(name, _)| !done.contains(*name));
        let mut level: Vec<_> = left().filter(|(_, before)| is_free(before)).map(|(name, _)| *name).collect();
        if level.is_empty() {
            // A circle, which the check of the file refuses.
            level = left().map(|(name, _)| *name).collect();
        }
        done.extend(&level);
        levels.push(level);
    }
    levels
}

impl Plan {
    /// Returns whether all nodes run as wanted already.
    pub(super) fn is_done(&self) -> bool {
        self.rows.iter().all(|row| row.action == Action::Keep)
    }
}
