//! A robot that overloads itself has no host to blame.

use crate::{alone, end, folder, start_in};

#[test]
fn knee_that_computes_longer_than_its_period_fails_and_is_not_excused_by_the_host() {
    let _alone = alone();
    let folder = folder("busy");
    let report = folder.join("report.json");
    let arguments = ["--strides", "8", "--runs", "runs", "--report", report.to_str().unwrap()];

    let output = end(start_in(&folder, &arguments, &[("EXOSKELETON_BUSY", "knee:12")]), "the walk ends");

    let told = String::from_utf8_lossy(&output.stdout);
    let failed = String::from_utf8_lossy(&output.stderr);
    // Whatever else runs on this host.
    assert_eq!(output.status.code(), Some(3), "{told}\n{failed}");
    assert!(told.contains("FAILED"), "{told}");
    let report: serde_json::Value = serde_json::from_str(&std::fs::read_to_string(report).unwrap()).unwrap();
    assert_eq!(report["verdict"], "failed");
    assert_eq!(
        report["real_time"]["host"]["strides_disturbed"].as_array().map(Vec::len),
        Some(0),
        "{report}"
    );
    std::fs::remove_dir_all(&folder).unwrap();
}
