//! `sinew param`: lists and sets parameters of a running application, from its own node and from another one.

use serde_json::{Value, json};
use sinew_testkit::until;

use crate::scenario::{Scenario, named};

const APP: &str = "knee.gains";

/// Whether the parameters of one application are listed.
fn has_app(json: &Value) -> bool {
    json["apps"].as_array().is_some_and(|apps| apps.len() == 1)
}

/// Returns the parameter of this name in the JSON of `sinew param list`.
fn parameter<'a>(json: &'a Value, name: &str) -> &'a Value {
    named(&json["apps"][0]["parameters"], name).unwrap_or_else(|| panic!("no {name}: {json}"))
}

#[test]
fn set_names_the_tick_at_which_it_applies() {
    // Given
    let scenario = Scenario::new();
    let mut knee = scenario.start("knee", 2, &["--tuned"]);
    knee.wait_for(&["started"]);
    let json = scenario.until("its parameters are listed", "knee", &["param", "list"], has_app);
    assert_eq!(parameter(&json, "assistance")["value"], json!(0.3), "{json}");
    assert_eq!(parameter(&json, "torque_max")["unit"], json!("Nm"), "{json}");
    // When
    let words = ["param", "set", "knee.gains.assistance=0.5", "knee.gains.damped=true", "--json"];
    let answer = scenario.sinew("knee", &words);
    // Then: the loop has seen it at the same tick
    assert_eq!(answer.code, Some(0), "{}{}", answer.out, answer.err);
    let tick = answer.json()["tick"].as_u64().expect("it was applied at a tick");
    knee.wait_for(&[&format!("assistance 0.5 at tick {tick}")]);
    let got = scenario.sinew("knee", &["param", "get", "knee.gains.damped"]);
    assert_eq!((got.code, got.out.as_str()), (Some(0), "true\n"), "{}", got.err);
    // And: it goes back
    let answer = scenario.sinew("knee", &["param", "undo", APP]);
    assert!(
        answer.code == Some(0) && answer.out.contains("assistance = 0.3"),
        "{}{}",
        answer.out,
        answer.err
    );
    knee.wait_for(&["assistance 0.3 at tick "]);
}

#[test]
fn refused_set_is_a_finding_and_changes_nothing() {
    let scenario = Scenario::new();
    let mut knee = scenario.start("knee", 2, &["--tuned"]);
    knee.wait_for(&["started"]);
    scenario.until("its parameters are listed", "knee", &["param", "list"], has_app);
    for (words, code, part) in [
        (&["knee.gains.assistance=1.4"][..], 1, "assistance = 1.4 is outside 0.0 to 1.0"),
        (&["knee.gains.torque_max=70"], 1, "torque_max = 70 Nm is outside 0.0 to 60.0 Nm"),
        (&["knee.gains.assistance=0.4", "knee.gains.damped=2"], 1, "damped takes true or false"),
        (&["knee.gains.assistence=0.4"], 1, "the nearest name is 'assistance'"),
        (&["knee.assistance=0.4"], 1, "knee has no parameters"),
        (&["knee.gain.assistance=0.4"], 1, "nearest: knee.gains"),
        (&["knee.gains.assistance=0.4", "hip.gains.assistance=0.4"], 1, "hip.gains"),
        (&["assistance=0.4"], 2, "as in knee.drive.assistance"),
    ] {
        let answer = scenario.sinew("knee", &[&["param", "set"], words].concat());
        let text = answer.out + &answer.err;
        assert!(answer.code == Some(code) && text.contains(part), "{words:?}: {text}");
    }
    let json = scenario.sinew("knee", &["param", "list", APP, "--json"]).json();
    assert_eq!(parameter(&json, "assistance")["value"], json!(0.3), "{json}");
    let answer = scenario.sinew("knee", &["param", "undo", APP]);
    assert!(answer.code == Some(1) && answer.out.contains("no set to undo"), "{}", answer.out);
}

#[test]
fn saved_values_are_loaded_again() {
    let scenario = Scenario::new();
    let mut knee = scenario.start("knee", 2, &["--tuned"]);
    knee.wait_for(&["started"]);
    let path = scenario.directory.join("walk.toml");
    let file = path.to_str().expect("a short path");
    let set = |word: &str| {
        let answer = scenario.sinew("knee", &["param", "set", word]);
        assert_eq!(answer.code, Some(0), "{}{}", answer.out, answer.err);
    };
    scenario.until("its parameters are listed", "knee", &["param", "list"], has_app);
    set("knee.gains.assistance=0.7");
    let answer = scenario.sinew("knee", &["param", "save", file]);
    assert_eq!(answer.code, Some(0), "{}{}", answer.out, answer.err);
    set("knee.gains.assistance=0.1");
    let answer = scenario.sinew("knee", &["param", "load", file]);
    assert!(
        answer.code == Some(0) && answer.out.contains("assistance = 0.7"),
        "{}{}",
        answer.out,
        answer.err
    );
    let got = scenario.sinew("knee", &["param", "get", "knee.gains.assistance"]);
    assert_eq!(got.out, "0.7\n");
}

#[test]
fn set_from_another_node_uses_the_application_socket() {
    // Given: an open robot of two nodes on one host, in one folder
    let scenario = Scenario::new();
    let mut hip = scenario.start("hip", 1, &["--requires", "knee"]);
    let mut knee = scenario.start("knee", 2, &["--tuned"]);
    hip.wait_for(&["started"]);
    scenario.until("its parameters are read", "hip", &["param", "list"], has_app);
    // When: the command connects to the other node
    let answer = scenario.sinew("hip", &["param", "set", "knee.gains.assistance=0.5"]);
    // Then
    assert_eq!(answer.code, Some(0), "{}{}", answer.out, answer.err);
    knee.wait_for(&["assistance 0.5 at tick "]);
}

#[test]
fn applications_of_two_nodes_are_set_together() {
    // Given: two nodes, each with an application that has parameters
    let scenario = Scenario::new();
    let mut nodes = [scenario.start("hip", 1, &["--tuned"]), scenario.start("knee", 2, &["--tuned"])];
    nodes.iter_mut().for_each(|node| drop(node.wait_for(&["started"])));
    let has_both = |json: &Value| json["apps"].as_array().is_some_and(|apps| apps.len() == 2);
    let json = scenario.until("both are listed", "hip", &["param", "list"], has_both);
    let mut tids: Vec<String> = Vec::new();
    for app in json["apps"].as_array().expect("it is a list") {
        tids.push(app["tid"].as_str().expect("it is a text").to_owned());
    }
    let set = |values: [&str; 2]| {
        let words: Vec<_> =
            tids.iter().zip(values).map(|(tid, value)| format!("{tid}.assistance={value}")).collect();
        scenario.sinew("hip", &["param", "set", &words[0], &words[1], "--json"])
    };
    // When: the value of one is illegal
    let answer = set(["0.5", "1.4"]);
    // Then: none is set
    assert!(
        answer.code == Some(1) && answer.json()["verdict"] == json!("none"),
        "{}{}",
        answer.out,
        answer.err
    );
    assert!(answer.out.contains("outside 0.0 to 1.0"), "{}", answer.out);
    // When: both are legal
    let answer = set(["0.5", "0.6"]);
    // Then: both loops have seen theirs
    assert!(
        answer.code == Some(0) && answer.json()["verdict"] == json!("all"),
        "{}{}",
        answer.out,
        answer.err
    );
    for (app, value) in answer.json()["apps"].as_array().expect("it is a list").iter().zip(["0.5", "0.6"]) {
        assert!(app["at_ns"].as_u64() >= app["stated_ns"].as_u64(), "{app}");
        let seen = format!("assistance {value} at tick {}", app["tick"]);
        let is_hip = app["app"].as_str().is_some_and(|tid| tid.starts_with("127.0.0.1"));
        nodes[usize::from(!is_hip)].wait_for(&[&seen]);
    }
}

#[test]
fn application_in_its_own_process_joins_a_transaction() {
    let scenario = Scenario::new();
    let mut knee = scenario.start("knee", 2, &["--tuned", "--tuned-apart"]);
    knee.wait_for(&["started"]);
    let has_both = |json: &Value| json["apps"].as_array().is_some_and(|apps| apps.len() == 2);
    scenario.until("both are listed", "knee", &["param", "list"], has_both);
    let set = |apart: &str| {
        let apart = format!("knee.apart.assistance={apart}");
        scenario.sinew("knee", &["param", "set", "knee.gains.assistance=0.5", &apart, "--json"])
    };
    let get = |name: &str| scenario.sinew("knee", &["param", "get", name]).out;
    // When: the value of the one in its own process is illegal
    let answer = set("1.4");
    // Then
    assert!(
        answer.code == Some(1) && answer.out.contains("outside 0.0 to 1.0"),
        "{}{}",
        answer.out,
        answer.err
    );
    assert_eq!(
        (get("knee.gains.assistance"), get("knee.apart.assistance")),
        ("0.3\n".into(), "0.3\n".into())
    );
    // When: both are legal
    let answer = set("0.6");
    // Then
    assert!(
        answer.code == Some(0) && answer.json()["verdict"] == json!("all"),
        "{}{}",
        answer.out,
        answer.err
    );
    assert_eq!(
        (get("knee.gains.assistance"), get("knee.apart.assistance")),
        ("0.5\n".into(), "0.6\n".into())
    );
}

#[test]
fn set_from_another_node_is_refused() {
    // Given: the same, with sockets in two folders
    let scenario = Scenario::new();
    std::fs::create_dir(scenario.directory.join("apart")).expect("the test's own directory");
    let mut hip = scenario.start("hip", 1, &["--requires", "knee"]);
    let mut knee = scenario.start("apart/knee", 2, &["--tuned"]);
    knee.wait_for(&["started"]);
    hip.wait_for(&["started"]);
    scenario.until("its parameters are read", "hip", &["param", "list"], has_app);
    // When
    let answer = scenario.sinew("hip", &["param", "set", "knee.gains.assistance=0.5"]);
    // Then
    let text = answer.out + &answer.err;
    assert!(answer.code == Some(1) && text.contains("operators only"), "{text}");
    let got = scenario.sinew("apart/knee", &["param", "get", "knee.gains.assistance"]);
    assert_eq!(got.out, "0.3\n", "{}", got.err);
}

#[test]
fn kept_value_survives_a_restart_of_the_node() {
    // Given: a node with a state directory
    let scenario = Scenario::new();
    let state = format!("project = \"cli\"\nstate = \"{}\"", scenario.directory.join("state").display());
    let changes = [("project = \"cli\"", &*state)];
    let mut knee = scenario.start_changed("knee", 2, &changes, &["--tuned"]);
    knee.wait_for(&["started"]);
    scenario.until("its parameters are listed", "knee", &["param", "list"], has_app);
    // When: two parameters are set, one of which is kept, and the node is killed when the file is there
    let words = ["param", "set", "knee.gains.torque_max=30", "knee.gains.assistance=0.5"];
    let answer = scenario.sinew("knee", &words);
    assert_eq!(answer.code, Some(0), "{}{}", answer.out, answer.err);
    let file = scenario.directory.join("state/parameters-cli-127.0.0.2");
    let text = until("the file is there", || std::fs::read_to_string(&file).ok());
    assert_eq!(text, "[\"knee.gains\"]\ntorque_max = 30.0\n");
    knee.kill();
    drop(knee);
    // Then
    let mut knee = scenario.start_changed("knee", 2, &changes, &["--tuned"]);
    knee.wait_for(&["started"]);
    let json = scenario.until("its parameters are listed", "knee", &["param", "list"], has_app);
    assert_eq!(parameter(&json, "torque_max")["value"], json!(30.0), "{json}");
    assert_eq!(parameter(&json, "assistance")["value"], json!(0.3), "{json}");
}

#[test]
fn access_list_names_the_operators() {
    // Given: a list that lets every message pass, and names no operator
    let scenario = Scenario::new();
    let path = scenario.directory.join("access.toml");
    let rule = "[[rule]]\nfrom = ['*']\nto = ['*']\n";
    std::fs::write(&path, rule).expect("the test's own directory");
    let section = format!("[security]\naccess = \"{}\"\n[lncl]", path.display());
    let mut knee = scenario.start_changed("knee", 2, &[("[lncl]", &section)], &["--tuned"]);
    knee.wait_for(&["started"]);
    scenario.until("its parameters may be read", "knee", &["param", "list"], has_app);
    let set = || scenario.sinew("knee", &["param", "set", "knee.gains.assistance=0.5"]);
    let answer = set();
    assert!(answer.code == Some(1) && answer.out.contains("[roles]"), "{}{}", answer.out, answer.err);
    // When: it does
    std::fs::write(&path, format!("{rule}[roles]\noperators = ['here']\n")).expect("its directory");
    let answer = scenario.sinew("knee", &["reload"]);
    assert_eq!(answer.code, Some(0), "{}{}", answer.out, answer.err);
    // Then
    let answer = set();
    assert_eq!(answer.code, Some(0), "{}{}", answer.out, answer.err);
    knee.wait_for(&["assistance 0.5 at tick "]);
}
