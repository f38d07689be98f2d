//! Nodes with keys made by `sinew keys`, beside nodes without keys or with other keys.

use std::path::Path;

use serde_json::Value;
use sinew_testkit::NodeProcess;

use crate::scenario::{Scenario, blocked, named, sinew};

/// Makes the keys of a separate project in this directory of the test.
pub(crate) fn make_keys(scenario: &Scenario, directory: &str, nodes: &[&str]) {
    make_keys_for(scenario, directory, "365", nodes);
}

/// The same, valid for this number of days.
fn make_keys_for(scenario: &Scenario, directory: &str, days: &str, nodes: &[&str]) {
    let out = scenario.directory.join(directory);
    let out = out.to_str().expect("a path of the test's own");
    let init = ["keys", "init", "cli", "--days", days, "--out", out];
    let answer = sinew(&[&init, nodes].concat(), Path::new("/"));
    assert_eq!(answer.code, Some(0), "{}{}", answer.out, answer.err);
}

/// Starts a node with its keys in `directory`.
fn secured(scenario: &Scenario, directory: &str, name: &str, address: u8, more: &[&str]) -> NodeProcess {
    let keys = scenario.directory.join(&format!("{directory}/nodes/{name}"));
    let section = format!("[security]\nkeys = \"{}\"\n[lncl]", keys.display());
    scenario.start_changed(name, address, &[("[lncl]", &section)], more)
}

fn names(json: &Value) -> Vec<&str> {
    let nodes = json["nodes"].as_array().expect("a list");
    nodes.iter().filter_map(|node| node["name"].as_str()).collect()
}

#[test]
fn only_nodes_of_one_project_connect() {
    // Given: beside them, in their group and with their project's name, two nodes without keys, and one with other keys
    let scenario = Scenario::new();
    make_keys(&scenario, "keys", &["hip=127.0.0.1", "knee=127.0.0.2"]);
    make_keys(&scenario, "others", &["thief=127.0.0.5"]);
    let _spies = [
        scenario.start("spy", 3, &[]),
        scenario.start("spy2", 4, &[]),
        secured(&scenario, "others", "thief", 5, &[]),
    ];
    scenario.until("nodes without keys find each other", "spy", &["nodes"], |json| names(json).len() == 2);
    // When
    let mut hip = secured(&scenario, "keys", "hip", 1, &["--requires", "knee", "--sends-to", "knee"]);
    let mut knee = secured(&scenario, "keys", "knee", 2, &[]);
    // Then
    hip.wait_for(&["started"]);
    knee.wait_for(&["count 50 "]);
    let json = scenario.until("all connections are up", "hip", &["nodes"], |json| {
        let links = named(&json["nodes"], "knee").and_then(|node| node["links"].as_array());
        links.is_some_and(|links| links.len() == 3 && links.iter().all(|link| link["up"] == true))
    });
    assert_eq!(names(&json), ["hip", "knee"], "{json}");
    for (outside, knows) in [("spy", 2), ("thief", 1)] {
        let json = scenario.sinew(outside, &["nodes", "--json"]).json();
        assert_eq!(names(&json).len(), knows, "{outside}: {json}");
    }
}

#[test]
fn restarted_node_is_found_again_after_a_kill() {
    let scenario = Scenario::new();
    make_keys(&scenario, "keys", &["hip=127.0.0.1", "knee=127.0.0.2"]);
    let _hip = secured(&scenario, "keys", "hip", 1, &["--requires", "knee", "--sends-to", "knee"]);
    for _ in 0..3 {
        let mut knee = secured(&scenario, "keys", "knee", 2, &[]);
        knee.wait_for(&["count"]);
    }
}

#[test]
fn doctor_and_nodes_show_open_nodes_and_expiry() {
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
        let json = scenario.sinew(name, &["doctor", "--json"]).json();
        let checks = json["checks"].as_array().expect("a list");
        checks.iter().find(|check| check["check"] == "security").expect("it is there").clone()
    };
    let listed = |name: &str| {
        let json = scenario.sinew(name, &["nodes", "--json"]).json();
        named(&json["nodes"], name).expect("itself")["security"].clone()
    };
    // Then: in whole days; the first day may have begun
    let (hip, knee, spy) = (security("hip"), security("knee"), security("spy"));
    let has = |check: &Value, days: [u64; 2]| {
        let seen = check["detail"].as_str().expect("words");
        days.iter().any(|days| seen.contains(&format!("({days} days)")))
    };
    assert!(hip["fine"] == true && has(&hip, [364, 365]), "{hip}");
    assert!(knee["fine"] == false && has(&knee, [9, 10]), "{knee}");
    assert!(
        knee["suggested_fix"].as_str().is_some_and(|fix| fix.contains("sinew keys issue knee")),
        "{knee}"
    );
    assert!(
        spy["fine"] == true
            && spy["detail"].as_str().is_some_and(|seen| seen.starts_with("open to every user of this host")),
        "{spy}"
    );
    let (hip, knee, spy) = (listed("hip"), listed("knee"), listed("spy"));
    let left = |json: &Value| json["certificate"]["days_left"].as_u64().expect("a number");
    assert!(hip["state"] == "secured" && [364, 365].contains(&left(&hip)), "{hip}");
    assert!(knee["state"] == "ends soon" && [9, 10].contains(&left(&knee)), "{knee}");
    assert_eq!((&spy["secured"], &spy["beyond_host"]), (&false.into(), &false.into()), "{spy}");
    let table = scenario.sinew("hip", &["nodes"]).out;
    assert!(table.contains("KEYS") && (table.contains("364 d") || table.contains("365 d")), "{table}");
}

#[test]
fn why_names_missing_keys_as_the_cause() {
    let scenario = Scenario::new();
    make_keys(&scenario, "keys", &["hip=127.0.0.1"]);
    let _nodes = [secured(&scenario, "keys", "hip", 1, &[]), scenario.start("knee", 2, &[])];
    for here in ["hip", "knee"] {
        let answer = scenario.sinew(here, &["why", "hip", "knee", "--json"]);
        let steps = blocked(&answer.json());
        assert!(answer.code == Some(1) && steps.contains("hip has keys, and knee has none"), "{steps}");
        assert!(steps.contains("sinew keys issue knee=127.0.0.2") && !steps.contains("firewall"), "{steps}");
    }
}

#[test]
fn why_shows_the_fault_of_a_revoked_certificate() {
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
    let json = scenario.until("a try has failed", "hip", &["why", "hip", "knee"], |json| {
        blocked(json).contains("`sinew keys issue NODE --keys DIR`, where ca.key is, makes it another\"\n")
    });
    let steps = blocked(&json);
    assert!(steps.contains("is revoked") && !steps.contains("TCP does not reach"), "{steps}");
}
