//! A node with an access list: what stands in the way is named, and the list is read again without a restart.

use std::path::PathBuf;

use serde_json::Value;
use sinew::{Endpoint, NodeApi, Registration, Tid};
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

/// An application of this name in another process of the knee's, which is in the group.
fn drive(scenario: &Scenario, name: &str) -> Endpoint {
    let api = NodeApi::connect(scenario.socket("knee")).expect("its socket");
    let mut drive = api.register_transport_address(Registration::new().name(name)).expect("it is registered");
    drive.join("drives").expect("it is in few groups");
    drive
}

#[test]
fn members_of_a_group_are_told_with_the_rule_for_each_of_them_and_between_two_the_group_that_differs() {
    // Given: a list that lets the hip send to the group, but not to one of its members
    let scenario = Scenario::new();
    let list = "[[rule]]\nname = 'spare'\nfrom = ['hip']\nto = ['spare']\naction = 'refuse'\n\
                [[rule]]\nname = 'setpoints'\nfrom = ['hip']\ngroups = ['drives']\n";
    let (_hip, _knee, _) = start(&scenario, list);
    let _members = ["drive", "spare"].map(|name| drive(&scenario, name));
    // When
    let (open, shut) = ("hip may send to drives on knee: drive", "hip may send to drives on knee: spare");
    let said = scenario.until("both names are known", "knee", &["why", "hip", "drives"], |said| {
        let steps = said["steps"].as_array().expect("a list");
        [open, shut]
            .iter()
            .all(|what| steps.iter().any(|step| step["step"] == *what && says(&step["seen"], "'hip'")))
    });
    // Then
    assert!(says(&step(&said, "drives has members")["seen"], "drive, spare on knee"), "{said}");
    let passes = step(&said, open);
    assert!(passes["state"] == "fine" && says(&passes["seen"], "rule 2 'setpoints' (line 6)"), "{said}");
    let refused = step(&said, shut);
    assert!(refused["state"] == "note" && says(&refused["seen"], "rule 1 'spare' (line 1)"), "{said}");
    assert!(says(&refused["mend"], "groups = [\"drives\"]"), "{said}");
    // And: by its TID, from the other node, and named first
    let tid = Tid::group("drives").to_string();
    let what = format!("hip may send to {tid} on knee: drive");
    scenario.until("the hip knows the knee", "hip", &["why", &tid, "hip"], |said| {
        let steps = said["steps"].as_array().expect("a list");
        steps.iter().any(|step| step["step"] == *what && step["state"] == "fine")
    });
    // And: what is sent to the one alone is refused, and what is sent to the group is not
    let said = scenario.sinew("knee", &["why", "hip", "drive", "--json"]).json();
    assert_eq!(step(&said, "hip may send to drive")["state"], "blocked", "{said}");
    let by_group = step(&said, &format!("hip may send to drive by group {tid}"));
    assert!(by_group["state"] == "fine" && says(&by_group["seen"], "'setpoints'"), "{said}");
}
