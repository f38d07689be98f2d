//! A robot that overloads itself does not blame its host.

use sinew_robot_tests::process;

use crate::{PROGRAM, alone, end, folder};

#[test]
fn overloaded_knee_fails_without_blaming_the_host() {
    let _alone = alone();
    let folder = folder("busy");
    let report = folder.join("report.json");
    let arguments = ["--strides", "8", "--no-record", "--runs", "runs", "--report", report.to_str().unwrap()];

    let output = end(
        process::start(PROGRAM, &folder, &arguments, &[("EXOSKELETON_BUSY", "knee:12")]),
        "the walk ends",
    );

    let stdout = String::from_utf8_lossy(&output.stdout);
    let failed = String::from_utf8_lossy(&output.stderr);
    // Regardless of other load on this host.
    assert_eq!(output.status.code(), Some(3), "{stdout}\n{failed}");
    assert!(stdout.contains("FAILED"), "{stdout}");
    let report: serde_json::Value = serde_json::from_str(&std::fs::read_to_string(report).unwrap()).unwrap();
    assert_eq!(report["verdict"], "failed");
    assert_eq!(
        report["real_time"]["host"]["strides_disturbed"].as_array().map(Vec::len),
        Some(0),
        "{report}"
    );
    std::fs::remove_dir_all(&folder).unwrap();
}
