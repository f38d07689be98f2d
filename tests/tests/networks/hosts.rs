//! Nodes on hosts of their own: found, held at the barrier, exchanging messages, cut off, reconnected. Nodes
//! with two interfaces each, of which one is taken down.

use std::{fmt::Write, net::SocketAddrV4};

use sinew_testkit::{Hosts, NodeProcess, TestDirectory, own_group};
use sinew_tests::node_under_test;

const NAMES: [&str; 4] = ["central", "hip", "knee", "ankle"];
/// A loss takes four periods: shorter than the observed outage, and longer than a busy machine stalls.
const PERIOD_MS: u32 = 250;

/// A node on `host` that discovers by multicast on the hosts' own network.
fn configuration(directory: &TestDirectory, index: usize, group: SocketAddrV4) -> std::path::PathBuf {
    let (name, address) = (NAMES[index], index + 1);
    let mut text = String::new();
    write!(
        text,
        "[node]\nname = \"{name}\"\nproject = \"hosts\"\n\
         [ndl]\ninterface = \"10.77.0.{address}\"\nmulticast = \"{group}\"\nperiod_ms = {PERIOD_MS}\n"
    )
    .expect("a string takes any text");
    directory.write(&format!("{name}.toml"), &text)
}

fn start(
    hosts: &Hosts,
    directory: &TestDirectory,
    index: usize,
    group: SocketAddrV4,
    more: &[&str],
) -> NodeProcess {
    node_under_test(Some(&hosts.all()[index]), &configuration(directory, index, group), more)
}

/// Returns the hosts. If none can be created here, it reports this, and the caller is skipped.
fn or_skip(hosts: Result<Hosts, String>) -> Option<Hosts> {
    hosts.inspect_err(|why| println!("skipped: no hosts can be made here: {why}")).ok()
}

#[test]
fn four_hosts_meet_exchange_messages_and_notice_a_cut() {
    let Some(hosts) = or_skip(Hosts::new(4)) else { return };
    let (directory, group) = (TestDirectory::new(), own_group());

    // Three are up, and wait for the fourth.
    let everybody = ["--requires", "hip", "--requires", "knee", "--requires", "ankle", "--sends-to", "ankle"];
    let mut central = start(&hosts, &directory, 0, group, &everybody);
    let mut hip = start(&hosts, &directory, 1, group, &[]);
    let mut knee = start(&hosts, &directory, 2, group, &[]);
    hip.wait_for(&["NodeFound", "central"]);
    knee.wait_for(&["NodeFound", "central"]);
    assert!(central.output().iter().all(|line| !line.contains("started")), "the barrier holds");

    // Once it is up, messages flow.
    let mut ankle = start(&hosts, &directory, 3, group, &[]);
    central.wait_for(&["started"]);
    ankle.wait_for(&["count 1 from 10.77.0.1"]);
    for node in [&mut hip, &mut knee] {
        node.wait_for(&["NodeFound", "ankle"]);
    }

    // Its link is cut: every other node reports its loss, and it reports the loss of every other.
    hosts.cut(3);
    for node in [&mut hip, &mut knee, &mut central] {
        node.wait_for(&["NodeLost", "ankle", "LinkDown"]);
    }
    ankle.wait_for(&["NodeLost", "central", "LinkDown"]);
    central.wait_for(&["requirement", "Lost", "ankle"]);

    // The link is restored: it is found again, and messages continue where they stopped.
    hosts.join(3);
    for node in [&mut hip, &mut knee, &mut central] {
        node.wait_for(&["NodeFound", "ankle"]);
    }
    central.wait_for(&["requirement", "Met", "ankle"]);
    ankle.wait_for(&["NodeFound", "central"]);
    ankle.wait_for(&["count", "from 10.77.0.1"]);
}

/// A node with an interface in each of two networks.
fn start_in_both(hosts: &Hosts, directory: &TestDirectory, index: usize, more: &[&str]) -> NodeProcess {
    let (name, address) = (NAMES[index], index + 1);
    let other = 3 - address;
    let text = format!(
        "[node]\nname = \"{name}\"\nproject = \"hosts\"\n\
         [gncl]\nfurther = [\"10.78.0.{address}\"]\n\
         [ndl]\ninterface = \"10.77.0.{address}\"\nport = 6911\nseeds = [\"10.77.0.{other}:6911\"]\n\
         multicast = false\nmdns_port = false\nperiod_ms = {PERIOD_MS}\n"
    );
    let path = directory.write(&format!("{name}.toml"), &text);
    node_under_test(Some(&hosts.all()[index]), &path, more)
}

/// The number and the one before it, from a line that reports a count.
fn count_in(line: &str) -> Option<(u64, u64)> {
    let words: Vec<_> = line.split(' ').collect();
    match words[..] {
        ["count", number, "from", _, "after", last] => Some((number.parse().ok()?, last.parse().ok()?)),
        _ => None,
    }
}

#[test]
fn link_moves_to_other_interface_without_loss() {
    let Some(hosts) = or_skip(Hosts::in_networks(2, 2)) else { return };
    let directory = TestDirectory::new();
    let mut central =
        start_in_both(&hosts, &directory, 0, &["--requires", "hip", "--sends-to", "hip", "--logs"]);
    let mut hip = start_in_both(&hosts, &directory, 1, &["--logs"]);
    central.wait_for(&["started"]);
    hip.wait_for(&["count 50 from 10.77.0.1"]);
    // When
    hosts.take_down(0, 0);
    // Then: the kernel's notification breaks the link, not a silence of seconds
    central.wait_for(&["address lost", "10.77.0.1"]);
    hip.wait_for(&["count 350 from 10.77.0.1"]);
    let counts: Vec<_> = hip.output().iter().filter_map(|line| count_in(line)).collect();
    assert!(counts.iter().all(|(number, last)| *number == last + 1), "{counts:?}");
    for node in [&central, &hip] {
        let is_as_it_should_be = |line: &String| !line.contains("NodeLost") && !line.contains("silent link");
        assert!(node.output().iter().all(is_as_it_should_be), "{:?}", node.output());
    }
}

/// A node that uses these interfaces, and finds others by multicast on each.
fn start_on(
    hosts: &Hosts,
    directory: &TestDirectory,
    (index, interfaces): (usize, &str),
    group: SocketAddrV4,
    more: &[&str],
) -> NodeProcess {
    let (name, address) = (NAMES[index], index + 1);
    let text = format!(
        "[node]\nname = \"{name}\"\nproject = \"hosts\"\naddress = \"10.77.0.{address}\"\n\
         [ndl]\ninterface = {interfaces}\nmulticast = \"{group}\"\nmdns_port = false\nperiod_ms = {PERIOD_MS}\n"
    );
    let path = directory.write(&format!("{name}.toml"), &text);
    node_under_test(Some(&hosts.all()[index]), &path, more)
}

fn counts_in_order(node: &NodeProcess) {
    let counts: Vec<_> = node.output().iter().filter_map(|line| count_in(line)).collect();
    assert!(counts.iter().all(|(number, last)| *number == last + 1), "{counts:?}");
}

fn has_lost_nobody(nodes: [&NodeProcess; 2]) {
    for node in nodes {
        assert!(node.output().iter().all(|line| !line.contains("NodeLost")), "{:?}", node.output());
    }
}

#[test]
fn node_with_two_links_is_lost_without_both() {
    let Some(hosts) = or_skip(Hosts::in_networks(2, 2)) else { return };
    let (directory, group) = (TestDirectory::new(), own_group());
    let sends = ["--requires", "hip", "--sends-to", "hip", "--logs"];
    let on = |index| (index, ["[\"10.77.0.1\", \"10.78.0.1\"]", "[\"10.77.0.2\", \"10.78.0.2\"]"][index]);
    let mut central = start_on(&hosts, &directory, on(0), group, &sends);
    let mut hip = start_on(&hosts, &directory, on(1), group, &["--logs"]);
    central.wait_for(&["started"]);
    hip.wait_for(&["count 50 from 10.77.0.1"]);
    // One link is cut: messages arrive over the other, and no node is lost.
    hosts.cut(0);
    hip.wait_for(&["count 350 from 10.77.0.1"]);
    counts_in_order(&hip);
    has_lost_nobody([&central, &hip]);
    // Both are cut.
    hosts.cut_in(0, 1);
    for (node, other) in [(&mut central, "hip"), (&mut hip, "central")] {
        node.wait_for(&["NodeLost", other, "LinkDown"]);
    }
    // The first one is up again, at the same address and port.
    hosts.join(0);
    hip.wait_for(&["NodeFound", "central"]);
    central.wait_for(&["NodeFound", "hip"]);
}

#[test]
fn interface_chosen_by_name_is_used_once_present() {
    let Some(hosts) = or_skip(Hosts::in_networks(2, 2)) else { return };
    let (directory, group) = (TestDirectory::new(), own_group());
    hosts.take_down(0, 1);
    let sends = ["--requires", "hip", "--sends-to", "hip", "--logs-info"];
    let mut central = start_on(&hosts, &directory, (0, "[\"eth0\", \"eth1\"]"), group, &sends);
    let mut hip = start_on(&hosts, &directory, (1, "\"all\""), group, &["--logs-info"]);
    central.wait_for(&["started"]);
    hip.wait_for(&["count 50 from 10.77.0.1"]);
    // The second one comes up: the other node learns this additional address.
    hosts.bring_up(0, 1);
    central.wait_for(&["NDL sends and receives here now", "10.78.0.1"]);
    hip.wait_for(&["listens there now", "10.78.0.1"]);
    // Now the first one may go down.
    hosts.take_down(0, 0);
    hip.wait_for(&["count 350 from 10.77.0.1"]);
    counts_in_order(&hip);
    has_lost_nobody([&central, &hip]);
}

#[test]
fn nodes_of_one_host_survive_loss_of_interface_address() {
    go_on_without_the_address(["eth0/ipv4", "eth0/ipv4"]);
}

#[test]
fn nodes_of_one_host_survive_loss_of_chosen_address() {
    go_on_without_the_address(["10.77.0.1", "10.77.0.2"]);
}

/// Two nodes on the first host and one on the second, on these networks; the first host loses its address
/// there for a while.
fn go_on_without_the_address(networks: [&str; 2]) {
    let Some(hosts) = or_skip(Hosts::new(2)) else { return };
    let (directory, group) = (TestDirectory::new(), own_group());
    let file = |index: usize| {
        let (name, address, network) = (NAMES[index], index + 1, networks[index / 2]);
        let text = format!(
            "[node]\nname = \"{name}\"\nproject = \"hosts\"\naddress = \"10.77.0.{address}\"\n\
             [ndl]\ninterface = [\"{network}\", \"lo\"]\nmulticast = \"{group}\"\nmdns_port = false\nperiod_ms = {PERIOD_MS}\n"
        );
        directory.write(&format!("{name}.toml"), &text)
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
    // When: the host of the two no longer has a network
    here.ip("address del 10.77.0.1/24 dev eth0").expect("it has that address");
    // Then: the other host is lost, the two are not, and messages between them arrive
    for node in [&mut central, &mut hip] {
        node.wait_for(&["NodeLost", "knee", "LinkDown"]);
    }
    for other in ["central", "hip"] {
        knee.wait_for(&["NodeLost", other, "LinkDown"]);
    }
    let last = hip.output().iter().filter_map(|line| count_in(line)).map(|(number, _)| number).max();
    let last = last.expect("some have come");
    hip.wait_for(&[&format!("count {} from 10.77.0.1", last + 300)]);
    counts_in_order(&hip);
    // And: when it is back
    here.ip("address add 10.77.0.1/24 dev eth0").expect("it has it not");
    for node in [&mut central, &mut hip] {
        node.wait_for(&["NodeFound", "knee"]);
    }
    for (node, other) in [(&central, "hip"), (&hip, "central")] {
        let is_lost = |line: &&String| line.contains("NodeLost") && line.contains(other);
        assert!(!node.output().iter().any(|line| is_lost(&line)), "{:?}", node.output());
    }
}

/// A node that finds others by multicast DNS alone.
fn start_by_mdns(hosts: &Hosts, directory: &TestDirectory, index: usize, interface: &str) -> NodeProcess {
    let (name, address) = (NAMES[index], index + 1);
    let text = format!(
        "[node]\nname = \"{name}\"\nproject = \"hosts\"\naddress = \"10.77.0.{address}\"\n\
         [ndl]\ninterface = {interface}\nmulticast = false\nperiod_ms = {PERIOD_MS}\n"
    );
    let path = directory.write(&format!("{name}.toml"), &text);
    node_under_test(Some(&hosts.all()[index]), &path, &["--logs-info"])
}

#[test]
fn mdns_finds_a_node_over_any_interface() {
    let Some(hosts) = or_skip(Hosts::in_networks(3, 2)) else { return };
    let directory = TestDirectory::new();
    // The other node is in the second network only.
    let mut central = start_by_mdns(&hosts, &directory, 0, "[\"eth0/ipv4\", \"eth1/ipv4\"]");
    let mut hip = start_by_mdns(&hosts, &directory, 1, "\"eth1/ipv4\"");
    central.wait_for(&["NodeFound", "hip"]);
    hip.wait_for(&["NodeFound", "central"]);
    // Its second interface is not up yet.
    hosts.take_down(2, 1);
    let mut knee = start_by_mdns(&hosts, &directory, 2, "[\"eth0/ipv4\", \"eth1/ipv4\"]");
    knee.wait_for(&["NodeFound", "central"]);
    hosts.bring_up(2, 1);
    for (node, other) in [(&mut knee, "hip"), (&mut hip, "knee")] {
        node.wait_for(&["NodeFound", other]);
    }
}
