//! Checks whether the nodes of the system are open to others, and when their certificates end.

use sinew::{config::Interface, inspect::NodeReport};

use super::Check;
use crate::{
    security::{CertificateState, at, certificate, days_left},
    table::quoted,
};

const NAME: &str = "security";

/// Returns one check per group of nodes with the same state, the worst first; also one for nodes with multicast DNS
/// that bypasses their keys.
pub(super) fn checks(nodes: &[NodeReport]) -> Vec<Check> {
    let mut state: Vec<_> = nodes.iter().map(|node| (CertificateState::of(node), node)).collect();
    state.sort_by_key(|(state, node)| (*state, node.node));
    state
        .chunk_by(|one, other| one.0 == other.0)
        .map(|alike| {
            let nodes: Vec<_> = alike.iter().map(|(_, node)| *node).collect();
            check(alike[0].0, &nodes)
        })
        .chain(unsealed(nodes))
        .collect()
}

/// Reports nodes with keys that use multicast DNS on a network, which is not sealed.
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
    let detail = format!(
        "multicast DNS is on, which keys do not protect: any host on their network can have these nodes ask addresses of its choice, and fill \
         their memory: {}",
        on.join(", ")
    );
    let fix = "below [ndl] in each one's configuration: mdns_port = false; then start them again. They find each other by `multicast`, or by `seeds`: \
                set one of these first where mDNS is their only way (`sinew nodes` shows by what they were found)";
    Some(Check::finding("mdns", detail, fix))
}

/// Returns the check of these nodes, of which there is at least one.
fn check(state: CertificateState, nodes: &[&NodeReport]) -> Check {
    let names = nodes.iter().map(|node| node.name.as_str()).collect::<Vec<_>>().join(", ");
    let ends = nodes.iter().map(|node| ends(node)).collect::<Vec<_>>().join(", ");
    let project = &nodes[0].project;
    match state {
        CertificateState::Open => Check::finding(
            NAME,
            format!(
                "OPEN to all users of their network: each can send to their applications, and pose as any node: {names}"
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
        CertificateState::Revoked => Check::finding(
            NAME,
            format!(
                "certificates are revoked, by the deny list that these nodes have themselves; no node with that list takes them: {names}"
            ),
            renewal(nodes),
        ),
        CertificateState::Ended => Check::finding(
            NAME,
            format!("certificates have ended, no other node takes them: {ends}"),
            renewal(nodes),
        ),
        CertificateState::EndsSoon => Check::finding(
            NAME,
            format!("certificates end within 30 days, and then no other node takes them: {ends}"),
            renewal(nodes),
        ),
        CertificateState::ClockNotSet => Check::finding(
            NAME,
            format!(
                "clocks are not set, so that these nodes cannot tell which certificates have ended: {ends}"
            ),
            "on each of these machines: sudo timedatectl set-ntp true, or sudo date -s '2026-01-31 12:00'",
        ),
        CertificateState::Unknown => Check::finding(
            NAME,
            format!("unknown, of a version that does not say whether it is open: {names}"),
            "update Sinew there; until then look for security.keys in its configuration",
        ),
        CertificateState::Alone => {
            let detail = "open to every user of this host: each can start a node and join, send to their applications, and pose as any \
                        node (no other host reaches them); `sinew keys init` closes that";
            Check::fine(NAME, format!("{detail}: {names}"))
        }
        CertificateState::NotLookedAt => Check::fine(
            NAME,
            format!("keys of project {project}; times are not checked there (security.times): {ends}"),
        ),
        CertificateState::Secured => Check::fine(NAME, format!("keys of project {project}: {ends}")),
    }
}

/// Returns the certificate's end, and its state by the node's own clock.
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
        tests::{NOW_S, node_report, open, secured},
    };

    #[test]
    fn open_nodes_are_one_finding_with_one_command() {
        let nodes = [
            node_report("knee", 2, open(true)),
            node_report("my hip", 1, open(true)),
            node_report("desk", 3, open(false)),
        ];
        let [found, fine] = &checks(&nodes)[..] else { panic!("those that others reach, and the other") };
        assert!(
            found.detail.starts_with("OPEN") && found.detail.ends_with(": my hip, knee"),
            "{}",
            found.detail
        );
        let fix = found.fix.as_ref().expect("a finding");
        let command = "sinew keys init walker 'my hip'=192.168.0.1 knee=192.168.0.2; ";
        assert!(fix.starts_with(command) && fix.contains("security.keys"), "{fix}");
        assert!(fine.fix.is_none() && fine.detail.ends_with(": desk"), "{}", fine.detail);
        assert!(fine.detail.starts_with("open to every user of this host"), "{}", fine.detail);
        assert!(fine.detail.contains("`sinew keys init` closes that"), "{}", fine.detail);
    }

    #[test]
    fn multicast_dns_beside_keys_is_a_network_finding() {
        let node = |name: &str, interface: &str, is_on: bool, security| {
            let source = SourceReport { source: "mdns".to_owned(), is_on, places: 0, found: 0 };
            let interface = interface.to_owned();
            NodeReport { interface, sources: vec![source], ..node_report(name, 1, security) }
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
        assert!(found.detail.ends_with(": hip"), "{}", found.detail);
        assert!(
            found.fix.as_ref().is_some_and(|fix| fix.contains("[ndl]") && fix.contains("mdns_port = false"))
        );
        assert!(super::checks(&nodes[1..3]).iter().all(|check| check.fix.is_none()));
    }

    #[test]
    fn expiry_is_judged_by_the_clock_of_the_node() {
        let until_s = NOW_S + 365 * 86_400;
        let one = |clock_s, times| {
            let mut checks = checks(&[node_report("hip", 1, secured(clock_s, times))]);
            checks.pop().expect("one")
        };
        let soon = one(until_s - SOON_S + 1, "until-set");
        assert!(soon.detail.contains("(29 days)"), "{}", soon.detail);
        assert!(soon.fix.is_some_and(|fix| fix.contains("sinew keys issue hip --keys DIR")));
        assert!(one(until_s + 1, "until-set").fix.is_some_and(|fix| fix.contains("sinew keys issue hip")));
        let not_set = one(7, "until-set");
        assert!(not_set.detail.contains("its clock says 1970-01-01T00:00:07Z"), "{}", not_set.detail);
        assert!(not_set.fix.is_some_and(|fix| fix.contains("timedatectl")));
        assert!(one(NOW_S, "strict").fix.is_none());
        assert!(one(until_s + 1, "ignored").fix.is_none());
    }

    #[test]
    fn older_version_is_unknown() {
        let unknown = checks(&[node_report("hip", 1, None)]).pop().expect("one");
        assert!(unknown.detail.starts_with("unknown") && unknown.fix.is_some(), "{}", unknown.detail);
        assert!(checks(&[]).is_empty());
    }
}
