//! A node with an access list: blocking rules are named, and the list is reloaded without a restart.

use std::path::PathBuf;

use serde_json::Value;
use sinew::{Endpoint, NodeApi, Registration, Tid};
use sinew_testkit::NodeProcess;

use crate::scenario::{Scenario, named};

const OPEN: &str = "[[rule]]\nname = 'counts'\nfrom = ['hip']\nto = ['knee']\n";

/// The hip, which sends counts to the knee all the time, and the knee, which has this access list.
fn start(scenario: &Scenario, list: &str) -> (NodeProcess, NodeProcess, PathBuf) {
    let path = scenario.directory.join("access.toml");
    std::fs::write(&path, list).expect("the test's own directory");
    let section = format!("[security]\naccess = \"{}\"\n[lncl]", path.display());
    let mut knee = scenario.start_changed("knee", 2, &[("[lncl]", &section)], &[]);
    knee.wait_for(&["started"]);
    let mut hip = scenario.start("hip", 1, &["--requires", "knee", "--sends-to", "knee"]);
    hip.wait_for(&["started"]);
    (hip, knee, path)
}

fn step<'a>(json: &'a Value, what: &str) -> &'a Value {
    let steps = json["steps"].as_array().expect("a list");
    steps.iter().find(|step| step["step"] == what).unwrap_or_else(|| panic!("no step '{what}': {json}"))
}

fn says(value: &Value, words: &str) -> bool {
    value.as_str().is_some_and(|text| text.contains(words))
}

#[test]
fn blocking_rule_is_named_until_a_reload() {
    // Given: a list that allows no sender
    let scenario = Scenario::new();
    let (_hip, mut knee, path) = start(&scenario, "[[rule]]\nfrom = ['gait']\nto = ['knee']\n");
    let words = ["why", "hip", "knee"];
    let json = scenario.until("the knee knows the hip's name", "knee", &words, |json| {
        json["free"] == false && says(&step(json, "hip may send to knee")["detail"], "'hip'")
    });
    // Then: the step reports and names it
    let blocked = step(&json, "hip may send to knee");
    assert!(blocked["status"] == "blocked" && says(&blocked["detail"], "no rule allows it"), "{json}");
    assert!(says(&blocked["suggested_fix"], "sinew reload"), "{json}");
    let rule = "[[rule]]\nfrom = [\"hip@127.0.0.1\"]\nto = [\"knee\"]";
    assert!(says(&blocked["suggested_fix"], rule), "{json}");
    assert!(says(&blocked["suggested_fix"], &path.display().to_string()), "{json}");
    let back = step(&json, "knee may send to hip");
    assert!(back["status"] == "fine" && says(&back["detail"], "no access list"), "{json}");
    let refusals =
        |json: &Value| named(&json["nodes"], "knee").is_some_and(|knee| knee["refused"].as_u64() > Some(0));
    scenario.until("its refusals are counted", "knee", &["nodes"], refusals);
    // When: it is reloaded from a file with a fault
    std::fs::write(&path, "[[rule]]\nfrom = ['hip']\nto = ['knee']\nclasses = ['fast']\n")
        .expect("its directory");
    let answer = scenario.sinew("knee", &["reload"]);
    assert_eq!(answer.code, Some(1), "{}{}", answer.out, answer.err);
    assert!(answer.out.contains("line 4") && answer.out.contains("stays"), "{}", answer.out);
    let json = scenario.sinew("knee", &["why", "hip", "knee", "--json"]).json();
    assert_eq!(json["free"], false, "{json}");
    // When: it is reloaded from a valid file
    std::fs::write(&path, OPEN).expect("its directory");
    let answer = scenario.sinew("knee", &["reload"]);
    assert!(answer.code == Some(0) && answer.out.contains("1 rules"), "{}{}", answer.out, answer.err);
    // Then
    let first = knee.wait_for(&["count "]);
    assert!(!first.starts_with("count 1 "), "those before were refused: {first}");
    let json = scenario.sinew("knee", &["why", "hip", "knee", "--json"]).json();
    let open = step(&json, "hip may send to knee");
    assert!(open["status"] == "fine" && says(&open["detail"], "rule 1 'counts' (line 1)"), "{json}");
    assert_eq!(json["free"], true, "that this command may not send is not in the way: {json}");
}

#[test]
fn reload_without_a_list_names_the_setting() {
    let scenario = Scenario::new();
    let _knee = scenario.start("knee", 2, &[]);
    let answer = scenario.sinew("knee", &["reload"]);
    assert!(answer.code == Some(1) && answer.out.contains("security.access"), "{}{}", answer.out, answer.err);
}

/// An application with this name in another process at the knee, and a member of the group.
fn drive(scenario: &Scenario, name: &str) -> Endpoint {
    let api = NodeApi::connect(scenario.socket("knee")).expect("its socket");
    let mut drive = api.register_transport_address(Registration::new().name(name)).expect("it is registered");
    drive.join("drives").expect("it is in few groups");
    drive
}

#[test]
fn group_members_are_shown_with_their_rules() {
    // Given: a list that lets the hip send to the group, but not to one of its members
    let scenario = Scenario::new();
    let list = "[[rule]]\nname = 'spare'\nfrom = ['hip']\nto = ['spare']\naction = 'refuse'\n\
                [[rule]]\nname = 'setpoints'\nfrom = ['hip']\ngroups = ['drives']\n";
    let (_hip, _knee, _) = start(&scenario, list);
    let _members = ["drive", "spare"].map(|name| drive(&scenario, name));
    // When
    let (open, shut) = ("hip may send to drives on knee: drive", "hip may send to drives on knee: spare");
    let json = scenario.until("both names are known", "knee", &["why", "hip", "drives"], |json| {
        let steps = json["steps"].as_array().expect("a list");
        [open, shut]
            .iter()
            .all(|what| steps.iter().any(|step| step["step"] == *what && says(&step["detail"], "'hip'")))
    });
    // Then
    assert!(says(&step(&json, "drives has members")["detail"], "drive, spare on knee"), "{json}");
    let passes = step(&json, open);
    assert!(passes["status"] == "fine" && says(&passes["detail"], "rule 2 'setpoints' (line 6)"), "{json}");
    let refused = step(&json, shut);
    assert!(refused["status"] == "note" && says(&refused["detail"], "rule 1 'spare' (line 1)"), "{json}");
    assert!(says(&refused["suggested_fix"], "groups = [\"drives\"]"), "{json}");
    // And: by its TID, from the other node, and named first
    let tid = Tid::group("drives").to_string();
    let what = format!("hip may send to {tid} on knee: drive");
    scenario.until("the hip knows the knee", "hip", &["why", &tid, "hip"], |json| {
        let steps = json["steps"].as_array().expect("a list");
        steps.iter().any(|step| step["step"] == *what && step["status"] == "fine")
    });
    // And: a message to the single member is refused, and one to the group is not
    let json = scenario.sinew("knee", &["why", "hip", "drive", "--json"]).json();
    assert_eq!(step(&json, "hip may send to drive")["status"], "blocked", "{json}");
    let by_group = step(&json, &format!("hip may send to drive by group {tid}"));
    assert!(by_group["status"] == "fine" && says(&by_group["detail"], "'setpoints'"), "{json}");
}
