//! Topology files: valid ones, rejected ones, and the error texts.

use std::collections::BTreeSet;
use std::ffi::OsStr;
use std::path::Path;

use exoskeleton::robot::topology::{ControlThread, Topology, for_this_host};
use exoskeleton_model::joint::Joint;
use exoskeleton_model::part::Part;
use proptest::prelude::*;

const EXAMPLE: &str = include_str!("../../topology.toml");

/// The example with one text replaced, which must be in it.
fn with(old: &str, new: &str) -> String {
    assert!(EXAMPLE.contains(old), "{old}");
    EXAMPLE.replacen(old, new, 1)
}

fn faults(text: &str) -> Vec<String> {
    Topology::parse(text).expect_err("a fault").0
}

#[test]
fn example_file_matches_its_comments() {
    let topology = Topology::parse(EXAMPLE).unwrap();
    assert_eq!(topology.control.thread, ControlThread::Io);
    assert_eq!(topology.joints[Joint::Knee.index()].address, [10, 0, 0, 3].into());
    let config = topology.node_config(Part::Central);
    assert_eq!((config.project.as_str(), config.ndl.period.as_millis()), ("my-leg", 500));
    assert_eq!(config.lncl.socket.as_deref(), Some(Path::new("/tmp/sinew-central.sock")));
    let socket = |joint| topology.node_config(Part::Joint(joint)).lncl.socket;
    assert_eq!(socket(Joint::Hip).as_deref(), Some(Path::new("/tmp/sinew-hip.sock")));
    assert_eq!(socket(Joint::Knee), None);
}

#[test]
fn topology_for_one_host_has_distinct_nodes() {
    let topology = Topology::parse(include_str!("../../here.toml")).unwrap();
    let nodes = Part::ALL.map(|part| topology.node_config(part));
    let addresses: BTreeSet<_> = nodes.iter().map(|config| config.node_address().to_string()).collect();
    let sockets: BTreeSet<_> = nodes.iter().map(|config| config.lncl.socket.clone()).collect();
    assert_eq!((addresses.len(), sockets.len()), (4, 4));
    // `sinew up` asks the nodes at the sockets that its own file names.
    let robot = include_str!("../../robot.toml");
    for config in nodes {
        let socket = config.lncl.socket.expect("each has one").display().to_string();
        assert!(robot.contains(&format!("socket = \"{socket}\"")), "{socket}");
    }
}

#[test]
fn topology_file_of_a_local_run_reads_back() {
    let topology = for_this_host(7).unwrap();
    assert_eq!(Topology::parse(&topology.to_toml()), Ok(topology));
}

#[test]
fn every_node_has_a_journal_of_its_own() {
    let text = EXAMPLE.replacen("# [record]", "[record]", 1).replacen("# folder =", "folder =", 1);
    let topology = Topology::parse(&text.replacen("# frozen_folder =", "frozen_folder =", 1)).unwrap();
    assert_eq!(Topology::parse(&topology.to_toml()).as_ref(), Ok(&topology));
    let mut folders = BTreeSet::new();
    for part in Part::ALL {
        let config = topology.node_config(part);
        assert!(config.validate().is_ok(), "{:?}", config.validate());
        assert_eq!(config.record.frozen_folder.as_deref(), Some(Path::new("/var/log/my-leg")));
        assert!(folders.insert(config.record.folder.expect("it records")), "{part} has another's");
    }
    assert!(faults(&text)[0].contains("frozen_folder"), "both folders are needed");
    assert_eq!(for_this_host(7).unwrap().node_config(Part::Central).record.folder, None);
}

#[test]
fn sinew_finds_the_socket_of_every_local_node() {
    let topology = for_this_host(7).unwrap();
    let id = std::process::id().to_string();
    let mut seen = BTreeSet::new();
    for part in Part::ALL {
        let socket = topology.node_config(part).lncl.socket.expect("a door");
        let name = socket.file_name().and_then(OsStr::to_str).expect("a name");
        // The names that `sinew` searches in /tmp; parallel runs differ by their process.
        assert!(name.starts_with("sinew-") && name.ends_with(".sock"), "{name}");
        assert!(name.contains(&id) && name.contains(part.name()), "{name}");
        assert_eq!(socket.parent(), Some(std::env::temp_dir().as_path()));
        assert!(seen.insert(socket), "{part} has another's");
    }
}

#[test]
fn all_faults_are_reported_together() {
    let text = EXAMPLE
        .replacen("\"my-leg\"", "\"\"", 1)
        .replacen("address = \"10.0.0.2\"", "address = \"10.0.0.300\"", 1)
        .replacen("address = \"10.0.0.3\"", "address = \"10.0.0.1\"", 1)
        .replacen("period_ms = 500", "period_ms = 5", 1)
        .replacen("10.0.0.9:6920", "10.0.0.9", 1);
    let text = faults(&text).join("\n");
    for expected in ["project", "hip.address", "knee.address", "discovery.period_ms", "plant.address"] {
        assert!(text.contains(expected), "{expected} is missing in:\n{text}");
    }
}

#[test]
fn nodes_that_could_never_connect_are_rejected() {
    let off = with("multicast = \"239.255.83.119:6910\"", "multicast = \"off\"").replacen(
        "mdns = true",
        "mdns = false",
        1,
    );
    assert!(faults(&off)[0].contains("cannot find each other"));
    let mixed = with("interface = \"10.0.0.1\"", "interface = \"127.0.0.1\"");
    assert!(faults(&mixed)[0].contains("loopback"));
}

#[test]
fn ipv6_node_reads_back_as_written() {
    let text = EXAMPLE
        .replacen("interface = \"10.0.0.1\"", "interface = \"eth0/ipv6\"", 1)
        .replacen("address = \"10.0.0.2\"", "address = \"10.0.0.2\"\ninterface = \"fe80::2%eth0\"", 1)
        .replacen("10.0.0.1:6911", "[fe80::1%eth0]:6911", 1);
    let topology = Topology::parse(&text).unwrap();
    assert_eq!(topology.central.interface.to_string(), "eth0/ipv6");
    assert_eq!(topology.joints[0].interface.to_string(), "fe80::2%eth0");
    assert_eq!(topology.joints[2].seeds[0].to_string(), "[fe80::1%eth0]:6911");
    let written = topology.to_toml();
    assert_eq!(Topology::parse(&written).unwrap(), topology, "{written}");
    let slip = EXAMPLE.replacen("interface = \"10.0.0.1\"", "interface = \"fe80::zz\"", 1);
    assert!(faults(&slip)[0].contains("central.interface"));
}

#[test]
fn priority_of_the_network_thread_is_rejected() {
    let text = with("# realtime_priority = 50 ", "realtime_priority = 50 #");
    assert!(faults(&text)[0].contains("control.thread = \"own\""));
    let own = text.replacen("thread = \"io\" ", "thread = \"own\"", 1);
    assert_eq!(Topology::parse(&own).unwrap().control.realtime_priority, Some(50));
}

#[test]
fn key_that_does_not_exist_is_named() {
    assert!(faults(&with("mdns = true", "mdsn = true"))[0].contains("mdsn"));
}

#[test]
fn seed_without_port_and_overlong_socket_path_are_rejected() {
    assert!(faults(&with("10.0.0.1:6911", "10.0.0.1:0"))[0].contains("port 0"));
    for (length, is_legal) in [(0, false), (1, true), (100, true), (101, false)] {
        let text = with("/tmp/sinew-hip.sock", &"x".repeat(length));
        let text = Topology::parse(&text).map_or_else(|faults| faults.0, |_| Vec::new()).join("\n");
        assert_eq!(text.is_empty(), is_legal, "{length}: {text}");
        assert!(is_legal || text.contains(&format!("hip.socket has {length} bytes")), "{text}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn damaged_example_gives_a_topology_or_faults(at in 0usize..3000, junk in "\\PC{0,12}") {
        let at = EXAMPLE.char_indices().map(|(at, _)| at).nth(at).unwrap_or(0);
        let _ = Topology::parse(&format!("{}{junk}{}", &EXAMPLE[..at], &EXAMPLE[at..]));
    }
}
