//! The committed charts and tables are those of the committed results.

use std::{
    path::{Path, PathBuf},
    process::{Command, Output},
};

fn check(files: &[PathBuf]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_charts")).arg("--check").args(files).output().expect("it runs")
}

#[test]
fn committed_charts_and_tables_are_current() {
    let output = check(&[]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stdout));
}

/// Returns a copy of a file of results in which each median of a round trip has one more digit.
fn with_other_medians(committed: &Path) -> PathBuf {
    let text = std::fs::read_to_string(committed).expect("it is text");
    let name = committed.file_name().expect("it has a name").to_string_lossy();
    let copy = std::env::temp_dir().join(format!("sinew-charts-{}-{name}", std::process::id()));
    std::fs::write(&copy, text.replace("\"p50_ns\": ", "\"p50_ns\": 9")).expect("a temporary file");
    copy
}

#[test]
fn other_results_make_charts_and_tables_stale() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/performance/data");
    let entries = std::fs::read_dir(folder).expect("the folder is there");
    let copies: Vec<_> =
        entries.map(|entry| with_other_medians(&entry.expect("it is readable").path())).collect();
    let output = check(&copies);
    copies.iter().for_each(|copy| std::fs::remove_file(copy).expect("it is there"));
    let shown = String::from_utf8_lossy(&output.stdout);
    assert_eq!(output.status.code(), Some(1), "{shown}");
    for stale in ["one-host-1khz.svg", "between-nodes.svg", "PERFORMANCE.md"] {
        assert!(shown.contains(stale), "{shown}");
    }
    assert!(!shown.contains("instructions.svg"), "{shown}");
}

#[test]
fn unreadable_results_are_an_error_with_their_name() {
    let output = check(&["/nowhere/at/all.json".into()]);
    assert_eq!(output.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&output.stderr).contains("/nowhere/at/all.json"));
}
