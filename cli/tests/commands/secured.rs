//! Nodes whose keys `sinew keys` made, and those beside them that have none, or others.

use std::path::Path;

use serde_json::Value;
use sinew_tests::Program;

use crate::scenario::{Scenario, named, sinew};

/// Keys of a project of their own, in this directory of the test's.
pub(crate) fn make_keys(scenario: &Scenario, directory: &str, nodes: &[&str]) {
    make_keys_for(scenario, directory, "365", nodes);
}

/// For so many days.
fn make_keys_for(scenario: &Scenario, directory: &str, days: &str, nodes: &[&str]) {
    let out = scenario.directory.join(directory);
    let out = out.to_str().expect("a path of the test's own");
    let init = ["keys", "init", "cli", "--days", days, "--out", out];
    let answer = sinew(&[&init, nodes].concat(), Path::new("/"));
    assert_eq!(answer.code, Some(0), "{}{}", answer.out, answer.err);
}

/// A node with its keys in `directory`.
fn secured(scenario: &Scenario, directory: &str, name: &str, address: u8, more: &[&str]) -> Program {
    let keys = scenario.directory.join(&format!("{directory}/nodes/{name}"));
    let section = format!("[security]\nkeys = \"{}\"\n[lncl]", keys.display());
    scenario.start_changed(name, address, &[("[lncl]", &section)], more)
}

fn names(said: &Value) -> Vec<&str> {
    let nodes = said["nodes"].as_array().expect("a list");
    nodes.iter().filter_map(|node| node["name"].as_str()).collect()
}

#[test]
fn nodes_with_keys_of_one_project_find_each_other_and_nobody_else() {
    // Given: beside them, in their group and under their project's name, two nodes without keys, and one with keys of its own
    let scenario = Scenario::new();
    make_keys(&scenario, "keys", &["hip=127.0.0.1", "knee=127.0.0.2"]);
    make_keys(&scenario, "others", &["thief=127.0.0.5"]);
    let _spies = [
        scenario.start("spy", 3, &[]),
        scenario.start("spy2", 4, &[]),
        secured(&scenario, "others", "thief", 5, &[]),
    ];
    scenario.until("nodes without keys find each other", "spy", &["nodes"], |said| names(said).len() == 2);
    // When
    let mut hip = secured(&scenario, "keys", "hip", 1, &["--requires", "knee", "--sends-to", "knee"]);
    let mut knee = secured(&scenario, "keys", "knee", 2, &[]);
    // Then
    hip.wait_for(&["started"]);
    knee.wait_for(&["count 50 "]);
    let said = scenario.until("all connections are up", "hip", &["nodes"], |said| {
        let links = named(&said["nodes"], "knee").and_then(|node| node["links"].as_array());
        links.is_some_and(|links| links.len() == 3 && links.iter().all(|link| link["up"] == true))
    });
    assert_eq!(names(&said), ["hip", "knee"], "{said}");
    for (outside, knows) in [("spy", 2), ("thief", 1)] {
        let said = scenario.sinew(outside, &["nodes", "--json"]).json();
        assert_eq!(names(&said).len(), knows, "{outside}: {said}");
    }
}

#[test]
fn a_node_that_is_killed_is_found_again_in_its_next_life() {
    let scenario = Scenario::new();
    make_keys(&scenario, "keys", &["hip=127.0.0.1", "knee=127.0.0.2"]);
    let _hip = secured(&scenario, "keys", "hip", 1, &["--requires", "knee", "--sends-to", "knee"]);
    for _ in 0..3 {
        let mut knee = secured(&scenario, "keys", "knee", 2, &[]);
        knee.wait_for(&["count"]);
    }
}

#[test]
fn the_doctor_and_the_list_of_nodes_say_who_is_open_and_when_a_certificate_ends() {
    // Given: a node without keys, one with keys for a year, and one with keys for ten days
    let scenario = Scenario::new();
    make_keys(&scenario, "keys", &["hip=127.0.0.1"]);
    make_keys_for(&scenario, "short", "10", &["knee=127.0.0.2"]);
    let _nodes = [
        secured(&scenario, "keys", "hip", 1, &[]),
        secured(&scenario, "short", "knee", 2, &[]),
        scenario.start("spy", 3, &[]),
    ];
    // When
    let security = |name: &str| {
        let said = scenario.sinew(name, &["doctor", "--json"]).json();
        let checks = said["checks"].as_array().expect("a list");
        checks.iter().find(|check| check["check"] == "security").expect("it is there").clone()
    };
    let listed = |name: &str| {
        let said = scenario.sinew(name, &["nodes", "--json"]).json();
        named(&said["nodes"], name).expect("itself")["security"].clone()
    };
    // Then: whole days, of which the first may have begun
    let (hip, knee, spy) = (security("hip"), security("knee"), security("spy"));
    let has = |check: &Value, days: [u64; 2]| {
        let seen = check["seen"].as_str().expect("words");
        days.iter().any(|days| seen.contains(&format!("({days} days)")))
    };
    assert!(hip["fine"] == true && has(&hip, [364, 365]), "{hip}");
    assert!(knee["fine"] == false && has(&knee, [9, 10]), "{knee}");
    assert!(knee["mend"].as_str().is_some_and(|mend| mend.contains("sinew keys issue knee")), "{knee}");
    assert!(
        spy["fine"] == true
            && spy["seen"].as_str().is_some_and(|seen| seen.starts_with("open to every user of this host")),
        "{spy}"
    );
    let (hip, knee, spy) = (listed("hip"), listed("knee"), listed("spy"));
    let left = |said: &Value| said["certificate"]["days_left"].as_u64().expect("a number");
    assert!(hip["state"] == "secured" && [364, 365].contains(&left(&hip)), "{hip}");
    assert!(knee["state"] == "ends soon" && [9, 10].contains(&left(&knee)), "{knee}");
    assert_eq!((&spy["secured"], &spy["beyond_host"]), (&false.into(), &false.into()), "{spy}");
    let table = scenario.sinew("hip", &["nodes"]).out;
    assert!(table.contains("KEYS") && (table.contains("364 d") || table.contains("365 d")), "{table}");
}

/// What is in the way from the hip to another node, in words.
fn in_the_way(said: &Value) -> String {
    let steps = said["steps"].as_array().expect("a list").iter();
    let blocked = steps.filter(|step| step["state"] == "blocked");
    blocked.map(|step| format!("{}: {} - {}\n", step["step"], step["seen"], step["mend"])).collect()
}

#[test]
fn why_says_of_a_node_with_keys_and_one_without_that_this_is_it() {
    let scenario = Scenario::new();
    make_keys(&scenario, "keys", &["hip=127.0.0.1"]);
    let _nodes = [secured(&scenario, "keys", "hip", 1, &[]), scenario.start("knee", 2, &[])];
    for here in ["hip", "knee"] {
        let answer = scenario.sinew(here, &["why", "hip", "knee", "--json"]);
        let said = in_the_way(&answer.json());
        assert!(answer.code == Some(1) && said.contains("hip has keys, and knee has none"), "{said}");
        assert!(said.contains("sinew keys issue knee=127.0.0.2") && !said.contains("firewall"), "{said}");
    }
}

#[test]
fn why_says_of_a_revoked_certificate_what_its_fault_says_and_blames_no_network() {
    let scenario = Scenario::new();
    make_keys(&scenario, "keys", &["hip=127.0.0.1", "knee=127.0.0.2"]);
    let mut hip = secured(&scenario, "keys", "hip", 1, &["--requires", "knee"]);
    let _knee = secured(&scenario, "keys", "knee", 2, &[]);
    hip.wait_for(&["started"]);
    // When
    let keys = scenario.directory.join("keys");
    let keys = keys.to_str().expect("a path of the test's own");
    let revoked = sinew(&["keys", "revoke", "knee", "--keys", keys], Path::new("/"));
    assert_eq!(revoked.code, Some(0), "{}{}", revoked.out, revoked.err);
    scenario.sinew("hip", &["reload"]);
    // Then
    let said = scenario.until("a try has failed", "hip", &["why", "hip", "knee"], |said| {
        in_the_way(said).contains("`sinew keys issue NODE --keys DIR`, where ca.key is, makes it another\"\n")
    });
    let said = in_the_way(&said);
    assert!(said.contains("is revoked") && !said.contains("TCP does not reach"), "{said}");
}
