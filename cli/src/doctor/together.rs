//! Checks whether nodes that share a host stay connected when its network fails.

use std::{
    collections::BTreeMap,
    net::{IpAddr, SocketAddr},
};

use sinew::{config::Interface, inspect::NodeReport};

use super::Check;

const NAME: &str = "one host";
/// The name of the loopback interface.
const LOOPBACK: &str = if cfg!(target_os = "macos") { "lo0" } else { "lo" };

/// Returns one check for each host with several nodes on its network.
pub(super) fn checks(nodes: &[NodeReport]) -> Vec<Check> {
    let mut hosts = BTreeMap::<IpAddr, Vec<&NodeReport>>::new();
    for node in nodes {
        if let Some(ip) = node.udp.as_ref().and_then(|udp| shared_ip(udp)) {
            hosts.entry(ip).or_default().push(node);
        }
    }
    hosts.into_iter().filter(|(_, nodes)| nodes.len() > 1).map(|(ip, nodes)| check(ip, &nodes)).collect()
}

/// Returns an address that belongs to one host alone: nodes with the same one share that host. Nodes on loopback need
/// no network.
fn shared_ip(udp: &str) -> Option<IpAddr> {
    let ip = udp.parse::<SocketAddr>().ok()?.ip();
    let is_link_local = matches!(ip, IpAddr::V6(ip) if ip.is_unicast_link_local());
    (!ip.is_loopback() && !is_link_local).then_some(ip)
}

fn check(ip: IpAddr, nodes: &[&NodeReport]) -> Check {
    let words =
        |nodes: &[&NodeReport]| nodes.iter().map(|node| node.name.as_str()).collect::<Vec<_>>().join(", ");
    let lack: Vec<_> = nodes.iter().copied().filter(|node| !has_loopback(node)).collect();
    if lack.is_empty() {
        return Check::fine(
            NAME,
            format!("keep each other also without a network at {ip}: {}", words(nodes)),
        );
    }
    let detail = format!(
        "share the host at {ip}, and lose each other when it loses that address, as they have no loopback beside it: {}",
        words(&lack)
    );
    let lines: Vec<_> = lack.iter().map(|node| format!("{} has {}", node.name, line(node))).collect();
    let fix = format!(
        "below [ndl] in each one's configuration loopback behind the interfaces that it has, so that {}; then start them again",
        lines.join(", ")
    );
    Check::finding(NAME, detail, fix)
}

fn has_loopback(node: &NodeReport) -> bool {
    let mut chosen = node.interface.split(", ");
    chosen.any(|choice| choice.parse().is_ok_and(|choice: Interface| choice.is_loopback()))
}

fn line(node: &NodeReport) -> String {
    let chosen: Vec<_> =
        node.interface.split(", ").chain([LOOPBACK]).map(|choice| format!("\"{choice}\"")).collect();
    format!("interface = [{}]", chosen.join(", "))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::security::tests::node_report;

    fn node(name: &str, udp: &str, interface: &str) -> NodeReport {
        let (udp, interface) = (Some(udp.to_owned()), interface.to_owned());
        NodeReport { udp, interface, ..node_report(name, 1, None) }
    }

    #[test]
    fn missing_loopback_beside_a_network_is_a_finding() {
        let nodes = [
            node("hip", "192.168.1.7:6911", "wlan0, eth0/ipv4"),
            node("knee", "192.168.1.7:6912", "wlan0, lo"),
            node("ankle", "192.168.1.8:6911", "wlan0"),
        ];
        let [found] = &checks(&nodes)[..] else { panic!("of the host that has two") };
        assert!(found.detail.contains("192.168.1.7") && found.detail.ends_with(": hip"), "{}", found.detail);
        let fix = found.fix.as_ref().expect("a finding");
        assert!(fix.contains(r#"interface = ["wlan0", "eth0/ipv4", "lo"]"#), "{fix}");
        assert!(!fix.contains("knee"), "{fix}");
    }

    #[test]
    fn nodes_with_loopback_or_without_neighbours_are_fine() {
        let with = ["hip", "knee"].map(|name| node(name, "192.168.1.7:6911", "192.168.1.7, lo"));
        let [fine] = &checks(&with)[..] else { panic!("one host") };
        assert!(fine.fix.is_none() && fine.detail.ends_with(": hip, knee"), "{}", fine.detail);
        let on_loopback = ["hip", "knee"].map(|name| node(name, "127.0.0.1:6911", "127.0.0.1"));
        let of_a_link = ["hip", "knee"].map(|name| node(name, "[fe80::1%2]:6911", "eth0/ipv6"));
        for nodes in [&with[..1], &on_loopback, &of_a_link] {
            assert!(checks(nodes).is_empty());
        }
    }
}
