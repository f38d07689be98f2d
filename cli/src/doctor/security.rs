//! Whether the nodes of the system that lets us in are open to others, and when their certificates end.

use sinew::{config::Interface, inspect::NodeReport};

use super::Check;
use crate::{
    security::{Standing, at, certificate, days_left},
    table::quoted,
};

const NAME: &str = "security";

/// One check for all nodes that stand alike, the worst first, and one more for those whose multicast DNS goes past their keys.
pub(super) fn checks(nodes: &[NodeReport]) -> Vec<Check> {
    let mut standing: Vec<_> = nodes.iter().map(|node| (Standing::of(node), node)).collect();
    standing.sort_by_key(|(standing, node)| (*standing, node.node));
    standing
        .chunk_by(|one, other| one.0 == other.0)
        .map(|alike| {
            let nodes: Vec<_> = alike.iter().map(|(_, node)| *node).collect();
            check(alike[0].0, &nodes)
        })
        .chain(unsealed(nodes))
        .collect()
}

/// Nodes with keys that speak multicast DNS on a network, which has no seals.
fn unsealed(nodes: &[NodeReport]) -> Option<Check> {
    let is_on = |node: &NodeReport| {
        let mut chosen = node.interface.split(", ");
        certificate(node).is_some()
            && node.sources.iter().any(|source| source.source == "mdns" && source.is_on)
            && chosen.any(|choice| choice.parse().is_ok_and(|choice: Interface| !choice.is_loopback()))
    };
    let on: Vec<_> = nodes.iter().filter(|node| is_on(node)).map(|node| node.name.as_str()).collect();
    if on.is_empty() {
        return None;
    }
    let seen = format!(
        "multicast DNS is on, to which keys are nothing: whoever is on their network can have these nodes ask addresses of his choice, and fill \
         their memory: {}",
        on.join(", ")
    );
    let mend = "below [ndl] in each one's configuration: mdns_port = false; then start them again. They find each other by `multicast`, or by `seeds`: \
                set one of these first where mDNS is their only way (`sinew nodes` shows by what they were found)";
    Some(Check::finding("mdns", seen, mend))
}

/// What is so of these nodes, of which there is one at least.
fn check(standing: Standing, nodes: &[&NodeReport]) -> Check {
    let who = nodes.iter().map(|node| node.name.as_str()).collect::<Vec<_>>().join(", ");
    let ends = nodes.iter().map(|node| ends(node)).collect::<Vec<_>>().join(", ");
    let project = &nodes[0].project;
    match standing {
        Standing::Open => Check::finding(
            NAME,
            format!(
                "OPEN to everybody on their network, who can send to their applications, and pose as any node: {who}"
            ),
            format!(
                "sinew keys init {} {}; then copy each node's directory, set security.keys on all nodes as it says, and start them again",
                quoted(project),
                nodes
                    .iter()
                    .map(|node| format!("{}={}", quoted(&node.name), node.node))
                    .collect::<Vec<_>>()
                    .join(" ")
            ),
        ),
        Standing::Revoked => Check::finding(
            NAME,
            format!(
                "certificates are revoked, by the deny list that these nodes have themselves; no node with that list takes them: {who}"
            ),
            renewal(nodes),
        ),
        Standing::Ended => Check::finding(
            NAME,
            format!("certificates have ended, no other node takes them: {ends}"),
            renewal(nodes),
        ),
        Standing::EndsSoon => Check::finding(
            NAME,
            format!("certificates end within 30 days, and then no other node takes them: {ends}"),
            renewal(nodes),
        ),
        Standing::ClockNotSet => Check::finding(
            NAME,
            format!("clocks are not set, so that nobody there knows which certificates have ended: {ends}"),
            "on each of these machines: sudo timedatectl set-ntp true, or sudo date -s '2026-01-31 12:00'",
        ),
        Standing::Unknown => Check::finding(
            NAME,
            format!("unknown, of a version that does not say whether it is open: {who}"),
            "update Sinew there; until then look for security.keys in its configuration",
        ),
        Standing::Alone => {
            let seen = "open to every user of this host, who can start a node of his own and join, send to their applications, and pose as any \
                        node (no other host reaches them); `sinew keys init` closes that";
            Check::fine(NAME, format!("{seen}: {who}"))
        }
        Standing::NotLookedAt => Check::fine(
            NAME,
            format!("keys of project {project}; times are not looked at there (security.times): {ends}"),
        ),
        Standing::Secured => Check::fine(NAME, format!("keys of project {project}: {ends}")),
    }
}

/// The certificate's end, and what the node's own clock makes of it.
fn ends(node: &NodeReport) -> String {
    let Some(certificate) = certificate(node) else { return node.name.clone() };
    let until = at(certificate.until_s);
    match days_left(certificate) {
        Some(days) => format!("{} until {until} ({days} days)", node.name),
        None => format!("{} until {until} (its clock says {})", node.name, at(certificate.clock_s)),
    }
}

fn renewal(nodes: &[&NodeReport]) -> String {
    let names = nodes.iter().map(|node| quoted(&node.name)).collect::<Vec<_>>().join(" ");
    format!(
        "where the project's ca.key is: sinew keys issue {names} --keys DIR; then copy them as it says, and start these nodes again"
    )
}

#[cfg(test)]
mod tests {
    use sinew::inspect::SourceReport;

    use super::*;
    use crate::security::{
        SOON_S,
        tests::{NOW_S, open, said, secured},
    };

    #[test]
    fn open_nodes_are_a_finding_with_the_command_that_closes_all_of_them() {
        let nodes =
            [said("knee", 2, open(true)), said("my hip", 1, open(true)), said("desk", 3, open(false))];
        let [found, fine] = &checks(&nodes)[..] else { panic!("those that others reach, and the other") };
        assert!(found.seen.starts_with("OPEN") && found.seen.ends_with(": my hip, knee"), "{}", found.seen);
        let mend = found.mend.as_ref().expect("a finding");
        let command = "sinew keys init walker 'my hip'=192.168.0.1 knee=192.168.0.2; ";
        assert!(mend.starts_with(command) && mend.contains("security.keys"), "{mend}");
        assert!(fine.mend.is_none() && fine.seen.ends_with(": desk"), "{}", fine.seen);
        assert!(fine.seen.starts_with("open to every user of this host"), "{}", fine.seen);
        assert!(fine.seen.contains("`sinew keys init` closes that"), "{}", fine.seen);
    }

    #[test]
    fn multicast_dns_of_a_node_with_keys_on_a_network_is_a_finding_with_the_line_that_ends_it() {
        let node = |name: &str, interface: &str, is_on: bool, security| {
            let source = SourceReport { source: "mdns".to_owned(), is_on, places: 0, found: 0 };
            let interface = interface.to_owned();
            NodeReport { interface, sources: vec![source], ..said(name, 1, security) }
        };
        let keys = || secured(NOW_S, "until-set");
        let nodes = [
            node("hip", "lo, eth0", true, keys()),
            node("knee", "192.168.0.2", false, keys()),
            node("desk", "127.0.0.1, ::1", true, keys()),
            node("spy", "eth0", true, open(true)),
            node("old", "eth0", true, None),
        ];
        let checks = checks(&nodes);
        let [found] = &checks.iter().filter(|check| check.name == "mdns").collect::<Vec<_>>()[..] else {
            panic!("one finding")
        };
        assert!(found.seen.ends_with(": hip"), "{}", found.seen);
        assert!(
            found
                .mend
                .as_ref()
                .is_some_and(|mend| mend.contains("[ndl]") && mend.contains("mdns_port = false"))
        );
        assert!(super::checks(&nodes[1..3]).iter().all(|check| check.mend.is_none()));
    }

    #[test]
    fn a_certificate_that_ends_is_a_finding_by_the_clock_of_its_node() {
        let until_s = NOW_S + 365 * 86_400;
        let one = |clock_s, times| {
            let mut checks = checks(&[said("hip", 1, secured(clock_s, times))]);
            checks.pop().expect("one")
        };
        let soon = one(until_s - SOON_S + 1, "until-set");
        assert!(soon.seen.contains("(29 days)"), "{}", soon.seen);
        assert!(soon.mend.is_some_and(|mend| mend.contains("sinew keys issue hip --keys DIR")));
        assert!(one(until_s + 1, "until-set").mend.is_some_and(|mend| mend.contains("sinew keys issue hip")));
        let not_set = one(7, "until-set");
        assert!(not_set.seen.contains("its clock says 1970-01-01T00:00:07Z"), "{}", not_set.seen);
        assert!(not_set.mend.is_some_and(|mend| mend.contains("timedatectl")));
        assert!(one(NOW_S, "strict").mend.is_none());
        assert!(one(until_s + 1, "ignored").mend.is_none());
    }

    #[test]
    fn a_node_of_an_older_version_is_unknown_and_no_node_has_no_check() {
        let unknown = checks(&[said("hip", 1, None)]).pop().expect("one");
        assert!(unknown.seen.starts_with("unknown") && unknown.mend.is_some(), "{}", unknown.seen);
        assert!(checks(&[]).is_empty());
    }
}
