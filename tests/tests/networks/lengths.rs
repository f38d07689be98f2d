//! Two hosts between which long packets vanish and no ICMP says so: values of class Stream of every length arrive at their full rate.

use std::net::SocketAddrV4;

use rustix::process::Signal;
use sinew_hosts::Addresses;
use sinew_tests::{Hosts, OwnDirectory, Program, node_under_test, own_group};

/// Payloads, in bytes: below and above what such a network carries, the longest that a datagram takes, and one that goes by TCP in any case.
const LENGTHS: [usize; 7] = [32, 400, 700, 900, 1_100, 1_112, 1_400];
/// What a path carries that shrinks, in bytes.
const SHRUNK: u32 = 1_000;
/// Values of each length that are looked at: 2 s of them.
const VALUES: u64 = 100;
/// Those before: connections are made again meanwhile.
const AFTER: u64 = 50;

struct Scenario {
    hosts: Hosts,
    directory: OwnDirectory,
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
        Some(Self { hosts, directory: OwnDirectory::new(), group: own_group() })
    }

    /// Both nodes on this interface each, the first of which streams to the second; `gncl` is more of that table.
    fn start(&self, interfaces: [&str; 2], gncl: &str) -> [Program; 2] {
        let lengths: Vec<_> = LENGTHS.iter().map(ToString::to_string).collect();
        let mut streams = vec!["--logs-info", "--streams-to", "hip"];
        streams.extend(lengths.iter().flat_map(|length| ["--stream", length]));
        let start = |nth: usize, more: &[&str]| {
            let (name, interface) = (["central", "hip"][nth], interfaces[nth]);
            let path = self.directory.join(&format!("{name}.toml"));
            let text = format!(
                "[node]\nname = \"{name}\"\nproject = \"lengths\"\naddress = \"10.77.0.{}\"\n[gncl]\n{gncl}\n\
                 [ndl]\nmdns_port = false\nmulticast = \"{}\"\ninterface = \"{interface}\"\n",
                nth + 1,
                self.group
            );
            std::fs::write(&path, text).expect("the test's own directory");
            node_under_test(Some(&self.hosts.all()[nth]), &path, more)
        };
        [start(0, &streams), start(1, &["--logs-info"])]
    }
}

/// The length and the number in a line that says which value came.
fn value_in(line: &str) -> Option<(usize, u64)> {
    let words: Vec<_> = line.split(' ').collect();
    match words[..] {
        ["sized", length, "number", number] => Some((length.parse().ok()?, number.parse().ok()?)),
        _ => None,
    }
}

/// The number of the last value of this length that came.
fn last(hip: &Program, length: usize) -> u64 {
    let numbers = hip.said().iter().filter_map(|line| value_in(line)).filter(|(of, _)| *of == length);
    numbers.map(|(_, number)| number).max().unwrap_or_default()
}

/// Each length arrives; a second later as many values of each do as of the shortest, but for some.
fn all_arrive(hip: &mut Program) {
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
        let values = hip.said().iter().filter_map(|line| value_in(line));
        came.push(values.filter(|(of, number)| *of == length && (from..until).contains(number)).count());
    }
    // What the host itself holds up it holds up alike.
    let shortest = came[0];
    assert!(
        shortest > 0 && came.iter().all(|count| *count >= shortest * 8 / 10),
        "of {LENGTHS:?} came {came:?}"
    );
}

fn says_what_arrives(central: &mut Program) {
    let said = central.wait_for(&["WARN", "datagrams (UDP) of more than", "do not arrive"]);
    assert!(said.contains("MTU"), "{said}");
    let warnings = central.said().iter().filter(|line| line.contains("do not arrive at this node")).count();
    assert_eq!(warnings, 1, "once");
}

#[test]
fn where_the_other_end_takes_shorter_packets_every_length_arrives_and_a_warning_says_which_do_not() {
    let Some(scenario) = Scenario::new(Addresses::Ipv4) else { return };
    scenario.hosts.all()[1]
        .ip(&format!("link set eth0 mtu {SHRUNK}"))
        .unwrap_or_else(|error| panic!("{error}"));
    let [mut central, mut hip] = scenario.start(["10.77.0.1", "10.77.0.2"], "");
    says_what_arrives(&mut central);
    all_arrive(&mut hip);
}

#[test]
fn over_ipv6_a_path_that_shrinks_while_it_is_used_delivers_every_length_and_is_used_wholly_when_it_grows() {
    let Some(scenario) = Scenario::new(Addresses::LinkLocal) else { return };
    let [mut central, mut hip] = scenario.start(["eth0/ipv6", "eth0/ipv6"], "");
    all_arrive(&mut hip);
    assert!(central.said().iter().all(|line| !line.contains("do not arrive")), "{:?}", central.said());
    scenario.hosts.limit_packets(1, SHRUNK);
    says_what_arrives(&mut central);
    all_arrive(&mut hip);
    scenario.hosts.limit_packets(1, 1_500);
    central.wait_for(&["datagrams (UDP) of every length arrive"]);
    all_arrive(&mut hip);
}

#[test]
fn connections_alone_carry_every_length_where_long_packets_vanish() {
    let Some(scenario) = Scenario::new(Addresses::Ipv4) else { return };
    scenario.hosts.limit_packets(1, SHRUNK);
    let [central, mut hip] = scenario.start(["10.77.0.1", "10.77.0.2"], "datagrams = false");
    // Its connection stands still for some 4 s.
    while last(&hip, 1_112) < 300 {
        hip.wait_for(&["sized 1112 number "]);
    }
    all_arrive(&mut hip);
    let says = |mut node: Program| {
        node.signal(Signal::TERM);
        node.wait_for_end();
        node.said().iter().any(|line| line.contains("short segments"))
    };
    // Whichever side noticed first.
    let said = [central, hip].map(says);
    assert!(said.contains(&true), "nobody says so");
}
