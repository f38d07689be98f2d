//! Nodes on hosts of their own: found, held at the barrier, talking, cut off, back; and with two interfaces each, of which one goes.

use std::{fmt::Write, net::SocketAddrV4};

use sinew_tests::{Hosts, OwnDirectory, Program, node_under_test, own_group};

const NAMES: [&str; 4] = ["central", "hip", "knee", "ankle"];
/// Four of them make a loss: quicker than what is watched for it lasts, and slower than a busy machine stands still.
const PERIOD_MS: u32 = 250;

/// A node on `host` that discovers by multicast on the hosts' own network.
fn configuration(directory: &OwnDirectory, index: usize, group: SocketAddrV4) -> std::path::PathBuf {
    let (name, address) = (NAMES[index], index + 1);
    let path = directory.join(&format!("{name}.toml"));
    let mut text = String::new();
    write!(
        text,
        "[node]\nname = \"{name}\"\nproject = \"hosts\"\n\
         [ndl]\ninterface = \"10.77.0.{address}\"\nmulticast = \"{group}\"\nperiod_ms = {PERIOD_MS}\n"
    )
    .expect("a string takes any text");
    std::fs::write(&path, text).expect("the test's own directory");
    path
}

fn start(
    hosts: &Hosts,
    directory: &OwnDirectory,
    index: usize,
    group: SocketAddrV4,
    more: &[&str],
) -> Program {
    node_under_test(Some(&hosts.all()[index]), &configuration(directory, index, group), more)
}

/// The hosts; where none can be made here, it says so, and the test that asks is skipped.
fn or_say(hosts: Result<Hosts, String>) -> Option<Hosts> {
    hosts.inspect_err(|why| println!("skipped: no hosts can be made here: {why}")).ok()
}

#[test]
fn four_hosts_find_each_other_wait_talk_and_notice_a_cut_link() {
    let Some(hosts) = or_say(Hosts::new(4)) else { return };
    let (directory, group) = (OwnDirectory::new(), own_group());

    // Three are there, and wait for the fourth.
    let everybody = ["--requires", "hip", "--requires", "knee", "--requires", "ankle", "--sends-to", "ankle"];
    let mut central = start(&hosts, &directory, 0, group, &everybody);
    let mut hip = start(&hosts, &directory, 1, group, &[]);
    let mut knee = start(&hosts, &directory, 2, group, &[]);
    hip.wait_for(&["NodeFound", "central"]);
    knee.wait_for(&["NodeFound", "central"]);
    assert!(central.said().iter().all(|line| !line.contains("started")), "the barrier holds");

    // With it, messages flow.
    let mut ankle = start(&hosts, &directory, 3, group, &[]);
    central.wait_for(&["started"]);
    ankle.wait_for(&["count 1 from 10.77.0.1"]);
    for node in [&mut hip, &mut knee] {
        node.wait_for(&["NodeFound", "ankle"]);
    }

    // Its link is cut: every other node says so, and it says so of every other.
    hosts.cut(3);
    for node in [&mut hip, &mut knee, &mut central] {
        node.wait_for(&["NodeLost", "ankle", "LinkDown"]);
    }
    ankle.wait_for(&["NodeLost", "central", "LinkDown"]);
    central.wait_for(&["requirement", "Lost", "ankle"]);

    // And joined again: found, and talking where it stopped.
    hosts.join(3);
    for node in [&mut hip, &mut knee, &mut central] {
        node.wait_for(&["NodeFound", "ankle"]);
    }
    central.wait_for(&["requirement", "Met", "ankle"]);
    ankle.wait_for(&["NodeFound", "central"]);
    ankle.wait_for(&["count", "from 10.77.0.1"]);
}

/// A node with an interface in each of two networks.
fn start_in_both(hosts: &Hosts, directory: &OwnDirectory, index: usize, more: &[&str]) -> Program {
    let (name, address) = (NAMES[index], index + 1);
    let path = directory.join(&format!("{name}.toml"));
    let other = 3 - address;
    let text = format!(
        "[node]\nname = \"{name}\"\nproject = \"hosts\"\n\
         [gncl]\nfurther = [\"10.78.0.{address}\"]\n\
         [ndl]\ninterface = \"10.77.0.{address}\"\nport = 6911\nseeds = [\"10.77.0.{other}:6911\"]\n\
         multicast = false\nmdns_port = false\nperiod_ms = {PERIOD_MS}\n"
    );
    std::fs::write(&path, text).expect("the test's own directory");
    node_under_test(Some(&hosts.all()[index]), &path, more)
}

/// The number and the one before it in a line that says which count came.
fn count_in(line: &str) -> Option<(u64, u64)> {
    let words: Vec<_> = line.split(' ').collect();
    match words[..] {
        ["count", number, "from", _, "after", last] => Some((number.parse().ok()?, last.parse().ok()?)),
        _ => None,
    }
}

#[test]
fn a_link_whose_interface_is_taken_down_is_back_over_the_other_one_and_nothing_is_lost_or_comes_twice() {
    let Some(hosts) = or_say(Hosts::in_networks(2, 2)) else { return };
    let directory = OwnDirectory::new();
    let mut central =
        start_in_both(&hosts, &directory, 0, &["--requires", "hip", "--sends-to", "hip", "--logs"]);
    let mut hip = start_in_both(&hosts, &directory, 1, &["--logs"]);
    central.wait_for(&["started"]);
    hip.wait_for(&["count 50 from 10.77.0.1"]);
    // When
    hosts.take_down(0, 0);
    // Then: the kernel's word breaks the link, not a silence of seconds
    central.wait_for(&["address lost", "10.77.0.1"]);
    hip.wait_for(&["count 350 from 10.77.0.1"]);
    let counts: Vec<_> = hip.said().iter().filter_map(|line| count_in(line)).collect();
    assert!(counts.iter().all(|(number, last)| *number == last + 1), "{counts:?}");
    for node in [&central, &hip] {
        let is_as_it_should_be = |line: &String| !line.contains("NodeLost") && !line.contains("silent link");
        assert!(node.said().iter().all(is_as_it_should_be), "{:?}", node.said());
    }
}

/// A node that uses these interfaces, and finds others by multicast on each.
fn start_on(
    hosts: &Hosts,
    directory: &OwnDirectory,
    (index, interfaces): (usize, &str),
    group: SocketAddrV4,
    more: &[&str],
) -> Program {
    let (name, address) = (NAMES[index], index + 1);
    let path = directory.join(&format!("{name}.toml"));
    let text = format!(
        "[node]\nname = \"{name}\"\nproject = \"hosts\"\naddress = \"10.77.0.{address}\"\n\
         [ndl]\ninterface = {interfaces}\nmulticast = \"{group}\"\nmdns_port = false\nperiod_ms = {PERIOD_MS}\n"
    );
    std::fs::write(&path, text).expect("the test's own directory");
    node_under_test(Some(&hosts.all()[index]), &path, more)
}

fn counts_in_order(node: &Program) {
    let counts: Vec<_> = node.said().iter().filter_map(|line| count_in(line)).collect();
    assert!(counts.iter().all(|(number, last)| *number == last + 1), "{counts:?}");
}

fn has_lost_nobody(nodes: [&Program; 2]) {
    for node in nodes {
        assert!(node.said().iter().all(|line| !line.contains("NodeLost")), "{:?}", node.said());
    }
}

#[test]
fn a_node_with_two_links_is_there_while_one_of_them_carries_and_lost_when_none_does() {
    let Some(hosts) = or_say(Hosts::in_networks(2, 2)) else { return };
    let (directory, group) = (OwnDirectory::new(), own_group());
    let sends = ["--requires", "hip", "--sends-to", "hip", "--logs"];
    let on = |index| (index, ["[\"10.77.0.1\", \"10.78.0.1\"]", "[\"10.77.0.2\", \"10.78.0.2\"]"][index]);
    let mut central = start_on(&hosts, &directory, on(0), group, &sends);
    let mut hip = start_on(&hosts, &directory, on(1), group, &["--logs"]);
    central.wait_for(&["started"]);
    hip.wait_for(&["count 50 from 10.77.0.1"]);
    // One link is cut: what is sent arrives over the other, and nobody is lost.
    hosts.cut(0);
    hip.wait_for(&["count 350 from 10.77.0.1"]);
    counts_in_order(&hip);
    has_lost_nobody([&central, &hip]);
    // Both are.
    hosts.cut_in(0, 1);
    for (node, other) in [(&mut central, "hip"), (&mut hip, "central")] {
        node.wait_for(&["NodeLost", other, "LinkDown"]);
    }
    // The first one is there again, at the same address and port.
    hosts.join(0);
    hip.wait_for(&["NodeFound", "central"]);
    central.wait_for(&["NodeFound", "hip"]);
}

#[test]
fn an_interface_that_is_chosen_by_its_name_is_used_from_when_it_is_there() {
    let Some(hosts) = or_say(Hosts::in_networks(2, 2)) else { return };
    let (directory, group) = (OwnDirectory::new(), own_group());
    hosts.take_down(0, 1);
    let sends = ["--requires", "hip", "--sends-to", "hip", "--logs-info"];
    let mut central = start_on(&hosts, &directory, (0, "[\"eth0\", \"eth1\"]"), group, &sends);
    let mut hip = start_on(&hosts, &directory, (1, "\"all\""), group, &["--logs-info"]);
    central.wait_for(&["started"]);
    hip.wait_for(&["count 50 from 10.77.0.1"]);
    // The second one comes up: the other node learns where this one listens besides.
    hosts.bring_up(0, 1);
    central.wait_for(&["NDL sends and receives here now", "10.78.0.1"]);
    hip.wait_for(&["listens there now", "10.78.0.1"]);
    // Now the first one may go.
    hosts.take_down(0, 0);
    hip.wait_for(&["count 350 from 10.77.0.1"]);
    counts_in_order(&hip);
    has_lost_nobody([&central, &hip]);
}

#[test]
fn nodes_of_one_host_that_have_loopback_beside_an_interface_go_on_without_its_address() {
    go_on_without_the_address(["eth0/ipv4", "eth0/ipv4"]);
}

#[test]
fn nodes_of_one_host_that_have_loopback_beside_an_address_go_on_without_it() {
    go_on_without_the_address(["10.77.0.1", "10.77.0.2"]);
}

/// Two nodes on the first host and one on the second, which are on the network so; the first host loses its address there for a while.
fn go_on_without_the_address(networks: [&str; 2]) {
    let Some(hosts) = or_say(Hosts::new(2)) else { return };
    let (directory, group) = (OwnDirectory::new(), own_group());
    let file = |index: usize| {
        let (name, address, network) = (NAMES[index], index + 1, networks[index / 2]);
        let path = directory.join(&format!("{name}.toml"));
        let text = format!(
            "[node]\nname = \"{name}\"\nproject = \"hosts\"\naddress = \"10.77.0.{address}\"\n\
             [ndl]\ninterface = [\"{network}\", \"lo\"]\nmulticast = \"{group}\"\nmdns_port = false\nperiod_ms = {PERIOD_MS}\n"
        );
        std::fs::write(&path, text).expect("the test's own directory");
        path
    };
    let (here, there) = (&hosts.all()[0], &hosts.all()[1]);
    let sends = ["--requires", "hip", "--sends-to", "hip", "--logs"];
    let mut central = node_under_test(Some(here), &file(0), &sends);
    let mut hip = node_under_test(Some(here), &file(1), &["--logs"]);
    let mut knee = node_under_test(Some(there), &file(2), &[]);
    central.wait_for(&["started"]);
    for node in [&mut central, &mut hip] {
        node.wait_for(&["NodeFound", "knee"]);
    }
    for other in ["central", "hip"] {
        knee.wait_for(&["NodeFound", other]);
    }
    hip.wait_for(&["count 50 from 10.77.0.1"]);
    // When: their host has no network any more
    here.ip("address del 10.77.0.1/24 dev eth0").expect("it has that address");
    // Then: the other host is lost, and they are not, and what one sends the other gets
    for node in [&mut central, &mut hip] {
        node.wait_for(&["NodeLost", "knee", "LinkDown"]);
    }
    for other in ["central", "hip"] {
        knee.wait_for(&["NodeLost", other, "LinkDown"]);
    }
    let last = hip.said().iter().filter_map(|line| count_in(line)).map(|(number, _)| number).max();
    let last = last.expect("some have come");
    hip.wait_for(&[&format!("count {} from 10.77.0.1", last + 300)]);
    counts_in_order(&hip);
    // And when it is back
    here.ip("address add 10.77.0.1/24 dev eth0").expect("it has it not");
    for node in [&mut central, &mut hip] {
        node.wait_for(&["NodeFound", "knee"]);
    }
    for (node, other) in [(&central, "hip"), (&hip, "central")] {
        let is_lost = |line: &&String| line.contains("NodeLost") && line.contains(other);
        assert!(!node.said().iter().any(|line| is_lost(&line)), "{:?}", node.said());
    }
}

/// A node that finds others by multicast DNS alone.
fn start_by_mdns(hosts: &Hosts, directory: &OwnDirectory, index: usize, interface: &str) -> Program {
    let (name, address) = (NAMES[index], index + 1);
    let path = directory.join(&format!("{name}.toml"));
    let text = format!(
        "[node]\nname = \"{name}\"\nproject = \"hosts\"\naddress = \"10.77.0.{address}\"\n\
         [ndl]\ninterface = {interface}\nmulticast = false\nperiod_ms = {PERIOD_MS}\n"
    );
    std::fs::write(&path, text).expect("the test's own directory");
    node_under_test(Some(&hosts.all()[index]), &path, &["--logs-info"])
}

#[test]
fn mdns_finds_a_node_over_whichever_interface_leads_to_it_also_one_that_comes_later() {
    let Some(hosts) = or_say(Hosts::in_networks(3, 2)) else { return };
    let directory = OwnDirectory::new();
    // The other one is in the second network alone.
    let mut central = start_by_mdns(&hosts, &directory, 0, "[\"eth0/ipv4\", \"eth1/ipv4\"]");
    let mut hip = start_by_mdns(&hosts, &directory, 1, "\"eth1/ipv4\"");
    central.wait_for(&["NodeFound", "hip"]);
    hip.wait_for(&["NodeFound", "central"]);
    // Whose second interface is not there yet.
    hosts.take_down(2, 1);
    let mut knee = start_by_mdns(&hosts, &directory, 2, "[\"eth0/ipv4\", \"eth1/ipv4\"]");
    knee.wait_for(&["NodeFound", "central"]);
    hosts.bring_up(2, 1);
    for (node, other) in [(&mut knee, "hip"), (&mut hip, "knee")] {
        node.wait_for(&["NodeFound", other]);
    }
}
