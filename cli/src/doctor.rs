//! `sinew doctor`: whether this machine gives a node what it needs, whether its nodes are closed to others, whether other hosts see
//! them, and whether those of one host keep each other without a network; each finding with the command that mends it.
//!
//! Every check tries the thing itself where it can, and undoes it.

mod clock;
mod network;
mod reach;
mod rights;
mod security;
mod sockets;
mod together;

use std::{net::Ipv4Addr, path::Path, time::Duration};

use serde_json::{Value, json};
use sinew::{
    config::{Interface, Interfaces},
    inspect::{AskNode, NodeReport},
};

use crate::{
    Said,
    system::System,
    table::{Table, clean},
};

/// What was tried.
struct Check {
    name: &'static str,
    /// What is so, in words.
    seen: String,
    /// What mends it; `None` where nothing is wrong.
    mend: Option<String>,
}

impl Check {
    const fn fine(name: &'static str, seen: String) -> Self {
        Self { name, seen, mend: None }
    }

    fn finding(name: &'static str, seen: String, mend: impl Into<String>) -> Self {
        Self { name, seen, mend: Some(mend.into()) }
    }
}

/// Tries everything; multicast at these interfaces, without any where the node looks that lets us in.
pub(crate) fn show(chosen: Vec<Interface>, socket: Option<&Path>, within: Duration) -> Said {
    let interfaces = network::found();
    let chosen = Some(chosen).filter(|chosen| !chosen.is_empty()).map(Interfaces::from);
    let nodes = nodes(socket, within).unwrap_or_default();
    let chosen = chosen.or_else(|| of_node(nodes.first()?)).unwrap_or_else(|| Ipv4Addr::LOCALHOST.into());
    let mut checks = vec![network::interfaces(&interfaces)];
    checks.extend(network::multicast(&chosen, &interfaces));
    checks.extend([
        rights::open_files(),
        rights::locked_memory(),
        rights::real_time(),
        rights::governor(),
        clock::clock(),
        rights::shared_memory(),
        sockets::directory(),
        sockets::leftover(),
        sockets::node(socket),
    ]);
    checks.extend(security::checks(&nodes));
    checks.extend(reach::checks(&nodes, &interfaces));
    checks.extend(together::checks(&nodes));
    let is_fine = checks.iter().all(|check| check.mend.is_none());
    let json = json!({ "checks": checks.iter().map(check_json).collect::<Vec<_>>() });
    let mut table = Table::new(["CHECK", "", "WHAT IS SO"]);
    for check in &checks {
        let state = if check.mend.is_none() { "fine" } else { "FINDING" };
        table.row([check.name.to_owned(), state.to_owned(), check.seen.clone()]);
    }
    let mends = checks.iter().filter_map(|check| Some((check.name, check.mend.as_ref()?)));
    let mends: String = mends.map(|(name, mend)| format!("{name}: {}\n", clean(mend))).collect();
    let text = if is_fine { table.text() } else { format!("{}\nWhat mends it\n{mends}", table.text()) };
    Said { text, json, is_fine }
}

/// What the node that lets us in says, and then every other one of its system that answers; `None` where none lets us in.
fn nodes(socket: Option<&Path>, within: Duration) -> Option<Vec<NodeReport>> {
    let mut system = System::enter(socket, within).ok()?;
    let nodes = system.here().map(|here| {
        let others = system.ask_all::<AskNode, NodeReport>(&here);
        let others = others.into_iter().filter(|other| other.node != here.node);
        let others: Vec<_> = others.filter_map(|other| other.said.ok()).collect();
        std::iter::once(here).chain(others).collect()
    });
    system.leave();
    nodes.ok()
}

/// The interfaces at which this node of this machine looks for others.
fn of_node(node: &NodeReport) -> Option<Interfaces> {
    let chosen: Vec<_> = node.interface.split(", ").filter_map(|one| one.parse().ok()).collect();
    (!chosen.is_empty()).then(|| chosen.into())
}

fn check_json(check: &Check) -> Value {
    json!({ "check": check.name, "fine": check.mend.is_none(), "seen": check.seen, "mend": check.mend })
}
