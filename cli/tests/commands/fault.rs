//! The flight recorder: a killed node, and the files of all nodes.

use std::{collections::BTreeMap, path::Path, process::Command};

use serde_json::Value;
use sinew::Time;
use sinew_testkit::{NodeProcess, until};

use crate::scenario::{Answer, Scenario};

const SECOND: u64 = 1_000_000_000;
/// Largest difference of the span's begin between two nodes of one host, beside the stated error: the triggers of the
/// others have been converted by then.
const TOLERANCE: u64 = 1_000_000;

/// Starts a node that keeps a recording, in memory or in the folder of the test.
fn start(scenario: &Scenario, name: &str, address: u8, more: &[&str]) -> NodeProcess {
    let record = format!(
        "[record]\nfolder = \"{}\"\nkeep_bytes = 1_048_576\nafter_ms = 1_000\nkeep_ms = 10_000\n[ndl]",
        scenario.directory.join("").display()
    );
    scenario.start_changed(name, address, &[("[ndl]", &record)], more)
}

fn number(of: &Value, key: &str) -> u64 {
    of[key].as_u64().unwrap_or_else(|| panic!("{key} is no number: {of}"))
}

/// Returns the nodes with a frozen span, by the span's ID.
fn spans(json: &Value) -> BTreeMap<String, Vec<String>> {
    let mut spans = BTreeMap::<_, Vec<_>>::new();
    for span in json["spans"].as_array().into_iter().flatten().filter(|span| span["has_died"] == false) {
        let text = |key: &str| span[key].as_str().expect("a text").to_owned();
        spans.entry(text("id")).or_default().push(text("name"));
    }
    spans
}

/// Returns whether the names beside a node's ring have that of this application: a MessagePack text.
fn has_name(scenario: &Scenario, address: &str, name: &str) -> bool {
    let text = [&[0xa0 | name.len() as u8], name.as_bytes()].concat();
    let files = std::fs::read_dir(scenario.directory.join("")).expect("it is a folder");
    files
        .map(|file| file.expect("a file").path())
        .filter(|path| path.to_string_lossy().ends_with(&format!("-{address}.facts")))
        // It may just be replaced.
        .filter_map(|path| std::fs::read(path).ok())
        .any(|bytes| bytes.windows(text.len()).any(|part| part == text))
}

/// Checks that seen = written + dropped holds in the file. The other ends of its channels are in other files.
fn assert_complete(file: &Path) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_sinew"));
    let json = Answer::of(command.args(["bag", "check", "--json"]).arg(file)).json();
    let findings = json["findings"].as_array().unwrap_or_else(|| panic!("no list: {json}"));
    let is_of_ends = |finding: &Value| {
        let kind = finding["kind"].as_str().expect("a word").to_lowercase().replace('_', "");
        ["lost", "unsent", "nofile"].contains(&kind.as_str())
    };
    assert!(findings.iter().all(is_of_ends), "{json}");
}

#[test]
fn all_nodes_keep_the_span_around_a_killed_one() {
    // Given: four nodes that record, and messages from the hip to the knee
    let scenario = Scenario::new();
    let mut hip = start(&scenario, "hip", 1, &["--requires", "knee", "--sends-to", "knee"]);
    let mut knee = start(&scenario, "knee", 2, &[]);
    let _ankle = start(&scenario, "ankle", 3, &[]);
    let _toe = start(&scenario, "toe", 4, &[]);
    hip.wait_for(&["started"]);
    knee.wait_for(&["count 5 "]);
    for name in ["hip", "ankle", "toe"] {
        scenario.until("the clocks of all are measured", name, &["nodes"], |json| {
            let nodes = json["nodes"].as_array().map_or(&[][..], Vec::as_slice);
            let is_measured = |node: &Value| node["clock_offset_ns"].is_i64();
            nodes.len() == 4 && nodes.iter().filter(|node| is_measured(node)).count() == 3
        });
    }
    // And: the knee knows the hip's application, of which the ring has addresses only
    until("the hip's name lies beside the knee's ring", || {
        has_name(&scenario, "127.0.0.2", "hip").then_some(())
    });
    // When
    let killed_ns = Time::now().as_nanos();
    assert!(knee.kill());
    // Then: the three others have the same span
    let json = scenario.until("three nodes have one span", "hip", &["record", "fetch"], |json| {
        spans(json).values().any(|nodes| nodes.len() == 3)
    });
    let found = spans(&json);
    assert_eq!(found.len(), 1, "their triggers are merged: {json}");
    let id = found.into_keys().next().expect("there is one");
    let out = scenario.directory.join("fault");
    let answer = scenario
        .sinew("hip", &["record", "fetch", &id, "--out", out.to_str().expect("a path of text"), "--json"]);
    assert_eq!(answer.code, Some(0), "{}{}", answer.out, answer.err);
    let json = answer.json();
    let files = json["files"].as_array().expect("a list");
    assert_eq!(files.len(), 4, "{json}");
    let first = number(&files[0], "begin_ns");
    for file in files {
        let bound = file["bound_ns"].as_u64().unwrap_or(0);
        assert!(number(file, "begin_ns").abs_diff(first) <= bound + TOLERANCE + SECOND / 1_000, "{json}");
        // The span has the times of all three triggers.
        let lasts = number(file, "end_ns") - number(file, "begin_ns");
        assert!((11 * SECOND..=13 * SECOND).contains(&lasts), "{json}");
        assert_complete(Path::new(file["file"].as_str().expect("a path")));
    }
    // And: the last 100 ms of the dead one are there, and its messages have names
    let dead = files.iter().find(|file| file["has_died"] == true).expect("the knee's file");
    assert_eq!(dead["node"], "knee", "{json}");
    assert!(dead["file"].as_str().is_some_and(|file| file.contains("-died-")), "{json}");
    assert!(number(dead, "last_ns") >= killed_ns - SECOND / 10 && number(dead, "written") > 0, "{json}");
    let info = Command::new(env!("CARGO_BIN_EXE_sinew"))
        .args(["bag", "info", dead["file"].as_str().expect("a path")])
        .output()
        .expect("the command starts");
    let info = String::from_utf8_lossy(&info.stdout);
    assert!(info.contains("/hip/") && info.contains("node knee at 127.0.0.2"), "{info}");
    // And: at its next start the knee keeps the ring of its last incarnation
    let _knee = start(&scenario, "knee", 2, &[]);
    scenario.until("the ring of the dead knee is kept", "knee", &["record", "fetch"], |json| {
        json["spans"]
            .as_array()
            .is_some_and(|spans| spans.iter().any(|span| span["has_died"] == true && span["name"] == "knee"))
    });
    // And: it has no such span itself, so it cannot compare the times of that ring, and says how to get it
    scenario.until("the knee finds the spans of the others", "knee", &["record", "fetch"], |json| {
        spans(json).get(&id).is_some_and(|nodes| nodes.len() == 3)
    });
    let out = scenario.directory.join("again");
    let words = ["record", "fetch", &id, "--out", out.to_str().expect("a path of text"), "--json"];
    let json = scenario.sinew("knee", &words).json();
    let skipped = json["skipped"].as_array().expect("a list");
    let has_remedy = |note: &Value| note.as_str().is_some_and(|note| note.contains("record fetch died-"));
    assert!(skipped.len() == 1 && has_remedy(&skipped[0]), "{json}");
}

#[test]
fn engineer_freezes_and_fetches_without_a_fault() {
    let scenario = Scenario::new();
    let _knee = start(&scenario, "knee", 2, &[]);
    let _hip = scenario.start("hip", 1, &[]);
    let answer = scenario.sinew("knee", &["record", "freeze", "--reason", "it jerked", "--json"]);
    assert_eq!(answer.code, Some(0), "{}{}", answer.out, answer.err);
    let json = answer.json();
    let id = json["id"].as_str().expect("an ID").to_owned();
    assert_eq!(crate::scenario::named(&json["nodes"], "knee").expect("it")["state"], "frozen", "{json}");
    let list = scenario.sinew("knee", &["record", "fetch"]);
    assert!(list.code == Some(0) && list.out.contains("it jerked") && list.out.contains(&id), "{}", list.out);
    let out = scenario.directory.join("spans");
    let words = ["record", "fetch", "--out", out.to_str().expect("a path of text")];
    let answer = scenario.sinew("knee", &words);
    assert_eq!(answer.code, Some(0), "{}{}", answer.out, answer.err);
    assert_complete(&out.join(format!("knee-{id}.mcap")));
    // And: nothing is replaced, and a node without a recording says so
    let answer = scenario.sinew("knee", &words);
    assert!(answer.code == Some(1) && answer.out.contains("--force"), "{}{}", answer.out, answer.err);
    let answer = scenario.sinew("hip", &["record", "freeze"]);
    assert!(answer.code == Some(1) && answer.err.contains("record.folder"), "{}", answer.err);
    let answer = scenario.sinew("knee", &["record", "fetch", "never"]);
    assert!(answer.code == Some(1) && answer.err.contains("sinew record fetch"), "{}", answer.err);
}
