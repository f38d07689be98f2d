//! `exoskeleton faults` as its users run it: real processes, real faults. Times are told, and nothing is asserted of them.

use std::path::PathBuf;
use std::process::{Command, Output, Stdio};
use std::sync::mpsc::sync_channel;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use rustix::process::{Pid, Signal, kill_process};

const PROGRAM: &str = env!("CARGO_BIN_EXE_exoskeleton");
const DEADLINE: Duration = Duration::from_secs(180);

/// A folder of this test's own.
fn folder(name: &str) -> PathBuf {
    let folder = std::env::temp_dir().join(format!("exoskeleton-test-{name}-{}", std::process::id()));
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(&folder).expect("a folder for this test");
    folder
}

fn run(arguments: &[&str]) -> Output {
    let mut command = Command::new(PROGRAM);
    command.args(arguments).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let child = command.spawn().expect("the program that was just built starts");
    let id = Pid::from_child(&child);
    let (say, heard) = sync_channel(1);
    std::thread::spawn(move || say.send(child.wait_with_output()));
    heard.recv_timeout(DEADLINE).map(|output| output.expect("its output")).unwrap_or_else(|_| {
        let _ = kill_process(id, Signal::KILL);
        panic!("{arguments:?} within {DEADLINE:?}");
    })
}

/// Does the steps in their short form; the claims, all of which that concern function held.
fn claims_of(name: &str, steps: &str) -> Vec<serde_json::Value> {
    let _alone = ONE_AT_A_TIME.lock().unwrap_or_else(PoisonError::into_inner);
    let folder = folder(name);
    let (report, runs) = (folder.join("report.json"), folder.join("runs"));
    let (runs_text, report_text) = (runs.display().to_string(), report.display().to_string());
    let arguments = ["faults", "--short", "--only", steps, "--runs", &runs_text, "--report", &report_text];

    let output = run(&arguments);

    let told = String::from_utf8_lossy(&output.stdout);
    let failed = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(0), "{told}\n{failed}");
    let text = std::fs::read_to_string(&report).expect("a report was written");
    let report: serde_json::Value = serde_json::from_str(&text).expect("it is JSON");
    assert_eq!(report["faults"]["functional_held"], true, "{report:#}");
    std::fs::remove_dir_all(&folder).expect("the folder of this test");
    report["faults"]["claims"].as_array().expect("a list").clone()
}

fn seen(claims: &[serde_json::Value], name: &str) -> f64 {
    let claim =
        claims.iter().find(|claim| claim["name"] == name).unwrap_or_else(|| panic!("{name}: {claims:#?}"));
    claim["seen"].as_f64().unwrap_or_else(|| panic!("{claim:#}"))
}

/// Robots beside each other would only show that two CPUs are not enough for them.
static ONE_AT_A_TIME: Mutex<()> = Mutex::new(());

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
