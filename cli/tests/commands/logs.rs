//! `sinew logs` of two nodes.

use std::process::Command;

use rustix::process::Signal;
use serde_json::Value;
use sinew_testkit::NodeProcess;

use crate::scenario::{Answer, Scenario, sinew};

const STARTED: &str = "the node has started";
/// A program without a subscriber of its own, as a first program is: such a subscriber decides which lines there are.
pub(crate) const PLAIN: &[&str] = &["--default-log"];

/// Returns the lines of an answer in JSON.
fn lines(answer: &Answer) -> Vec<Value> {
    let read = |line| serde_json::from_str(line).unwrap_or_else(|why| panic!("{why}: {line}"));
    answer.out.lines().map(read).collect()
}

fn is_start_of(line: &Value, node: &str) -> bool {
    line["event"] == "line"
        && line["node"] == node
        && line["text"].as_str().is_some_and(|text| text.contains(STARTED))
}

/// Follows the lines of all nodes through this one.
fn follow(scenario: &Scenario, here: &str) -> NodeProcess {
    let mut command = Command::new(env!("CARGO_BIN_EXE_sinew"));
    command.arg("--socket").arg(scenario.socket(here)).args(["logs", "--follow", "--json"]);
    NodeProcess::start("sinew logs", command)
}

#[test]
fn lines_of_all_nodes_are_merged_by_time() {
    // Given: the knee has started after the hip
    let scenario = Scenario::new();
    let _hip = scenario.start("hip", 1, PLAIN);
    let mut knee = scenario.start("knee", 2, &["--default-log", "--requires", "hip"]);
    knee.wait_for(&["started"]);
    for here in ["hip", "knee"] {
        // When
        let answer = scenario.sinew(here, &["logs", "--json"]);
        // Then
        assert_eq!(answer.code, Some(0), "{}{}", answer.out, answer.err);
        let lines = lines(&answer);
        let times: Vec<_> = lines.iter().map(|line| line["time_s"].as_f64().expect("a time")).collect();
        assert!(times.is_sorted(), "{}", answer.out);
        let at = |node| lines.iter().position(|line| is_start_of(line, node));
        let (hip, knee) = (at("hip"), at("knee"));
        assert!(hip.is_some() && hip < knee, "{hip:?} {knee:?}: {}", answer.out);
        let line = &lines[knee.expect("it is there")];
        assert_eq!(
            (&line["level"], &line["target"], &line["address"]),
            (&"info".into(), &"sinew::node".into(), &"127.0.0.2".into())
        );
    }
    // And: as text, of one node, from a level on
    let text = scenario.sinew("hip", &["logs", "--node", "127.0.0.2"]).out;
    assert!(text.contains("  INFO knee sinew::node: the node has started"), "{text}");
    assert!(!text.contains(" hip sinew"), "{text}");
    let severe = scenario.sinew("hip", &["logs", "--level", "warn", "--json"]);
    let is_severe = |line: &Value| ["warn", "error"].into_iter().any(|level| line["level"] == level);
    assert!(lines(&severe).iter().all(is_severe), "{}", severe.out);
}

#[test]
fn followed_lines_survive_the_restart_of_a_node() {
    // Given: the lines of the hip are followed
    let scenario = Scenario::new();
    let _hip = scenario.start("hip", 1, PLAIN);
    let mut logs = follow(&scenario, "hip");
    logs.wait_for(&["\"node\":\"hip\"", STARTED]);
    // When: a node starts, is killed, and starts again
    let mut knee = scenario.start("knee", 2, PLAIN);
    logs.wait_for(&["\"node\":\"knee\"", STARTED]);
    assert!(knee.kill());
    // Then: it is named once, and its new lines are shown
    logs.wait_for(&["\"event\":\"silent\"", "knee"]);
    let _knee = scenario.start("knee", 2, PLAIN);
    logs.wait_for(&["\"event\":\"answers\"", "knee"]);
    logs.wait_for(&["\"node\":\"knee\"", STARTED]);
    let is_silent = |line: &&String| line.contains("\"event\":\"silent\"");
    assert_eq!(logs.output().iter().filter(is_silent).count(), 1, "{:?}", logs.output());
    // And: Ctrl-C ends it in order
    logs.signal(Signal::INT);
    assert_eq!(logs.wait_for_exit(), Some(0));
}

#[test]
fn followed_lines_survive_the_restart_of_the_entry_node() {
    // Given: the lines of a node are followed through it
    let scenario = Scenario::new();
    let mut knee = scenario.start("knee", 2, PLAIN);
    let mut logs = follow(&scenario, "knee");
    logs.wait_for(&["\"node\":\"knee\"", STARTED]);
    // When: it is killed, and starts again
    assert!(knee.kill());
    logs.wait_for(&["\"event\":\"silent\"", "knee"]);
    let _knee = scenario.start("knee", 2, PLAIN);
    // Then: its new lines are shown
    logs.wait_for(&["\"event\":\"answers\"", "knee"]);
    logs.wait_for(&["\"node\":\"knee\"", STARTED]);
    logs.signal(Signal::INT);
    assert_eq!(logs.wait_for_exit(), Some(0));
}

#[test]
fn unknown_nodes_and_levels_are_refused() {
    let scenario = Scenario::new();
    let _knee = scenario.start("knee", 2, PLAIN);
    let answer = scenario.sinew("knee", &["logs", "--node", "kneee"]);
    let words = "no node is called `kneee` or has this address; nearest: knee (node)";
    assert!(answer.code == Some(1) && answer.err.contains(words), "{}{}", answer.out, answer.err);
    let answer = sinew(&["logs", "--level", "loud"], &scenario.directory.join(""));
    assert!(answer.code == Some(2) && answer.err.contains("error, warn, info"), "{}", answer.err);
}
