//! Findings of `sinew doctor` about the host system.

use std::{path::Path, process::Command};

use sinew_testkit::{
    NodeProcess,
    sandbox::{PIDFD_OPEN, without_system_call},
};

use crate::scenario::{Scenario, sinew};

#[test]
fn unwatchable_own_processes_are_a_finding() {
    let sinew = Command::new(env!("CARGO_BIN_EXE_sinew"));
    let Some(mut command) = without_system_call(PIDFD_OPEN, &sinew) else { return };
    command.arg("doctor");
    let mut doctor = NodeProcess::start("doctor", command);
    assert_ne!(doctor.wait_for_exit(), Some(0));
    let finds =
        |words: &[&str]| doctor.output().iter().any(|line| words.iter().all(|word| line.contains(word)));
    assert!(finds(&["own processes", "FINDING", "pidfd_open"]), "{:#?}", doctor.output());
    assert!(finds(&["own processes:", "Linux 5.4"]), "{:#?}", doctor.output());
}

#[test]
fn lateness_is_measured_with_each_schedule() {
    let json = sinew(&["doctor", "--rt", "0.2", "--json"], Path::new("/")).json();
    let schedules = json["real_time"]["schedules"].as_array().expect("a list");
    assert_eq!((&schedules[0]["turns"], schedules.len() <= 2), (&200.into(), true), "{json}");
    assert!(schedules.len() == 2 || schedules[0]["schedule"] == "other", "{json}");
    for schedule in schedules {
        let number = |key: &str| schedule[key].as_u64().expect("a number");
        let bands = schedule["histogram"].as_array().expect("a list");
        assert_eq!(bands.iter().filter_map(|band| band["turns"].as_u64()).sum::<u64>(), 200, "{json}");
        let sorted = ["p50_ns", "p99_ns", "p999_ns", "max_ns"].map(number);
        assert!(sorted.is_sorted() && sorted[0] > 0, "{json}");
    }
    let checks: Vec<_> =
        json["checks"].as_array().expect("a list").iter().map(|check| &check["check"]).collect();
    assert_eq!(checks, ["lateness", "real-time rights", "locked memory", "CPU governor", "kernel"]);
    let rights = &json["checks"][1];
    assert_eq!(rights["fine"], schedules.len() == 2 && schedules[1]["priority"] == 90, "{json}");
}

#[test]
fn node_reports_its_lateness_after_its_start() {
    let scenario = Scenario::new();
    let _knee = scenario.start_changed("knee", 1, &[("[ndl]", "[rt]\nprobe_ms = 50\n[ndl]")], &[]);
    let json = scenario.until("the knee has measured itself", "knee", &["nodes"], |json| {
        !json["nodes"][0]["real_time"].is_null()
    });
    let found = &json["nodes"][0]["real_time"];
    assert_eq!((&found["turns"], &found["wanted"]), (&50.into(), &90.into()), "{json}");
    let is_refused = found["granted"] != 90;
    assert_eq!(found["refusals"].as_array().is_some_and(|reasons| !reasons.is_empty()), is_refused, "{json}");
    assert!(found["max_ns"].as_u64() >= found["p50_ns"].as_u64(), "{json}");
    let text = scenario.sinew("knee", &["nodes"]).out;
    assert!(text.contains("knee: rt: ") && text.contains("p99.9"), "{text}");
}
