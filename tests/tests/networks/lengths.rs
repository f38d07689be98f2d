//! Two hosts between which long packets are lost without an ICMP error: values of class Stream of every
//! length arrive at their full rate.

use std::net::SocketAddrV4;

use rustix::process::Signal;
use sinew_testkit::Addresses;
use sinew_testkit::{Hosts, NodeProcess, TestDirectory, own_group};
use sinew_tests::node_under_test;

/// Payloads, in bytes: below and above the limit of such a network, the longest that fits into a datagram,
/// and one that always goes by TCP.
const LENGTHS: [usize; 7] = [32, 400, 700, 900, 1_100, 1_112, 1_400];
/// The limit of a path that shrinks, in bytes.
const SHRUNK: u32 = 1_000;
/// Number of values of each length that are checked: 2 s of them.
const VALUES: u64 = 100;
/// Number of values before them: connections are established again meanwhile.
const AFTER: u64 = 50;

struct Scenario {
    hosts: Hosts,
    directory: TestDirectory,
    group: SocketAddrV4,
}

impl Scenario {
    fn new(addresses: Addresses) -> Option<Self> {
        let hosts = Hosts::with_addresses(2, 1, addresses);
        let hosts =
            hosts.inspect_err(|why| println!("skipped: no such hosts can be made here: {why}")).ok()?;
        for host in hosts.all() {
            // A bridge lets a packet of several segments pass, however long these are.
            host.ip("link set eth0 gso_max_segs 1").unwrap_or_else(|error| panic!("{error}"));
        }
        Some(Self { hosts, directory: TestDirectory::new(), group: own_group() })
    }

    /// Starts both nodes, each on its interface; the first streams to the second. `gncl` adds lines to that
    /// table.
    fn start(&self, interfaces: [&str; 2], gncl: &str) -> [NodeProcess; 2] {
        let lengths: Vec<_> = LENGTHS.iter().map(ToString::to_string).collect();
        let mut streams = vec!["--logs-info", "--streams-to", "hip"];
        streams.extend(lengths.iter().flat_map(|length| ["--stream", length]));
        let start = |nth: usize, more: &[&str]| {
            let (name, interface) = (["central", "hip"][nth], interfaces[nth]);
            let text = format!(
                "[node]\nname = \"{name}\"\nproject = \"lengths\"\naddress = \"10.77.0.{}\"\n[gncl]\n{gncl}\n\
                 [ndl]\nmdns_port = false\nmulticast = \"{}\"\ninterface = \"{interface}\"\n",
                nth + 1,
                self.group
            );
            let path = self.directory.write(&format!("{name}.toml"), &text);
            node_under_test(Some(&self.hosts.all()[nth]), &path, more)
        };
        [start(0, &streams), start(1, &["--logs-info"])]
    }
}

/// The length and the number, from a line that reports a value.
fn value_in(line: &str) -> Option<(usize, u64)> {
    let words: Vec<_> = line.split(' ').collect();
    match words[..] {
        ["sized", length, "number", number] => Some((length.parse().ok()?, number.parse().ok()?)),
        _ => None,
    }
}

/// The number of the last value of this length that arrived.
fn last(hip: &NodeProcess, length: usize) -> u64 {
    let numbers = hip.output().iter().filter_map(|line| value_in(line)).filter(|(of, _)| *of == length);
    numbers.map(|(_, number)| number).max().unwrap_or_default()
}

/// Checks that each length arrives, and that a second later about as many values of each have arrived as of
/// the shortest.
fn all_arrive(hip: &mut NodeProcess) {
    let from = LENGTHS.map(|length| {
        let words = format!("sized {length} number ");
        hip.wait_for(&[&words]);
        last(hip, length) + AFTER
    });
    let mut came = Vec::new();
    for (length, from) in LENGTHS.into_iter().zip(from) {
        let until = from + VALUES;
        while last(hip, length) < until {
            hip.wait_for(&[&format!("sized {length} number ")]);
        }
        let values = hip.output().iter().filter_map(|line| value_in(line));
        came.push(values.filter(|(of, number)| *of == length && (from..until).contains(number)).count());
    }
    // Delays of the host itself affect all lengths alike.
    let shortest = came[0];
    assert!(
        shortest > 0 && came.iter().all(|count| *count >= shortest * 8 / 10),
        "of {LENGTHS:?} came {came:?}"
    );
}

fn says_what_arrives(central: &mut NodeProcess) {
    let line = central.wait_for(&["WARN", "datagrams (UDP) of more than", "do not arrive"]);
    assert!(line.contains("MTU"), "{line}");
    let warnings = central.output().iter().filter(|line| line.contains("do not arrive at this node")).count();
    assert_eq!(warnings, 1, "once");
}

#[test]
fn short_path_delivers_every_length_and_warns() {
    let Some(scenario) = Scenario::new(Addresses::Ipv4) else { return };
    scenario.hosts.all()[1]
        .ip(&format!("link set eth0 mtu {SHRUNK}"))
        .unwrap_or_else(|error| panic!("{error}"));
    let [mut central, mut hip] = scenario.start(["10.77.0.1", "10.77.0.2"], "");
    says_what_arrives(&mut central);
    all_arrive(&mut hip);
}

#[test]
fn ipv6_path_that_shrinks_and_grows_delivers_every_length() {
    let Some(scenario) = Scenario::new(Addresses::LinkLocal) else { return };
    let [mut central, mut hip] = scenario.start(["eth0/ipv6", "eth0/ipv6"], "");
    all_arrive(&mut hip);
    assert!(central.output().iter().all(|line| !line.contains("do not arrive")), "{:?}", central.output());
    scenario.hosts.limit_packets(1, SHRUNK);
    says_what_arrives(&mut central);
    all_arrive(&mut hip);
    scenario.hosts.limit_packets(1, 1_500);
    central.wait_for(&["datagrams (UDP) of every length arrive"]);
    all_arrive(&mut hip);
}

#[test]
fn connections_alone_carry_every_length() {
    let Some(scenario) = Scenario::new(Addresses::Ipv4) else { return };
    scenario.hosts.limit_packets(1, SHRUNK);
    let [central, mut hip] = scenario.start(["10.77.0.1", "10.77.0.2"], "datagrams = false");
    // The connection stalls for about 4 s.
    while last(&hip, 1_112) < 300 {
        hip.wait_for(&["sized 1112 number "]);
    }
    all_arrive(&mut hip);
    let warns = |mut node: NodeProcess| {
        node.signal(Signal::TERM);
        node.wait_for_exit();
        node.output().iter().any(|line| line.contains("short segments"))
    };
    // Either side may have noticed first.
    let warned = [central, hip].map(warns);
    assert!(warned.contains(&true), "no node warns");
}
