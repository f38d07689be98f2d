//! Nodes that start before their host has their address: they wait, warn, and continue once the address is
//! present.

use sinew_testkit::Addresses;
use sinew_testkit::{Hosts, TestDirectory, own_group};
use sinew_tests::node_under_test;

/// The value of `ndl.interface`, the address that is added, and the log line that follows.
const FORMS: [(&str, &str, &str); 6] = [
    ("\"10.9.0.2\"", "10.9.0.2/24", "10.9.0.2"),
    ("[\"10.9.0.3\", \"10.9.0.4\"]", "10.9.0.3/24", "10.9.0.3"),
    ("\"eth0/ipv4\"", "10.9.0.5/24", "10.9.0.5"),
    ("\"fd09::2\"", "fd09::2/64", "fd09::2"),
    ("\"fe80::92%eth0\"", "fe80::92/64", "fe80::92"),
    ("[\"10.9.0.6\", \"fd09::6\"]", "fd09::6/64", "fd09::6"),
];

#[test]
fn node_waits_for_its_address_in_any_notation() {
    let hosts = match Hosts::with_addresses(1, 1, Addresses::LinkLocal) {
        Ok(hosts) => hosts,
        Err(why) => return println!("skipped: no hosts with IPv6 can be made here: {why}"),
    };
    let (host, directory, group) = (&hosts.all()[0], TestDirectory::new(), own_group());
    host.ip("address del fe80::1/64 dev eth0").unwrap_or_else(|error| panic!("{error}"));
    let start = |(nth, (interface, ..)): (usize, &(&str, &str, &str))| {
        let text = format!(
            "[node]\nname = \"node{nth}\"\nproject = \"later{nth}\"\naddress = \"10.9.1.{nth}\"\n\
             [ndl]\nmdns_port = false\nmulticast = \"{group}\"\ninterface = {interface}\n"
        );
        let path = directory.write(&format!("node{nth}.toml"), &text);
        node_under_test(Some(host), &path, &["--logs-info"])
    };
    let mut nodes: Vec<_> = FORMS.iter().enumerate().map(start).collect();
    for node in &mut nodes {
        node.wait_for(&["WARN", "warns each minute"]);
        // Its own application runs meanwhile.
        node.wait_for(&["started"]);
    }
    for (node, (_, address, logged)) in nodes.iter_mut().zip(FORMS) {
        let no_question = if address.contains(':') { " nodad" } else { "" };
        host.ip(&format!("address add {address} dev eth0{no_question}"))
            .unwrap_or_else(|error| panic!("{error}"));
        node.wait_for(&["NDL sends and receives here now", logged]);
    }
}

#[test]
fn nodes_find_each_other_when_addresses_come_later() {
    let hosts = match Hosts::new(2) {
        Ok(hosts) => hosts,
        Err(why) => return println!("skipped: no hosts can be made here: {why}"),
    };
    let (directory, group) = (TestDirectory::new(), own_group());
    let node = |nth: usize, more: &[&str]| {
        let text = format!(
            "[node]\nname = \"late{nth}\"\nproject = \"late\"\n\
             [ndl]\nmdns_port = false\nmulticast = \"{group}\"\ninterface = \"10.9.0.{nth}\"\n"
        );
        let path = directory.write(&format!("late{nth}.toml"), &text);
        node_under_test(Some(&hosts.all()[nth - 1]), &path, more)
    };
    let mut first = node(1, &["--requires", "late2", "--sends-to", "late2", "--logs"]);
    let mut second = node(2, &["--logs"]);
    for (nth, node) in [(1, &mut first), (2, &mut second)] {
        node.wait_for(&["warns each minute", "does not have this address"]);
        hosts.all()[nth - 1]
            .ip(&format!("address add 10.9.0.{nth}/24 dev eth0"))
            .unwrap_or_else(|error| panic!("{error}"));
    }
    second.wait_for(&["count 20 from 10.9.0.1"]);
    for node in [&first, &second] {
        let warnings = node.output().iter().filter(|line| line.contains("warns each minute")).count();
        assert_eq!(warnings, 1, "{:?}", node.output());
    }
}
