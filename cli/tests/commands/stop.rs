//! `sinew stop`: presses, shows and releases the stop of two nodes, one of which may not run.

use rustix::process::Signal;
use serde_json::Value;

use crate::scenario::{Scenario, named};

/// Whether the node knows another one, and no stop is in force.
fn knows_two(json: &Value) -> bool {
    json["state"] == "released" && json["nodes"].as_array().is_some_and(|nodes| nodes.len() == 2)
}

#[test]
fn press_is_confirmed_shown_and_released() {
    let scenario = Scenario::new();
    let _hip = scenario.start("hip", 1, &[]);
    let _knee = scenario.start("knee", 2, &[]);
    scenario.until("they know each other", "hip", &["stop", "status"], knows_two);
    let answer = scenario.sinew("hip", &["stop", "status"]);
    assert_eq!(answer.code, Some(0), "{}{}", answer.out, answer.err);
    // When
    let answer = scenario.sinew("hip", &["stop", "press", "the person stumbles", "--within-ms", "20000"]);
    // Then
    assert_eq!(answer.code, Some(0), "{}{}", answer.out, answer.err);
    assert!(answer.out.contains("2 of 2 nodes have confirmed"), "{}", answer.out);
    // And: the other node says so, too
    let answer = scenario.sinew("knee", &["stop", "status"]);
    assert_eq!(answer.code, Some(1), "{}{}", answer.out, answer.err);
    assert!(answer.out.contains("the person stumbles"), "{}", answer.out);
    // And: the list of the nodes begins with it
    scenario.until("it has both confirmations", "knee", &["nodes"], |json| {
        let nodes = json["stop"]["nodes"].as_array();
        nodes.is_some_and(|nodes| nodes.iter().all(|node| node["confirmed_us"].is_u64()))
    });
    let answer = scenario.sinew("knee", &["nodes"]);
    assert_eq!(answer.code, Some(1), "{}{}", answer.out, answer.err);
    assert!(answer.out.starts_with("STOPPED: pressed at node "), "{}", answer.out);
    assert!(answer.out.contains("2 of 2 nodes have confirmed; `sinew stop status`"), "{}", answer.out);
    // And: it is released there
    let answer = scenario.sinew("knee", &["stop", "release", "--within-ms", "20000"]);
    assert_eq!(answer.code, Some(0), "{}{}", answer.out, answer.err);
    scenario.until("no node is stopped", "hip", &["stop", "status"], knows_two);
}

#[test]
fn paused_node_is_named_and_comes_up_stopped() {
    let scenario = Scenario::new();
    let _hip = scenario.start("hip", 1, &[]);
    let knee = scenario.start("knee", 2, &[]);
    scenario.until("they know each other", "hip", &["stop", "status"], knows_two);
    // Given: the knee's process is stopped
    knee.pause();
    // When
    let answer = scenario.sinew("hip", &["stop", "press", "--within-ms", "200", "--json"]);
    // Then
    assert_eq!(answer.code, Some(1), "{}{}", answer.out, answer.err);
    let json = answer.json();
    let [hip, knee_row] =
        ["hip", "knee"].map(|name| named(&json["nodes"], name).expect("it is named").clone());
    assert!(hip["confirmed_us"].is_u64() && knee_row["confirmed_us"].is_null(), "{json}");
    assert_eq!(knee_row["bound_us"], 0, "no application guards an output there: {json}");
    // And: the list of the nodes names it, too
    let nodes = scenario.sinew("hip", &["nodes"]).out;
    assert!(nodes.contains("1 of 2 nodes have confirmed; NOT CONFIRMED: knee; "), "{nodes}");
    let json = scenario.sinew("hip", &["nodes", "--json"]).json();
    let knee_row = named(&json["stop"]["nodes"], "knee").expect("it is named");
    assert!(json["stop"]["state"] == "stopped" && knee_row["confirmed_us"].is_null(), "{json}");
    // When: it runs again
    knee.signal(Signal::CONT);
    // Then
    scenario.until("it has confirmed", "hip", &["stop", "status"], |json| {
        named(&json["nodes"], "knee").is_some_and(|knee| knee["confirmed_us"].is_u64())
    });
    scenario.until("it is stopped", "knee", &["stop", "status"], |json| json["state"] == "stopped");
}

#[test]
fn release_without_the_role_is_refused() {
    let scenario = Scenario::new();
    let path = scenario.directory.join("access.toml");
    std::fs::write(&path, "[[rule]]\nfrom = ['*']\nto = ['*']\n").expect("the test's own directory");
    let section = format!("[security]\naccess = \"{}\"\n[lncl]", path.display());
    let _knee = scenario.start_changed("knee", 2, &[("[lncl]", &section)], &[]);
    // It looks for others before it says that all have confirmed.
    let answer = scenario.sinew("knee", &["stop", "press", "--within-ms", "20000"]);
    assert_eq!(answer.code, Some(0), "{}{}", answer.out, answer.err);
    let answer = scenario.sinew("knee", &["stop", "release"]);
    assert!(answer.code == Some(1) && answer.out.contains("[roles]"), "{}{}", answer.out, answer.err);
    assert_eq!(scenario.sinew("knee", &["stop", "status"]).code, Some(1));
}
