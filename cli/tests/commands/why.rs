//! `sinew why` between real nodes: the way is free, or what stands in it is named.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::Duration,
};

use serde_json::Value;
use sinew::{NodeApi, Registration};

use crate::scenario::{Scenario, named};

/// The steps that are blocked, in words.
fn blocked(said: &Value) -> String {
    let steps = said["steps"].as_array().expect("a list").iter();
    let blocked = steps.filter(|step| step["state"] == "blocked");
    blocked.map(|step| format!("{}: {} - {}\n", step["step"], step["seen"], step["mend"])).collect()
}

#[test]
fn the_way_between_two_nodes_and_their_applications_is_free_from_both_ends() {
    let scenario = Scenario::new();
    let mut hip = scenario.start("hip", 1, &["--requires", "knee"]);
    let mut knee = scenario.start("knee", 2, &[]);
    hip.wait_for(&["started"]);
    let tid = knee.wait_for(&["started"]).split_once(' ').expect("it says its TID").1.to_owned();
    for (from, to) in [("hip", "knee"), ("127.0.0.2", "127.0.0.1"), (&*tid, "hip")] {
        let said = scenario.until("all links are up", "hip", &["why", from, to], |said| said["free"] == true);
        // Both were asked themselves, and each has pinged the other.
        let steps = said["steps"].as_array().expect("a list");
        let pings =
            steps.iter().filter(|step| step["seen"].as_str().is_some_and(|s| s.starts_with("confirmed")));
        assert_eq!(pings.count(), 2, "{said}");
    }
    let answer = scenario.sinew("knee", &["why", "hip", "knee"]);
    assert!(answer.code == Some(0) && answer.out.contains("The way is free"), "{}{}", answer.out, answer.err);
    // Nothing of the questions is left.
    let apps = scenario.sinew("hip", &["apps", "--json"]).json();
    assert_eq!(apps["apps"].as_array().map(Vec::len), Some(2), "{apps}");
}

#[test]
fn nodes_of_two_projects_and_of_two_groups_are_told_so_though_neither_knows_the_other() {
    // Given: three nodes beside each other, of which no two find each other
    let scenario = Scenario::new();
    let _hip = scenario.start("hip", 1, &[]);
    let _arm = scenario.start_changed("arm", 2, &[("project = \"cli\"", "project = \"arm\"")], &[]);
    let group = scenario.group.to_string();
    let _lone = scenario.start_changed("lone", 3, &[(&group, "239.255.1.1:19999")], &[]);
    for here in ["hip", "arm"] {
        // When
        let answer = scenario.sinew(here, &["why", "hip", "arm", "--json"]);
        // Then
        let said = blocked(&answer.json());
        assert!(answer.code == Some(1) && said.contains("'cli'") && said.contains("'arm'"), "{said}");
    }
    let answer = scenario.sinew("hip", &["why", "hip", "lone", "--json"]);
    let said = blocked(&answer.json());
    assert!(
        answer.code == Some(1) && said.contains("239.255.1.1:19999") && said.contains("`multicast`"),
        "{said}"
    );
}

#[test]
fn a_node_that_was_killed_is_shown_as_lost_with_how_it_was_found_and_why_says_what_became_of_it() {
    let scenario = Scenario::new();
    let mut hip = scenario.start("hip", 1, &["--requires", "knee"]);
    let knee = scenario.start("knee", 2, &[]);
    hip.wait_for(&["started"]);
    drop(knee);
    // When
    let said = scenario.until("it is lost", "hip", &["nodes"], |said| named(&said["lost"], "knee").is_some());
    // Then
    let lost = named(&said["lost"], "knee").expect("it was there");
    assert_eq!((&lost["node"], &lost["why"]), (&"127.0.0.2".into(), &"crashed".into()), "{lost}");
    assert!(lost["silent_us"].as_u64() <= lost["bound_us"].as_u64(), "{lost}");
    assert!(lost["found_by"].as_array().is_some_and(|by| !by.is_empty()), "{lost}");
    let table = scenario.sinew("hip", &["nodes"]);
    assert!(table.code == Some(1) && table.out.contains("its process has ended"), "{}", table.out);
    let answer = scenario.sinew("hip", &["why", "hip", "knee", "--json"]);
    let said = blocked(&answer.json());
    assert!(
        answer.code == Some(1) && said.contains("its process has ended") && said.contains("start it"),
        "{said}"
    );
    // And: when it is back, it is lost no more
    let _knee = scenario.start("knee", 2, &[]);
    scenario.until("it is back", "hip", &["nodes"], |said| {
        said["lost"].as_array().is_some_and(Vec::is_empty) && named(&said["nodes"], "knee").is_some()
    });
}

#[test]
fn applications_that_wait_for_each_other_in_a_circle_are_told_the_circle() {
    let scenario = Scenario::new();
    // Given: nodes whose own applications run, as a node ends whose applications can never start
    let mut hip = scenario.start("hip", 1, &["--requires", "knee"]);
    let _knee = scenario.start("knee", 2, &[]);
    hip.wait_for(&["started"]);
    // Each registration waits for the other one, until the test ends.
    let _circle = [("hip", "gait", "drive"), ("knee", "drive", "gait")].map(|(node, name, required)| {
        let api = NodeApi::connect(scenario.socket(node)).expect("its socket");
        let registration = Registration::new().name(name).requires([required]);
        std::thread::spawn(move || api.register_transport_address(registration).map(drop))
    });
    let waits =
        |name| move |said: &Value| named(&said["apps"], name).is_some_and(|app| app["state"] == "waits");
    scenario.until("both wait", "hip", &["apps"], |said| waits("gait")(said) && waits("drive")(said));
    let answer = scenario.sinew("hip", &["why", "gait", "drive", "--json"]);
    let said = blocked(&answer.json());
    assert!(answer.code == Some(1) && said.contains("drive -> gait -> drive"), "{said}");
    // And: who is nowhere is said to be
    let answer = scenario.sinew("hip", &["why", "hip", "ankle"]);
    assert!(answer.code == Some(1) && answer.out.contains("'ankle'"), "{}", answer.out);
}

#[test]
fn a_name_that_two_nodes_have_stands_for_the_one_that_the_other_end_reaches() {
    // Given: two nodes, each with an application of one name
    let scenario = Scenario::new();
    let mut hip = scenario.start("hip", 1, &["--requires", "knee"]);
    let _knee = scenario.start("knee", 2, &[]);
    hip.wait_for(&["started"]);
    let over = Arc::new(AtomicBool::new(false));
    let drives = ["hip", "knee"].map(|node| {
        let api = NodeApi::connect(scenario.socket(node)).expect("its socket");
        let mut drive =
            api.register_transport_address(Registration::new().name("drive")).expect("it is registered");
        let over = over.clone();
        std::thread::spawn(move || {
            while !over.load(Ordering::Relaxed) {
                let received = drive.receive(Duration::from_millis(10)).expect("its node lives");
                assert!(received.is_none(), "a ping is answered without the program");
            }
        })
    });
    let step = |said: &Value, what: &str| {
        let steps = said["steps"].as_array().cloned().unwrap_or_default();
        steps.into_iter().find(|step| step["step"] == what).unwrap_or_default()
    };
    // Then: whichever is asked through, and whichever is named first
    for here in ["hip", "knee"] {
        for (end, node) in [("127.0.0.1", "hip"), ("knee", "knee")] {
            for words in [["why", end, "drive"], ["why", "drive", end]] {
                let said = scenario.until("the way is free", here, &words, |said| said["free"] == true);
                let there = step(&said, "drive is there");
                assert!(
                    there["seen"].as_str().is_some_and(|seen| seen.starts_with(&format!("node {node} at"))),
                    "through {here}, {words:?}: {said}"
                );
                assert_eq!(step(&said, "drive is one of 2")["state"], "note", "{said}");
            }
        }
    }
    over.store(true, Ordering::Relaxed);
    drives.into_iter().for_each(|drive| drive.join().expect("it got nothing"));
}

#[test]
fn which_way_values_of_class_stream_go_is_said_from_both_ends() {
    // Given: two nodes that have datagrams, and one that has switched them off
    let scenario = Scenario::new();
    let mut hip = scenario.start("hip", 1, &["--requires", "knee", "--requires", "ankle"]);
    let _knee = scenario.start("knee", 2, &[]);
    let off = [("[lncl]", "[gncl]\ndatagrams = false\n[lncl]")];
    let _ankle = scenario.start_changed("ankle", 3, &off, &[]);
    hip.wait_for(&["started"]);
    let seen = |said: &Value, what: &str| {
        let steps = said["steps"].as_array().cloned().unwrap_or_default();
        let step = steps.into_iter().find(|step| step["step"] == what);
        step.map_or_else(String::new, |step| format!("{} {}", step["seen"], step["mend"]))
    };
    // Then: a value of each goes by datagram, as soon as one was answered
    scenario.until("datagrams get through", "hip", &["why", "hip", "knee"], |said| {
        ["class Stream from hip to knee", "class Stream from knee to hip"]
            .iter()
            .all(|what| seen(said, what).contains("by datagram (UDP)") && said["free"] == true)
    });
    // And: both say why none does, and it stands in nobody's way
    scenario.until("all links are up", "hip", &["why", "hip", "ankle"], |said| {
        let (there, back) =
            (seen(said, "class Stream from hip to ankle"), seen(said, "class Stream from ankle to hip"));
        said["free"] == true
            && there.contains("the other end takes no datagrams")
            && back.contains("switched off here")
            && back.contains("`datagrams = true` under [gncl] of ankle")
    });
}

#[test]
fn a_message_to_an_application_that_waits_to_be_started_is_not_tried_and_why_says_for_whom_it_waits() {
    // Given
    let scenario = Scenario::new();
    let _robot = scenario.start_a_knee_that_waits_for_an_ankle();
    // When
    let said = scenario.until("all links are up", "hip", &["why", "hip", "knee"], |said| {
        said["steps"].is_array() && blocked(said).lines().count() == 1
    });
    // Then
    let why = blocked(&said);
    assert!(why.starts_with("\"knee takes messages\"") && why.contains("ankle (not there)"), "{why}");
    let steps = said["steps"].as_array().expect("a list");
    let there = steps.iter().find(|step| step["step"] == "a message goes from hip to knee");
    let seen = there.expect("it is told")["seen"].as_str().expect("a text");
    assert!(seen.starts_with("not tried: it is not ready: has waited "), "{seen}");
}
