//! Whether the nodes of the system that lets us in are seen from other hosts at all.

use std::net::IpAddr;

use sinew::inspect::NodeReport;

use super::{Check, network::Interface};
use crate::table::quoted;

const NAME: &str = "reach";

/// One check for those that are on loopback only because nobody said anything else, one for those that are to be, and one for the others.
pub(super) fn checks(nodes: &[NodeReport], interfaces: &[Interface]) -> Vec<Check> {
    // Where GNCL is reached from elsewhere (`gncl.further`, `gncl.announce`) nobody finds the node there as long as it looks on loopback. An
    // older node says nothing of it.
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
    for (known, why) in [(Some(false), ", as they are told"), (None, "")] {
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
    let seen = format!(
        "on loopback only, as nobody has said where else: no other host sees them, and they see none: {}",
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
            "first give them keys, or everybody on that network can send to them: sinew keys init {} {}; then ",
            quoted(&open[0].project),
            named.join(" ")
        )
    };
    let mend = format!(
        "where they are to be seen: {keys}below [ndl] in each one's configuration: {line}{several}; then start them again. Where they are not: interface = \"127.0.0.1\" there says so"
    );
    Check::finding(NAME, seen, mend)
}

impl Interface {
    /// An address at which other hosts can be reached, of IPv4 where there is one.
    fn outward(&self) -> Option<IpAddr> {
        if self.is_loopback() || self.lacks().is_some() {
            return None;
        }
        let is_of_a_link = |ip: &IpAddr| matches!(ip, IpAddr::V6(ip) if ip.is_unicast_link_local());
        let ipv4 = self.addresses.iter().find(|ip| ip.is_ipv4());
        // A link-local one needs its interface behind it, and is not the one to begin with.
        ipv4.or_else(|| self.addresses.iter().find(|ip| !is_of_a_link(ip))).copied()
    }
}

#[cfg(test)]
mod tests {
    use sinew::inspect::SecurityReport;

    use super::*;
    use crate::security::tests::{NOW_S, open, said, secured};

    fn interface(name: &str, addresses: &[&str]) -> Interface {
        let addresses = addresses.iter().map(|ip| ip.parse().unwrap()).collect();
        // Up, with multicast.
        Interface { name: name.to_owned(), addresses, number: Some(1), flags: 0x1001, has_carrier: true }
    }

    #[test]
    fn a_node_that_nobody_took_off_loopback_is_a_finding_with_the_line_that_takes_it_to_the_network() {
        let here = [
            interface("lo", &["127.0.0.1"]),
            interface("eth0", &["fe80::5", "10.0.0.5"]),
            interface("eth1", &["10.0.1.5"]),
        ];
        // Also where it listens elsewhere besides: nobody finds it there.
        let desk = NodeReport { is_interface_default: Some(true), ..said("desk", 3, open(true)) };
        let [found, fine] = &checks(&[desk, said("knee", 2, open(true))], &here)[..] else {
            panic!("that which is alone, and the other")
        };
        assert!(found.seen.contains("no other host sees") && found.seen.contains("desk"), "{}", found.seen);
        let mend = found.mend.as_ref().expect("a finding");
        assert!(mend.contains("[ndl]") && mend.contains("interface = \"10.0.0.5\""), "{mend}");
        assert!(
            mend.contains("sinew keys init walker desk=192.168.0.3"),
            "an open one is closed first: {mend}"
        );
        assert!(fine.mend.is_none() && fine.seen.contains("knee"), "{}", fine.seen);
    }

    #[test]
    fn a_node_that_was_put_on_loopback_is_shown_and_is_no_finding() {
        let desk = NodeReport { interface: "lo".to_owned(), ..said("desk", 3, open(false)) };
        let [fine] = &checks(&[desk], &[interface("lo", &["127.0.0.1"])])[..] else { panic!("one") };
        assert!(fine.mend.is_none(), "{:?}", fine.mend);
        assert!(
            fine.seen.contains("no other host sees") && fine.seen.ends_with("desk (lo)"),
            "{}",
            fine.seen
        );
        assert!(fine.seen.contains("as they are told"), "{}", fine.seen);
    }

    #[test]
    fn who_does_not_say_whether_anybody_chose_loopback_is_not_said_to_be_told_so() {
        let desk = NodeReport { is_interface_default: None, ..said("desk", 3, open(false)) };
        let [fine] = &checks(&[desk], &[])[..] else { panic!("one") };
        assert!(fine.mend.is_none() && fine.seen.contains("desk"), "{}", fine.seen);
        assert!(!fine.seen.contains("told"), "{}", fine.seen);
    }

    #[test]
    fn who_has_keys_needs_none_and_a_host_without_a_network_is_told_so() {
        let security =
            secured(NOW_S, "until-set").map(|keys| SecurityReport { is_beyond_host: false, ..keys });
        let desk = NodeReport { is_interface_default: Some(true), ..said("desk", 3, security) };
        let [found] = &checks(&[desk], &[interface("lo", &["127.0.0.1"])])[..] else { panic!("one") };
        let mend = found.mend.as_ref().expect("a finding");
        assert!(!mend.contains("sinew keys") && mend.contains("this host has none"), "{mend}");
    }

    #[test]
    fn who_does_not_say_is_not_accused_and_without_nodes_there_is_no_check() {
        assert!(checks(&[said("hip", 1, None)], &[]).iter().all(|check| check.mend.is_none()));
        assert!(checks(&[], &[]).is_empty());
    }
}
