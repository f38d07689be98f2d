//! Faults in the robot while it walks.

use crate::{alone, end, folder, start};

/// Does the steps in their short form; the report, all of whose claims that concern function held.
fn report_of(name: &str, steps: &str) -> serde_json::Value {
    let _alone = alone();
    let folder = folder(name);
    let (report, runs) = (folder.join("report.json"), folder.join("runs"));
    let (runs_text, report_text) = (runs.display().to_string(), report.display().to_string());
    let arguments = ["faults", "--short", "--only", steps, "--runs", &runs_text, "--report", &report_text];

    let output = end(start(&folder, &arguments), steps);

    let told = String::from_utf8_lossy(&output.stdout);
    let failed = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(0), "{told}\n{failed}");
    let text = std::fs::read_to_string(&report).expect("a report was written");
    let report: serde_json::Value = serde_json::from_str(&text).expect("it is JSON");
    assert_eq!(report["faults"]["functional_held"], true, "{report:#}");
    std::fs::remove_dir_all(&folder).expect("the folder of this test");
    report["faults"].clone()
}

fn claims_of(name: &str, steps: &str) -> Vec<serde_json::Value> {
    report_of(name, steps)["claims"].as_array().expect("a list").clone()
}

fn seen(claims: &[serde_json::Value], name: &str) -> f64 {
    let claim =
        claims.iter().find(|claim| claim["name"] == name).unwrap_or_else(|| panic!("{name}: {claims:#?}"));
    claim["seen"].as_f64().unwrap_or_else(|| panic!("{claim:#}"))
}

#[test]
fn drive_that_is_killed_or_hangs_is_replaced_while_hip_and_ankle_walk_on() {
    let claims = claims_of("drive", "4,5");
    assert!(seen(&claims, "the knee is flagged, if it died or was away for 50 ms") > 0.5);
    assert!(seen(&claims, "torques from stale inputs") < 0.5);
}

#[test]
fn e_stop_is_latched_and_insane_commands_change_nothing() {
    let claims = claims_of("stop", "8,9");
    assert!(seen(&claims, "resume is refused") > 0.5);
    assert!(seen(&claims, "NaN refused") > 0.5);
}

#[test]
fn node_whose_link_is_cut_is_lost_on_both_sides_and_goes_on_in_the_same_life_when_it_is_joined() {
    let report = report_of("link", "link-down");
    let claims = report["claims"].as_array().expect("a list");
    if claims.is_empty() {
        let why = report["skipped"][0].as_str().expect("the reason is told");
        assert!(why.contains("no hosts can be made here"), "{why}");
        println!("skipped: {why}");
        return;
    }
    assert!(seen(claims, "NODE_LOST at every other node after, ms") > 0.0);
    assert!(seen(claims, "NODE_LOST of every other at the knee after, ms") > 0.0);
    assert!(seen(claims, "it joins with the epoch that it had") > 0.5);
}
