//! Checks whether other hosts can reach the nodes of the system.

use std::net::IpAddr;

use sinew::inspect::NodeReport;

use super::{Check, network::Interface};
use crate::table::quoted;

const NAME: &str = "reach";

/// Returns one check for nodes on loopback by default, one for those on loopback by configuration, and one for the
/// others.
pub(super) fn checks(nodes: &[NodeReport], interfaces: &[Interface]) -> Vec<Check> {
    // If GNCL is reachable from other hosts (`gncl.further`, `gncl.announce`), no node discovers it there as long as it
    // uses loopback. An older node does not report it.
    let is_alone = |node: &&NodeReport| {
        node.is_interface_default == Some(true)
            || node.security.as_ref().is_some_and(|security| !security.is_beyond_host)
    };
    let (alone, others): (Vec<_>, Vec<_>) = nodes.iter().partition(is_alone);
    let of = |is_default: Option<bool>| {
        alone.iter().copied().filter(|node| node.is_interface_default == is_default).collect::<Vec<_>>()
    };
    let left = of(Some(true));
    let mut checks = Vec::new();
    if !left.is_empty() {
        checks.push(finding(&left, interfaces));
    }
    for (known, why) in [(Some(false), ", as configured"), (None, "")] {
        let some = of(known);
        if !some.is_empty() {
            let what = format!("on loopback only{why}: no other host sees them, and they see none");
            checks.push(Check::fine(NAME, format!("{what}: {}", in_words(&some))));
        }
    }
    if !others.is_empty() {
        checks.push(Check::fine(NAME, format!("not on loopback alone: {}", in_words(&others))));
    }
    checks
}

fn in_words(nodes: &[&NodeReport]) -> String {
    nodes.iter().map(|node| format!("{} ({})", node.name, node.interface)).collect::<Vec<_>>().join(", ")
}

fn finding(alone: &[&NodeReport], interfaces: &[Interface]) -> Check {
    let detail = format!(
        "on loopback only, as no `interface` is set: no other host sees them, and they see none: {}",
        in_words(alone)
    );
    let line = match interfaces.iter().find_map(Interface::outward) {
        Some(address) => format!("interface = \"{address}\""),
        None => {
            "interface = \"10.0.0.1\" (an address of its network; this host has none that leads to others)"
                .to_owned()
        }
    };
    let several =
        if alone.len() > 1 { ", and for each that shares a host a node.address of its own" } else { "" };
    let is_open =
        |node: &&&NodeReport| node.security.as_ref().is_some_and(|security| security.certificate.is_none());
    let open: Vec<_> = alone.iter().filter(is_open).collect();
    let keys = if open.is_empty() {
        String::new()
    } else {
        let named: Vec<_> = open.iter().map(|node| format!("{}={}", quoted(&node.name), node.node)).collect();
        format!(
            "first give them keys, or every host on that network can send to them: sinew keys init {} {}; then ",
            quoted(&open[0].project),
            named.join(" ")
        )
    };
    let fix = format!(
        "where other hosts are to reach them: {keys}below [ndl] in each one's configuration: {line}{several}; then start them again. Where they are not: interface = \"127.0.0.1\" there ends this finding"
    );
    Check::finding(NAME, detail, fix)
}

impl Interface {
    /// Returns an address at which other hosts can reach this one, IPv4 if there is one.
    fn outward(&self) -> Option<IpAddr> {
        if self.is_loopback() || self.lacks().is_some() {
            return None;
        }
        let is_of_a_link = |ip: &IpAddr| matches!(ip, IpAddr::V6(ip) if ip.is_unicast_link_local());
        let ipv4 = self.addresses.iter().find(|ip| ip.is_ipv4());
        // A link-local one needs a zone, and is not the first choice.
        ipv4.or_else(|| self.addresses.iter().find(|ip| !is_of_a_link(ip))).copied()
    }
}

#[cfg(test)]
mod tests {
    use sinew::inspect::SecurityReport;

    use super::*;
    use crate::security::tests::{NOW_S, node_report, open, secured};

    fn interface(name: &str, addresses: &[&str]) -> Interface {
        let addresses = addresses.iter().map(|ip| ip.parse().unwrap()).collect();
        // Up, with multicast.
        Interface { name: name.to_owned(), addresses, number: Some(1), flags: 0x1001, has_carrier: true }
    }

    #[test]
    fn default_loopback_is_a_finding_with_the_config_line() {
        let here = [
            interface("lo", &["127.0.0.1"]),
            interface("eth0", &["fe80::5", "10.0.0.5"]),
            interface("eth1", &["10.0.1.5"]),
        ];
        // This also holds for a node that listens elsewhere: no other host discovers it there.
        let desk = NodeReport { is_interface_default: Some(true), ..node_report("desk", 3, open(true)) };
        let [found, fine] = &checks(&[desk, node_report("knee", 2, open(true))], &here)[..] else {
            panic!("that which is alone, and the other")
        };
        assert!(
            found.detail.contains("no other host sees") && found.detail.contains("desk"),
            "{}",
            found.detail
        );
        let fix = found.fix.as_ref().expect("a finding");
        assert!(fix.contains("[ndl]") && fix.contains("interface = \"10.0.0.5\""), "{fix}");
        assert!(
            fix.contains("sinew keys init walker desk=192.168.0.3"),
            "an open one is closed first: {fix}"
        );
        assert!(fine.fix.is_none() && fine.detail.contains("knee"), "{}", fine.detail);
    }

    #[test]
    fn configured_loopback_is_shown_but_no_finding() {
        let desk = NodeReport { interface: "lo".to_owned(), ..node_report("desk", 3, open(false)) };
        let [fine] = &checks(&[desk], &[interface("lo", &["127.0.0.1"])])[..] else { panic!("one") };
        assert!(fine.fix.is_none(), "{:?}", fine.fix);
        assert!(
            fine.detail.contains("no other host sees") && fine.detail.ends_with("desk (lo)"),
            "{}",
            fine.detail
        );
        assert!(fine.detail.contains("as configured"), "{}", fine.detail);
    }

    #[test]
    fn loopback_of_unknown_origin_is_not_called_configured() {
        let desk = NodeReport { is_interface_default: None, ..node_report("desk", 3, open(false)) };
        let [fine] = &checks(&[desk], &[])[..] else { panic!("one") };
        assert!(fine.fix.is_none() && fine.detail.contains("desk"), "{}", fine.detail);
        assert!(!fine.detail.contains("configured"), "{}", fine.detail);
    }

    #[test]
    fn fix_omits_keys_that_exist_and_a_missing_network() {
        let security =
            secured(NOW_S, "until-set").map(|keys| SecurityReport { is_beyond_host: false, ..keys });
        let desk = NodeReport { is_interface_default: Some(true), ..node_report("desk", 3, security) };
        let [found] = &checks(&[desk], &[interface("lo", &["127.0.0.1"])])[..] else { panic!("one") };
        let fix = found.fix.as_ref().expect("a finding");
        assert!(!fix.contains("sinew keys") && fix.contains("this host has none"), "{fix}");
    }

    #[test]
    fn missing_report_is_no_finding() {
        assert!(checks(&[node_report("hip", 1, None)], &[]).iter().all(|check| check.fix.is_none()));
        assert!(checks(&[], &[]).is_empty());
    }
}
