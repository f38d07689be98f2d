//! `sinew doctor`: checks whether this machine meets the needs of a node, and whether its nodes are closed to others.
//! It also checks whether other hosts can reach them, and whether those of one host stay connected without a network.
//! Each finding has the command that fixes it.
//!
//! Every check tests the real operation if possible, and undoes it. `sinew doctor --rt` measures how late threads wake.

mod clock;
mod network;
mod reach;
mod real_time;
mod rights;
mod security;
mod sockets;
mod together;

use std::{net::Ipv4Addr, path::Path, time::Duration};

use serde_json::{Value, json};
use sinew::{
    NodeAddress,
    config::{Interface, Interfaces},
    inspect::{AskNode, NodeReport},
    real_time::HostRights,
};

pub(crate) use self::real_time::show as show_real_time;
use crate::{
    Report,
    arguments::Arguments,
    system::{Answer, System, SystemError},
    table::{Table, clean_lines},
};

/// The result of a check.
struct Check {
    name: &'static str,
    /// The finding, as text.
    detail: String,
    /// The suggested fix; `None` if nothing is wrong.
    fix: Option<String>,
}

impl Check {
    const fn fine(name: &'static str, detail: String) -> Self {
        Self { name, detail, fix: None }
    }

    const fn status(&self) -> &'static str {
        if self.fix.is_none() { "fine" } else { "FINDING" }
    }

    fn finding(name: &'static str, detail: String, fix: impl Into<String>) -> Self {
        Self { name, detail, fix: Some(fix.into()) }
    }
}

/// Runs all checks; the multicast check uses these interfaces, or by default those of the node that accepts this
/// command.
pub(crate) fn show(chosen: Vec<Interface>, arguments: &Arguments) -> Report {
    let (socket, within) = (arguments.socket.as_deref(), arguments.within());
    let interfaces = network::found();
    let chosen = Some(chosen).filter(|chosen| !chosen.is_empty()).map(Interfaces::from);
    let Nodes { reports: nodes, silent } = Nodes::asked(socket, within);
    let chosen = chosen.or_else(|| of_node(nodes.first()?)).unwrap_or_else(|| Ipv4Addr::LOCALHOST.into());
    let host = HostRights::read(Path::new("/"));
    let mut checks = vec![network::interfaces(&interfaces)];
    checks.extend(network::multicast(&chosen, &interfaces));
    checks.extend([
        rights::open_files(),
        rights::locked_memory(&host),
        rights::real_time(&host),
        rights::governor(&host),
        clock::clock(),
        rights::shared_memory(),
        rights::own_processes(),
        sockets::directory(!nodes.is_empty() || !silent.is_empty()),
        sockets::leftover(),
        sockets::node(socket),
    ]);
    checks.extend(silent);
    checks.extend(security::checks(&nodes));
    checks.extend(reach::checks(&nodes, &interfaces));
    checks.extend(together::checks(&nodes));
    summary(&checks, arguments.wide)
}

/// Returns the report of these checks: a table, and the suggested fixes.
fn summary(checks: &[Check], is_wide: bool) -> Report {
    let is_fine = checks.iter().all(|check| check.fix.is_none());
    let json = json!({ "checks": checks.iter().map(check_json).collect::<Vec<_>>() });
    let table = table(checks, is_wide);
    let fixes = checks.iter().filter_map(|check| Some((check.name, check.fix.as_ref()?)));
    let fixes: String = fixes.map(|(name, fix)| format!("{name}: {}\n", clean_lines(fix))).collect();
    let text = if is_fine { table } else { format!("{table}\nSuggested fix\n{fixes}") };
    Report { text, json, is_fine }
}

fn table(checks: &[Check], is_wide: bool) -> String {
    let mut table = Table::new(["CHECK", "STATUS", "DETAIL"]).whole(&["CHECK", "STATUS"]).wide(is_wide);
    for check in checks {
        table.row([check.name.to_owned(), check.status().to_owned(), check.detail.clone()]);
    }
    table.text()
}

/// The reports of the nodes of a system.
#[derive(Default)]
struct Nodes {
    /// The node that accepts this command is first; empty if there is none.
    reports: Vec<NodeReport>,
    /// One check for each node without an answer: the other checks do not cover it.
    silent: Vec<Check>,
}

impl Nodes {
    /// Asks the node that accepts this command, and every other node of its system.
    fn asked(socket: Option<&Path>, within: Duration) -> Self {
        let mut system = match System::enter(socket, within) {
            Ok(system) => system,
            // A separate check reports that.
            Err(SystemError::NoSocket(_)) => return Self::default(),
            Err(why) => return Self::none(&why),
        };
        let nodes = match system.here() {
            Ok(here) => {
                let answers = system.ask_all::<AskNode, NodeReport>(&here);
                Self::of(here, answers)
            }
            Err(why) => Self::none(&why),
        };
        system.leave();
        nodes
    }

    /// Returns the result if the node at the socket does not answer.
    fn none(why: &SystemError) -> Self {
        let fix = "is it stopped, or its host overloaded? `sinew ping` it, its log says more; or take another one: --socket PATH";
        Self { reports: Vec::new(), silent: vec![Check::finding(SILENT, why.to_string(), fix)] }
    }

    fn of(here: NodeReport, answers: Vec<Answer<NodeReport>>) -> Self {
        let here_node = here.node;
        let (mut reports, mut silent) = (vec![here], Vec::new());
        let others = answers.into_iter().filter(|answer| answer.node != here_node);
        for Answer { node, name, result: answer } in others {
            match answer {
                Ok(other) => reports.push(other),
                Err(why) => silent.push(silence(here_node, node, &name, &why)),
            }
        }
        Self { reports, silent }
    }
}

const SILENT: &str = "silent node";

/// Returns the check of a node that has not answered.
fn silence(here: NodeAddress, node: NodeAddress, name: &str, why: &str) -> Check {
    let node_label = if name.is_empty() { node.to_string() } else { format!("{name} at {node}") };
    let detail = format!("the keys and the network are not known of {node_label}: {why}");
    Check::finding(
        SILENT,
        detail,
        format!("`sinew why {here} {node}` looks for the reason; then `sinew doctor` again"),
    )
}

/// Returns the interfaces on which this node of this machine discovers others.
fn of_node(node: &NodeReport) -> Option<Interfaces> {
    let chosen: Vec<_> = node.interface.split(", ").filter_map(|one| one.parse().ok()).collect();
    (!chosen.is_empty()).then(|| chosen.into())
}

fn check_json(check: &Check) -> Value {
    let Check { name, detail, fix } = check;
    let status = check.status().to_lowercase();
    json!({ "check": name, "status": status, "fine": fix.is_none(), "detail": detail, "suggested_fix": fix })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        security::tests::node_report,
        table::{WIDTH, tests::widest},
    };

    fn answer(name: &str, last: u8, fault: Option<&str>) -> Answer<NodeReport> {
        let report = node_report(name, last, None);
        let (node, name) = (report.node, name.to_owned());
        Answer { node, name, result: fault.map_or(Ok(report), |why| Err(why.to_owned())) }
    }

    #[test]
    fn table_fits_a_terminal_for_any_finding() {
        let checks = [Check::finding("real-time rights", "nodes ".repeat(100) + &"k".repeat(300), "no fix")];
        assert!(widest(&table(&checks, false)) <= WIDTH, "{}", table(&checks, false));
    }

    #[test]
    fn silent_node_is_a_finding_with_name_and_reason() {
        let answers = vec![
            answer("hip", 1, None),
            answer("knee", 2, Some("no answer within 2s")),
            answer("ankle", 3, None),
        ];
        let nodes = Nodes::of(node_report("hip", 1, None), answers);
        let names: Vec<_> = nodes.reports.iter().map(|report| report.name.as_str()).collect();
        assert_eq!(names, ["hip", "ankle"], "the one that was asked first comes first, and once");
        let [silent] = &nodes.silent[..] else { panic!("one has not answered") };
        let end = "of knee at 192.168.0.2: no answer within 2s";
        assert!(silent.detail.ends_with(end), "{}", silent.detail);
        let fix = silent.fix.as_ref().expect("a finding");
        assert!(fix.starts_with("`sinew why 192.168.0.1 192.168.0.2`"), "{fix}");
    }

    #[test]
    fn silent_node_at_the_socket_is_a_finding() {
        let why = SystemError::NoAnswer("/run/hip.sock".to_owned(), "no answer within 2s".to_owned());
        let nodes = Nodes::none(&why);
        let [silent] = &nodes.silent[..] else { panic!("it has not answered") };
        assert!(nodes.reports.is_empty() && silent.fix.is_some());
        assert_eq!(silent.detail, "the node at /run/hip.sock: no answer within 2s");
    }
}
