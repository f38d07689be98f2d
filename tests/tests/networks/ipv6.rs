//! Nodes on hosts that have IPv6, alone or beside IPv4. They are found over a link without configured
//! addresses, exchange messages, are cut off, and stay present as long as either family works.

use std::net::{Ipv6Addr, SocketAddrV4};

use sinew_testkit::Addresses;
use sinew_testkit::{Host, Hosts, NodeProcess, TestDirectory, own_group};
use sinew_tests::node_under_test;

const NAMES: [&str; 2] = ["central", "hip"];
const SENDS: [&str; 5] = ["--requires", "hip", "--sends-to", "hip", "--logs-info"];
const LOGS: [&str; 1] = ["--logs-info"];

/// Two nodes on two hosts, the first of which sends to the second.
struct Scenario {
    hosts: Hosts,
    directory: TestDirectory,
    group: SocketAddrV4,
    /// Whether both nodes are on the first host.
    is_one_host: bool,
    period_ms: u32,
}

impl Scenario {
    /// `None` if no hosts can be created here, or they have no IPv6; this is reported.
    fn new(networks: u8, addresses: Addresses) -> Option<Self> {
        let hosts = Hosts::with_addresses(2, networks, addresses);
        let hosts =
            hosts.inspect_err(|why| println!("skipped: no hosts with IPv6 can be made here: {why}")).ok()?;
        let directory = TestDirectory::new();
        Some(Self { hosts, directory, group: own_group(), is_one_host: false, period_ms: 250 })
    }

    fn ip(&self, host: usize, arguments: &str) {
        self.hosts.all()[host].ip(arguments).unwrap_or_else(|error| panic!("{error}"));
    }

    /// A node with these additional lines in its `ndl` table.
    fn start(&self, index: usize, ndl: &str) -> NodeProcess {
        self.start_with(index, ndl, "false")
    }

    /// The same with this port of multicast DNS.
    fn start_with(&self, index: usize, ndl: &str, mdns_port: &str) -> NodeProcess {
        let (name, address, period_ms) = (NAMES[index], index + 1, self.period_ms);
        let text = format!(
            "[node]\nname = \"{name}\"\nproject = \"ipv6\"\naddress = \"10.77.0.{address}\"\n\
             [ndl]\nmdns_port = {mdns_port}\nperiod_ms = {period_ms}\n{ndl}\n"
        );
        let path = self.directory.write(&format!("{name}.toml"), &text);
        let more: &[&str] = if index == 0 { &SENDS } else { &LOGS };
        let host = if self.is_one_host { 0 } else { index };
        node_under_test(Some(&self.hosts.all()[host]), &path, more)
    }

    /// Both, on the interfaces that are named to each of them, found by multicast.
    fn start_both(&self, interface: &str) -> [NodeProcess; 2] {
        let ndl = format!("interface = {interface}\nmulticast = \"{}\"", self.group);
        [self.start(0, &ndl), self.start(1, &ndl)]
    }
}

/// The number and the one before it, from a line that reports a count.
fn count_in(line: &str) -> Option<(u64, u64)> {
    let words: Vec<_> = line.split(' ').collect();
    match words[..] {
        ["count", number, "from", _, "after", last] => Some((number.parse().ok()?, last.parse().ok()?)),
        _ => None,
    }
}

/// Checks that this many counts arrived in order, and that no node was lost.
fn all_came(central: &NodeProcess, hip: &mut NodeProcess, count: u64) {
    hip.wait_for(&[&format!("count {count} from 10.77.0.1")]);
    let counts: Vec<_> = hip.output().iter().filter_map(|line| count_in(line)).collect();
    assert!(counts.iter().all(|(number, last)| *number == last + 1), "{counts:?}");
    for node in [central, hip] {
        assert!(node.output().iter().all(|line| !line.contains("NodeLost")), "{:?}", node.output());
    }
}

#[test]
fn two_hosts_with_only_a_link_meet() {
    let Some(scenario) = Scenario::new(1, Addresses::LinkLocal) else { return };
    let [mut central, mut hip] = scenario.start_both("\"eth0\"");
    central.wait_for(&["started"]);
    all_came(&central, &mut hip, 50);
    scenario.hosts.cut(0);
    for (node, other) in [(&mut central, "hip"), (&mut hip, "central")] {
        node.wait_for(&["NodeLost", other, "LinkDown"]);
    }
    scenario.hosts.join(0);
    hip.wait_for(&["NodeFound", "central"]);
    central.wait_for(&["NodeFound", "hip"]);
    hip.wait_for(&["count", "from 10.77.0.1"]);
}

#[test]
fn either_link_with_the_same_address_may_be_cut() {
    let Some(scenario) = Scenario::new(2, Addresses::LinkLocal) else { return };
    let [mut central, mut hip] = scenario.start_both("\"all/ipv6\"");
    central.wait_for(&["started"]);
    // Each has found that the other one also answers on the second link.
    for node in [&mut central, &mut hip] {
        node.wait_for(&["listens there now"]);
    }
    all_came(&central, &mut hip, 50);
    scenario.hosts.cut_in(0, 0);
    all_came(&central, &mut hip, 350);
    scenario.hosts.cut_in(1, 1);
    for (node, other) in [(&mut central, "hip"), (&mut hip, "central")] {
        node.wait_for(&["NodeLost", other, "LinkDown"]);
    }
}

#[test]
fn no_node_is_lost_while_one_family_works() {
    let Some(scenario) = Scenario::new(1, Addresses::Both) else { return };
    let [mut central, mut hip] = scenario.start_both("\"eth0\"");
    central.wait_for(&["started"]);
    for node in [&mut central, &mut hip] {
        node.wait_for(&["listens there now", "fe80"]);
    }
    all_came(&central, &mut hip, 50);
    // One of them loses IPv4.
    scenario.ip(0, "address del 10.77.0.1/24 dev eth0");
    all_came(&central, &mut hip, 350);
    // It is back, and the other one loses IPv6.
    scenario.ip(0, "address add 10.77.0.1/24 dev eth0");
    hip.wait_for(&["listens there now", "10.77.0.1"]);
    scenario.ip(1, "address del fe80::2/64 dev eth0");
    all_came(&central, &mut hip, 700);
}

/// Both ends of each IPv6 TCP connection of a host, without their ports.
fn connections(host: &Host) -> Vec<[Ipv6Addr; 2]> {
    let table =
        host.run(|| std::fs::read_to_string("/proc/thread-self/net/tcp6")).expect("the kernel's table");
    // Each 32 bits of an address are in this host's byte order.
    let address = |text: &str| {
        let words =
            (0..4).map(|at| u32::from_str_radix(&text[8 * at..8 * at + 8], 16).expect("hexadecimal digits"));
        let bytes: Vec<u8> = words.flat_map(u32::to_ne_bytes).collect();
        Ipv6Addr::from(<[u8; 16]>::try_from(bytes).expect("four words"))
    };
    let ends = |line: &str| {
        let fields: Vec<_> = line.split_whitespace().collect();
        (fields[3] == "01").then(|| [address(fields[1]), address(fields[2])])
    };
    table.lines().skip(1).filter_map(ends).collect()
}

#[test]
fn connections_use_announced_addresses_at_both_ends() {
    let Some(mut scenario) = Scenario::new(1, Addresses::LinkLocal) else { return };
    // So rare that no answer is missed. A missed answer would cause a connection attempt from an address that
    // the kernel chooses.
    scenario.period_ms = 20_000;
    for host in 0..2 {
        // As with temporary addresses: the kernel's default source is not the announced address of the node.
        let number = host + 1;
        scenario.ip(host, &format!("address add fd77::{number}/64 dev eth0 nodad preferred_lft 0"));
        scenario.ip(host, &format!("address add fd77::6{number}/64 dev eth0 nodad"));
    }
    let alone = "multicast = false\nport = 6911";
    let mut hip = scenario.start(1, &format!("interface = \"fd77::2\"\n{alone}"));
    let mut central =
        scenario.start(0, &format!("interface = \"fd77::1\"\n{alone}\nseeds = [\"[fd77::2]:6911\"]"));
    central.wait_for(&["started"]);
    all_came(&central, &mut hip, 50);
    let all = connections(&scenario.hosts.all()[0]);
    let [ours, theirs] = ["fd77::1", "fd77::2"].map(|ip| ip.parse::<Ipv6Addr>().expect("an address"));
    assert!(!all.is_empty() && all.iter().all(|ends| *ends == [ours, theirs]), "{all:?}");
}

#[test]
fn family_requested_alone_is_the_only_one() {
    let Some(scenario) = Scenario::new(1, Addresses::Both) else { return };
    let [mut central, mut hip] = scenario.start_both("\"eth0/ipv4\"");
    central.wait_for(&["started"]);
    all_came(&central, &mut hip, 50);
    assert!(hip.output().iter().all(|line| !line.contains("fe80")), "{:?}", hip.output());
}

#[test]
fn seeds_name_the_interface_only_for_link_local_addresses() {
    let Some(scenario) = Scenario::new(1, Addresses::LinkLocal) else { return };
    let alone = "multicast = false\nport = 6911";
    let seeds =
        |interface: &str, seed: &str| format!("interface = \"{interface}\"\n{alone}\nseeds = [\"{seed}\"]");
    let mut hip = scenario.start(1, &format!("interface = \"fe80::2%eth0\"\n{alone}"));
    let mut central = scenario.start(0, &seeds("fe80::1%eth0", "[fe80::2%eth0]:6911"));
    central.wait_for(&["started"]);
    all_came(&central, &mut hip, 50);
    drop((central, hip));

    scenario.ip(0, "address add fd77::1/64 dev eth0 nodad");
    scenario.ip(1, "address add fd77::2/64 dev eth0 nodad");
    let mut hip = scenario.start(1, &format!("interface = \"fd77::2\"\n{alone}"));
    let mut central = scenario.start(0, &seeds("fd77::1", "[fd77::2]:6911"));
    central.wait_for(&["started"]);
    all_came(&central, &mut hip, 50);
}

#[test]
fn address_added_later_is_used_if_unique() {
    let Some(scenario) = Scenario::new(1, Addresses::LinkLocal) else { return };
    let alone = "multicast = false\nport = 6911";
    let mut hip = scenario.start(1, &format!("interface = \"fd77::2\"\n{alone}"));
    let seeds = "seeds = [\"[fd77::2]:6911\"]";
    let mut central = scenario.start(0, &format!("interface = \"fd77::1\"\n{alone}\n{seeds}"));
    for node in [&mut hip, &mut central] {
        node.wait_for(&["NDL has no address yet", "fd77"]);
    }
    scenario.ip(0, "address add fd77::1/64 dev eth0 nodad");
    central.wait_for(&["NDL sends and receives here now", "fd77::1"]);
    // The kernel checks for duplicates first; this causes no failure in the node.
    scenario.ip(1, "address add fd77::2/64 dev eth0");
    hip.wait_for(&["NDL sends and receives here now", "fd77::2"]);
    central.wait_for(&["started"]);
    all_came(&central, &mut hip, 50);
    assert!(hip.output().iter().all(|line| !line.contains("cannot use UDP")), "{:?}", hip.output());
}

#[test]
fn duplicate_address_is_not_used_and_is_reported() {
    let Some(scenario) = Scenario::new(1, Addresses::LinkLocal) else { return };
    scenario.ip(0, "address add fd77::9/64 dev eth0 nodad");
    scenario.ip(1, "address add fd77::9/64 dev eth0");
    let mut hip = scenario.start(1, "interface = \"fd77::9\"\nmulticast = false");
    hip.wait_for(&["another host on the link has it", "fd77::9"]);
    assert!(
        hip.output().iter().all(|line| !line.contains("sends and receives here now")),
        "{:?}",
        hip.output()
    );
}

#[test]
fn host_without_ipv6_uses_ipv4_and_reports_it_once() {
    let Some(scenario) = Scenario::new(1, Addresses::Both) else { return };
    for host in scenario.hosts.all() {
        // This file is that of the network namespace of the writing thread.
        let written = host.run(|| std::fs::write("/proc/sys/net/ipv6/conf/all/disable_ipv6", "1"));
        written.expect("the kernel takes IPv6 from a host");
    }
    let [mut central, mut hip] = scenario.start_both("\"eth0\"");
    central.wait_for(&["started"]);
    all_came(&central, &mut hip, 100);
    let count = |node: &NodeProcess| {
        node.output().iter().filter(|line| line.contains("this host has no IPv6")).count()
    };
    assert_eq!([count(&central), count(&hip)], [1, 1]);
}

#[test]
fn mdns_alone_finds_a_link_local_address() {
    let Some(scenario) = Scenario::new(1, Addresses::LinkLocal) else { return };
    let ndl = "interface = \"eth0/ipv6\"\nmulticast = false";
    let [mut central, mut hip] = [0, 1].map(|index| scenario.start_with(index, ndl, "5353"));
    central.wait_for(&["started"]);
    all_came(&central, &mut hip, 50);
}

#[test]
fn nodes_of_one_host_meet_at_loopback_by_seeds() {
    let Some(mut scenario) = Scenario::new(1, Addresses::LinkLocal) else { return };
    scenario.is_one_host = true;
    let alone = "interface = \"::1\"\nmulticast = false";
    let mut hip = scenario.start(1, &format!("{alone}\nport = 6911"));
    let mut central = scenario.start(0, &format!("{alone}\nseeds = [\"[::1]:6911\"]"));
    central.wait_for(&["started"]);
    all_came(&central, &mut hip, 50);
}
