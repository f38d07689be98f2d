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
    NodeAddress,
    config::{Interface, Interfaces},
    inspect::{AskNode, NodeReport},
};

use crate::{
    Report,
    arguments::Arguments,
    system::{Answer, Fault, System},
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
pub(crate) fn show(chosen: Vec<Interface>, arguments: &Arguments) -> Report {
    let (socket, within) = (arguments.socket.as_deref(), arguments.within());
    let interfaces = network::found();
    let chosen = Some(chosen).filter(|chosen| !chosen.is_empty()).map(Interfaces::from);
    let Nodes { said: nodes, silent } = Nodes::asked(socket, within);
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
        rights::own_processes(),
        sockets::directory(),
        sockets::leftover(),
        sockets::node(socket),
    ]);
    checks.extend(silent);
    checks.extend(security::checks(&nodes));
    checks.extend(reach::checks(&nodes, &interfaces));
    checks.extend(together::checks(&nodes));
    let is_fine = checks.iter().all(|check| check.mend.is_none());
    let json = json!({ "checks": checks.iter().map(check_json).collect::<Vec<_>>() });
    let mut table = Table::new(["CHECK", "STATUS", "DETAIL"]).wide(arguments.wide);
    for check in &checks {
        let state = if check.mend.is_none() { "fine" } else { "FINDING" };
        table.row([check.name.to_owned(), state.to_owned(), check.seen.clone()]);
    }
    let mends = checks.iter().filter_map(|check| Some((check.name, check.mend.as_ref()?)));
    let mends: String = mends.map(|(name, mend)| format!("{name}: {}\n", clean(mend))).collect();
    let text = if is_fine { table.text() } else { format!("{}\nSuggested fix\n{mends}", table.text()) };
    Report { text, json, is_fine }
}

/// What the nodes of a system say of themselves.
#[derive(Default)]
struct Nodes {
    /// First of all the one that lets us in; nothing where none does.
    said: Vec<NodeReport>,
    /// One for each that has not answered: the checks of the others say nothing of it.
    silent: Vec<Check>,
}

impl Nodes {
    /// Asks the node that lets us in, and every other one of its system.
    fn asked(socket: Option<&Path>, within: Duration) -> Self {
        let mut system = match System::enter(socket, within) {
            Ok(system) => system,
            // A check of its own says that.
            Err(Fault::NoDoor(_)) => return Self::default(),
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

    /// Where the one that is to let us in does not answer.
    fn none(why: &Fault) -> Self {
        let mend = "is it stopped, or its host overloaded? `sinew ping` it, its log says more; or take another one: --socket PATH";
        Self { said: Vec::new(), silent: vec![Check::finding(SILENT, why.to_string(), mend)] }
    }

    fn of(here: NodeReport, answers: Vec<Answer<NodeReport>>) -> Self {
        let here_node = here.node;
        let (mut said, mut silent) = (vec![here], Vec::new());
        let others = answers.into_iter().filter(|answer| answer.node != here_node);
        for Answer { node, name, said: answer } in others {
            match answer {
                Ok(other) => said.push(other),
                Err(why) => silent.push(silence(here_node, node, &name, &why)),
            }
        }
        Self { said, silent }
    }
}

const SILENT: &str = "silent node";

/// That a node has not answered.
fn silence(here: NodeAddress, node: NodeAddress, name: &str, why: &str) -> Check {
    let who = if name.is_empty() { node.to_string() } else { format!("{name} at {node}") };
    let seen = format!("nothing is known of the keys and the network of {who}: {why}");
    Check::finding(
        SILENT,
        seen,
        format!("`sinew why {here} {node}` says what stands there; then `sinew doctor` again"),
    )
}

/// The interfaces at which this node of this machine looks for others.
fn of_node(node: &NodeReport) -> Option<Interfaces> {
    let chosen: Vec<_> = node.interface.split(", ").filter_map(|one| one.parse().ok()).collect();
    (!chosen.is_empty()).then(|| chosen.into())
}

fn check_json(check: &Check) -> Value {
    json!({ "check": check.name, "fine": check.mend.is_none(), "seen": check.seen, "mend": check.mend })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::security::tests::said;

    fn answer(name: &str, last: u8, fault: Option<&str>) -> Answer<NodeReport> {
        let report = said(name, last, None);
        let (node, name) = (report.node, name.to_owned());
        Answer { node, name, said: fault.map_or(Ok(report), |why| Err(why.to_owned())) }
    }

    #[test]
    fn a_node_that_has_not_answered_is_a_finding_with_its_name_and_why() {
        let answers = vec![
            answer("hip", 1, None),
            answer("knee", 2, Some("no answer within 2s")),
            answer("ankle", 3, None),
        ];
        let nodes = Nodes::of(said("hip", 1, None), answers);
        let names: Vec<_> = nodes.said.iter().map(|said| said.name.as_str()).collect();
        assert_eq!(names, ["hip", "ankle"], "the one that lets us in is first, and once");
        let [silent] = &nodes.silent[..] else { panic!("one has not answered") };
        let end = "of knee at 192.168.0.2: no answer within 2s";
        assert!(silent.seen.ends_with(end), "{}", silent.seen);
        let mend = silent.mend.as_ref().expect("a finding");
        assert!(mend.starts_with("`sinew why 192.168.0.1 192.168.0.2`"), "{mend}");
    }

    #[test]
    fn the_node_that_lets_us_in_and_does_not_answer_is_a_finding() {
        let why = Fault::NoAnswer("/run/hip.sock".to_owned(), "no answer within 2s".to_owned());
        let nodes = Nodes::none(&why);
        let [silent] = &nodes.silent[..] else { panic!("it has not answered") };
        assert!(nodes.said.is_empty() && silent.mend.is_some());
        assert_eq!(silent.seen, "the node at /run/hip.sock: no answer within 2s");
    }
}
