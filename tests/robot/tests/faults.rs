//! Faults in the robot while it walks: real processes, real time. The tests assert no times.

use std::fs::File;
use std::process::Command;
use std::sync::LazyLock;

use sinew_robot_tests::process::{alone, end, folder, start};

const PROGRAM: &str = env!("CARGO_BIN_EXE_robot_faults");

/// Runs the steps in their short form; returns the report, after checking that all functional claims held.
fn report_of(name: &str, steps: &str) -> serde_json::Value {
    let _alone = alone();
    let folder = folder(name);
    let (report, runs) = (folder.join("report.json"), folder.join("runs"));
    let (runs_text, report_text) = (runs.display().to_string(), report.display().to_string());
    let arguments = ["--short", "--only", steps, "--runs", &runs_text, "--report", &report_text];

    let output = end(start(PROGRAM, &folder, &arguments, &[]), steps);

    let stdout = String::from_utf8_lossy(&output.stdout);
    let failed = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(0), "{stdout}\n{failed}");
    let text = std::fs::read_to_string(&report).expect("a report was written");
    let report: serde_json::Value = serde_json::from_str(&text).expect("it is JSON");
    assert_eq!(report["faults"]["functional_held"], true, "{report:#}");
    std::fs::remove_dir_all(&folder).expect("the folder of this test");
    report["faults"].clone()
}

/// The claims of steps 4, 5, 8 and 9, which one robot goes through: to start one and let it converge takes as long
/// as a step.
static CLAIMS: LazyLock<Vec<serde_json::Value>> =
    LazyLock::new(|| report_of("steps", "4,5,8,9")["claims"].as_array().expect("a list").clone());

fn seen(claims: &[serde_json::Value], name: &str) -> f64 {
    let claim =
        claims.iter().find(|claim| claim["name"] == name).unwrap_or_else(|| panic!("{name}: {claims:#?}"));
    claim["seen"].as_f64().unwrap_or_else(|| panic!("{claim:#}"))
}

#[test]
fn killed_or_hung_drive_is_replaced_while_others_walk() {
    assert!(seen(&CLAIMS, "the knee is flagged, if it died or was away for 50 ms") > 0.5);
    assert!(seen(&CLAIMS, "torques from stale inputs") < 0.5);
}

#[test]
fn e_stop_is_latched_and_insane_commands_change_nothing() {
    assert!(seen(&CLAIMS, "resume is refused") > 0.5);
    assert!(seen(&CLAIMS, "NaN refused") > 0.5);
}

#[test]
fn cut_link_loses_both_sides_and_keeps_the_incarnation() {
    let report = report_of("link", "link-down");
    let claims = report["claims"].as_array().expect("a list");
    if claims.is_empty() {
        let why = report["skipped"][0].as_str().expect("the reason is given");
        assert!(why.contains("no hosts can be made here"), "{why}");
        println!("skipped: {why}");
        return;
    }
    assert!(seen(claims, "NODE_LOST at every other node after, ms") > 0.0);
    assert!(seen(claims, "NODE_LOST of every other at the knee after, ms") > 0.0);
    assert!(seen(claims, "it joins with the epoch that it had") > 0.5);
}

#[test]
fn help_on_a_full_disk_is_an_error() {
    let full = File::options().write(true).open("/dev/full").expect("Linux has it");
    let output = Command::new(PROGRAM).arg("--help").stdout(full).output().expect("it was just built");
    let words = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{words}");
    assert!(words.contains("standard output is incomplete"), "{words}");
    // A pipe without a reader is none.
    let (reader, writer) = std::io::pipe().expect("a pipe");
    drop(reader);
    let output = Command::new(PROGRAM).arg("--help").stdout(writer).output().expect("it was just built");
    assert_eq!(output.status.code(), Some(0));
}
