//! A node with an access list: what stands in the way is named, and the list is read again without a restart.

use std::path::PathBuf;

use serde_json::Value;
use sinew_tests::Program;

use crate::scenario::{Scenario, named};

const OPEN: &str = "[[rule]]\nname = 'counts'\nfrom = ['hip']\nto = ['knee']\n";

/// The hip, which sends counts to the knee all the time, and the knee, which has this access list.
fn start(scenario: &Scenario, list: &str) -> (Program, Program, PathBuf) {
    let path = scenario.directory.join("access.toml");
    std::fs::write(&path, list).expect("the test's own directory");
    let section = format!("[security]\naccess = \"{}\"\n[lncl]", path.display());
    let mut knee = scenario.start_changed("knee", 2, &[("[lncl]", &section)], &[]);
    knee.wait_for(&["started"]);
    let mut hip = scenario.start("hip", 1, &["--requires", "knee", "--sends-to", "knee"]);
    hip.wait_for(&["started"]);
    (hip, knee, path)
}

fn step<'a>(said: &'a Value, what: &str) -> &'a Value {
    let steps = said["steps"].as_array().expect("a list");
    steps.iter().find(|step| step["step"] == what).unwrap_or_else(|| panic!("no step '{what}': {said}"))
}

fn says(value: &Value, words: &str) -> bool {
    value.as_str().is_some_and(|text| text.contains(words))
}

#[test]
fn a_rule_in_the_way_is_named_and_a_list_that_is_read_again_opens_it() {
    // Given: a list that lets nobody in
    let scenario = Scenario::new();
    let (_hip, mut knee, path) = start(&scenario, "[[rule]]\nfrom = ['gait']\nto = ['knee']\n");
    let words = ["why", "hip", "knee"];
    let said = scenario.until("the knee knows the hip's name", "knee", &words, |said| {
        said["free"] == false && says(&step(said, "hip may send to knee")["seen"], "'hip'")
    });
    // Then: the step says so, and names it
    let blocked = step(&said, "hip may send to knee");
    assert!(blocked["state"] == "blocked" && says(&blocked["seen"], "no rule allows it"), "{said}");
    assert!(says(&blocked["mend"], "sinew reload"), "{said}");
    let back = step(&said, "knee may send to hip");
    assert!(back["state"] == "fine" && says(&back["seen"], "no access list"), "{said}");
    let refusals =
        |said: &Value| named(&said["nodes"], "knee").is_some_and(|knee| knee["refused"].as_u64() > Some(0));
    scenario.until("its refusals are counted", "knee", &["nodes"], refusals);
    // When: it is read again from a file with a fault
    std::fs::write(&path, "[[rule]]\nfrom = ['hip']\nto = ['knee']\nclasses = ['fast']\n")
        .expect("its directory");
    let answer = scenario.sinew("knee", &["reload"]);
    assert_eq!(answer.code, Some(1), "{}{}", answer.out, answer.err);
    assert!(answer.out.contains("line 4") && answer.out.contains("stays"), "{}", answer.out);
    let said = scenario.sinew("knee", &["why", "hip", "knee", "--json"]).json();
    assert_eq!(said["free"], false, "{said}");
    // When: from a good one
    std::fs::write(&path, OPEN).expect("its directory");
    let answer = scenario.sinew("knee", &["reload"]);
    assert!(answer.code == Some(0) && answer.out.contains("1 rules"), "{}{}", answer.out, answer.err);
    // Then
    let first = knee.wait_for(&["count "]);
    assert!(!first.starts_with("count 1 "), "those before were refused: {first}");
    let said = scenario.sinew("knee", &["why", "hip", "knee", "--json"]).json();
    let open = step(&said, "hip may send to knee");
    assert!(open["state"] == "fine" && says(&open["seen"], "rule 1 'counts' (line 1)"), "{said}");
    assert_eq!(said["free"], true, "that this command may not send is not in the way: {said}");
}

#[test]
fn a_node_without_a_list_has_none_to_read_and_says_what_to_set() {
    let scenario = Scenario::new();
    let _knee = scenario.start("knee", 2, &[]);
    let answer = scenario.sinew("knee", &["reload"]);
    assert!(answer.code == Some(1) && answer.out.contains("security.access"), "{}{}", answer.out, answer.err);
}
