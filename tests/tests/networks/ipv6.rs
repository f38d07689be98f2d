//! Nodes on hosts that have IPv6, alone or beside IPv4: found over a link that nobody gave addresses to, talking, cut off, and there as long as
//! either family carries.

use std::net::{Ipv6Addr, SocketAddrV4};

use sinew_hosts::Addresses;
use sinew_tests::{Host, Hosts, OwnDirectory, Program, node_under_test, own_group};

const NAMES: [&str; 2] = ["central", "hip"];
const SENDS: [&str; 5] = ["--requires", "hip", "--sends-to", "hip", "--logs-info"];
const LOGS: [&str; 1] = ["--logs-info"];

/// Two nodes on two hosts, the first of which sends to the second.
struct Scenario {
    hosts: Hosts,
    directory: OwnDirectory,
    group: SocketAddrV4,
    /// Both nodes are on the first one.
    is_one_host: bool,
    period_ms: u32,
}

impl Scenario {
    /// `None`: no hosts can be made here, or they have no IPv6, which is said.
    fn new(networks: u8, addresses: Addresses) -> Option<Self> {
        let hosts = Hosts::with_addresses(2, networks, addresses);
        let hosts =
            hosts.inspect_err(|why| println!("skipped: no hosts with IPv6 can be made here: {why}")).ok()?;
        let directory = OwnDirectory::new();
        Some(Self { hosts, directory, group: own_group(), is_one_host: false, period_ms: 250 })
    }

    fn ip(&self, host: usize, arguments: &str) {
        self.hosts.all()[host].ip(arguments).unwrap_or_else(|error| panic!("{error}"));
    }

    /// A node whose `ndl` table says this besides.
    fn start(&self, index: usize, ndl: &str) -> Program {
        self.start_with(index, ndl, "false")
    }

    /// The same with this port of multicast DNS.
    fn start_with(&self, index: usize, ndl: &str, mdns_port: &str) -> Program {
        let (name, address, period_ms) = (NAMES[index], index + 1, self.period_ms);
        let path = self.directory.join(&format!("{name}.toml"));
        let text = format!(
            "[node]\nname = \"{name}\"\nproject = \"ipv6\"\naddress = \"10.77.0.{address}\"\n\
             [ndl]\nmdns_port = {mdns_port}\nperiod_ms = {period_ms}\n{ndl}\n"
        );
        std::fs::write(&path, text).expect("the test's own directory");
        let more: &[&str] = if index == 0 { &SENDS } else { &LOGS };
        let host = if self.is_one_host { 0 } else { index };
        node_under_test(Some(&self.hosts.all()[host]), &path, more)
    }

    /// Both, on interfaces that each of them is told, found by multicast.
    fn start_both(&self, interface: &str) -> [Program; 2] {
        let ndl = format!("interface = {interface}\nmulticast = \"{}\"", self.group);
        [self.start(0, &ndl), self.start(1, &ndl)]
    }
}

/// The number and the one before it in a line that says which count came.
fn count_in(line: &str) -> Option<(u64, u64)> {
    let words: Vec<_> = line.split(' ').collect();
    match words[..] {
        ["count", number, "from", _, "after", last] => Some((number.parse().ok()?, last.parse().ok()?)),
        _ => None,
    }
}

/// So many counts are there, in order, and nobody was lost.
fn all_came(central: &Program, hip: &mut Program, count: u64) {
    hip.wait_for(&[&format!("count {count} from 10.77.0.1")]);
    let counts: Vec<_> = hip.said().iter().filter_map(|line| count_in(line)).collect();
    assert!(counts.iter().all(|(number, last)| *number == last + 1), "{counts:?}");
    for node in [central, hip] {
        assert!(node.said().iter().all(|line| !line.contains("NodeLost")), "{:?}", node.said());
    }
}

#[test]
fn two_hosts_with_nothing_but_a_link_find_each_other_talk_and_notice_that_it_is_cut() {
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
fn of_two_links_on_which_a_host_has_the_same_link_local_address_either_may_be_cut() {
    let Some(scenario) = Scenario::new(2, Addresses::LinkLocal) else { return };
    let [mut central, mut hip] = scenario.start_both("\"all/ipv6\"");
    central.wait_for(&["started"]);
    // Each has found that the other one answers on the second link, too.
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
fn nobody_is_lost_while_one_of_two_families_carries() {
    let Some(scenario) = Scenario::new(1, Addresses::Both) else { return };
    let [mut central, mut hip] = scenario.start_both("\"eth0\"");
    central.wait_for(&["started"]);
    for node in [&mut central, &mut hip] {
        node.wait_for(&["listens there now", "fe80"]);
    }
    all_came(&central, &mut hip, 50);
    // IPv4 goes at one of them.
    scenario.ip(0, "address del 10.77.0.1/24 dev eth0");
    all_came(&central, &mut hip, 350);
    // It is back, and IPv6 goes at the other one.
    scenario.ip(0, "address add 10.77.0.1/24 dev eth0");
    hip.wait_for(&["listens there now", "10.77.0.1"]);
    scenario.ip(1, "address del fe80::2/64 dev eth0");
    all_came(&central, &mut hip, 700);
}

/// Both ends of each TCP connection of IPv6 that a host has, but for their ports.
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
fn connections_go_from_announced_address_to_announced_address_though_the_kernel_prefers_another_one() {
    let Some(mut scenario) = Scenario::new(1, Addresses::LinkLocal) else { return };
    // So seldom that no answer is missed, and no connection tried for that, from wherever the kernel likes.
    scenario.period_ms = 20_000;
    for host in 0..2 {
        // As with temporary addresses, what the kernel takes by itself is not what the node is known by.
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
fn a_family_that_is_asked_for_alone_is_the_only_one() {
    let Some(scenario) = Scenario::new(1, Addresses::Both) else { return };
    let [mut central, mut hip] = scenario.start_both("\"eth0/ipv4\"");
    central.wait_for(&["started"]);
    all_came(&central, &mut hip, 50);
    assert!(hip.said().iter().all(|line| !line.contains("fe80")), "{:?}", hip.said());
}

#[test]
fn seeds_lead_to_a_link_by_the_name_of_the_interface_and_to_a_site_by_the_address_alone() {
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
fn an_address_that_comes_later_is_used_when_no_other_host_has_it() {
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
    // The kernel asks first; nothing of the node fails for that.
    scenario.ip(1, "address add fd77::2/64 dev eth0");
    hip.wait_for(&["NDL sends and receives here now", "fd77::2"]);
    central.wait_for(&["started"]);
    all_came(&central, &mut hip, 50);
    assert!(hip.said().iter().all(|line| !line.contains("cannot use UDP")), "{:?}", hip.said());
}

#[test]
fn an_address_that_another_host_has_is_not_used_and_that_is_said() {
    let Some(scenario) = Scenario::new(1, Addresses::LinkLocal) else { return };
    scenario.ip(0, "address add fd77::9/64 dev eth0 nodad");
    scenario.ip(1, "address add fd77::9/64 dev eth0");
    let mut hip = scenario.start(1, "interface = \"fd77::9\"\nmulticast = false");
    hip.wait_for(&["another host on the link has it", "fd77::9"]);
    assert!(hip.said().iter().all(|line| !line.contains("sends and receives here now")), "{:?}", hip.said());
}

#[test]
fn a_host_without_ipv6_goes_on_with_ipv4_and_says_so_once() {
    let Some(scenario) = Scenario::new(1, Addresses::Both) else { return };
    for host in scenario.hosts.all() {
        // What stands there is that of the network namespace of the thread that writes.
        let written = host.run(|| std::fs::write("/proc/sys/net/ipv6/conf/all/disable_ipv6", "1"));
        written.expect("the kernel takes IPv6 from a host");
    }
    let [mut central, mut hip] = scenario.start_both("\"eth0\"");
    central.wait_for(&["started"]);
    all_came(&central, &mut hip, 100);
    let said =
        |node: &Program| node.said().iter().filter(|line| line.contains("this host has no IPv6")).count();
    assert_eq!([said(&central), said(&hip)], [1, 1]);
}

#[test]
fn multicast_dns_finds_a_node_by_its_link_local_address_alone() {
    let Some(scenario) = Scenario::new(1, Addresses::LinkLocal) else { return };
    let ndl = "interface = \"eth0/ipv6\"\nmulticast = false";
    let [mut central, mut hip] = [0, 1].map(|index| scenario.start_with(index, ndl, "5353"));
    central.wait_for(&["started"]);
    all_came(&central, &mut hip, 50);
}

#[test]
fn nodes_of_one_host_meet_at_its_loopback_address_by_seeds() {
    let Some(mut scenario) = Scenario::new(1, Addresses::LinkLocal) else { return };
    scenario.is_one_host = true;
    let alone = "interface = \"::1\"\nmulticast = false";
    let mut hip = scenario.start(1, &format!("{alone}\nport = 6911"));
    let mut central = scenario.start(0, &format!("{alone}\nseeds = [\"[::1]:6911\"]"));
    central.wait_for(&["started"]);
    all_came(&central, &mut hip, 50);
}
