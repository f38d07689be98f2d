//! `sinew why` between real nodes: the path is free, or the obstacle is named.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::Duration,
};

use serde_json::Value;
use sinew::{NodeApi, Registration, payload};

use crate::scenario::{Scenario, blocked, named};

#[test]
fn path_between_connected_nodes_is_free_from_both_ends() {
    let scenario = Scenario::new();
    let mut hip = scenario.start("hip", 1, &["--requires", "knee"]);
    let mut knee = scenario.start("knee", 2, &[]);
    hip.wait_for(&["started"]);
    let tid = knee.wait_for(&["started"]).split_once(' ').expect("it says its TID").1.to_owned();
    for (from, to) in [("hip", "knee"), ("127.0.0.2", "127.0.0.1"), (&*tid, "hip")] {
        let json = scenario.until("all links are up", "hip", &["why", from, to], |json| json["free"] == true);
        // Both nodes were queried directly, and each has pinged the other.
        let steps = json["steps"].as_array().expect("a list");
        let pings =
            steps.iter().filter(|step| step["detail"].as_str().is_some_and(|s| s.starts_with("confirmed")));
        assert_eq!(pings.count(), 2, "{json}");
    }
    let answer = scenario.sinew("knee", &["why", "hip", "knee"]);
    assert!(answer.code == Some(0) && answer.out.contains("The way is free"), "{}{}", answer.out, answer.err);
    // The applications that sent the queries are gone.
    let apps = scenario.sinew("hip", &["apps", "--json"]).json();
    assert_eq!(apps["apps"].as_array().map(Vec::len), Some(2), "{apps}");
}

#[test]
fn separate_projects_and_groups_are_named_as_the_cause() {
    // Given: three nodes on one network, none of which discovers another
    let scenario = Scenario::new();
    let _hip = scenario.start("hip", 1, &[]);
    let _arm = scenario.start_changed("arm", 2, &[("project = \"cli\"", "project = \"arm\"")], &[]);
    let group = scenario.group.to_string();
    let _lone = scenario.start_changed("lone", 3, &[(&group, "239.255.1.1:19999")], &[]);
    for here in ["hip", "arm"] {
        // When
        let answer = scenario.sinew(here, &["why", "hip", "arm", "--json"]);
        // Then
        let steps = blocked(&answer.json());
        assert!(answer.code == Some(1) && steps.contains("'cli'") && steps.contains("'arm'"), "{steps}");
    }
    let answer = scenario.sinew("hip", &["why", "hip", "lone", "--json"]);
    let steps = blocked(&answer.json());
    assert!(
        answer.code == Some(1) && steps.contains("239.255.1.1:19999") && steps.contains("`multicast`"),
        "{steps}"
    );
}

#[test]
fn address_in_another_project_blocks_nothing() {
    // Given: a node of another project on this host, with the knee's address and an application of the knee's name
    let scenario = Scenario::new();
    let project = [("project = \"cli\"", "project = \"arm\""), ("name = \"arm\"", "name = \"knee\"")];
    let mut arm = scenario.start_changed("arm", 2, &project, &[]);
    arm.wait_for(&["started"]);
    let mut hip = scenario.start("hip", 1, &["--requires", "knee"]);
    let _knee = scenario.start("knee", 2, &[]);
    hip.wait_for(&["started"]);
    for end in ["knee", "127.0.0.2"] {
        // When
        let json =
            scenario.until("all links are up", "hip", &["why", "hip", end], |json| json["free"] == true);
        // Then: the other one was asked, and is not meant
        assert_eq!(blocked(&json), "", "{json}");
        let steps = json["steps"].as_array().expect("a list");
        let project = steps.iter().find(|step| step["step"] == "both are of one project");
        assert_eq!(project.expect("it is a step")["detail"], "'cli'", "{json}");
    }
}

#[test]
fn killed_node_is_shown_as_lost_with_its_history() {
    let scenario = Scenario::new();
    let mut hip = scenario.start("hip", 1, &["--requires", "knee"]);
    let knee = scenario.start("knee", 2, &[]);
    hip.wait_for(&["started"]);
    drop(knee);
    // When
    let json = scenario.until("it is lost", "hip", &["nodes"], |json| named(&json["lost"], "knee").is_some());
    // Then
    let lost = named(&json["lost"], "knee").expect("it was there");
    assert_eq!((&lost["node"], &lost["why"]), (&"127.0.0.2".into(), &"crashed".into()), "{lost}");
    assert!(lost["silent_us"].as_u64() <= lost["bound_us"].as_u64(), "{lost}");
    assert!(lost["found_by"].as_array().is_some_and(|by| !by.is_empty()), "{lost}");
    let table = scenario.sinew("hip", &["nodes"]);
    assert!(table.code == Some(1) && table.out.contains("its process has ended"), "{}", table.out);
    let answer = scenario.sinew("hip", &["why", "hip", "knee", "--json"]);
    let steps = blocked(&answer.json());
    assert!(
        answer.code == Some(1) && steps.contains("its process has ended") && steps.contains("start it"),
        "{steps}"
    );
    // And: after its return it is not listed as lost
    let _knee = scenario.start("knee", 2, &[]);
    scenario.until("it is back", "hip", &["nodes"], |json| {
        json["lost"].as_array().is_some_and(Vec::is_empty) && named(&json["nodes"], "knee").is_some()
    });
}

#[test]
fn circle_of_waiting_applications_is_shown() {
    let scenario = Scenario::new();
    // Given: nodes with running applications, because a node ends if its applications can never start
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
        |name| move |json: &Value| named(&json["apps"], name).is_some_and(|app| app["state"] == "waits");
    scenario.until("both wait", "hip", &["apps"], |json| waits("gait")(json) && waits("drive")(json));
    let answer = scenario.sinew("hip", &["why", "gait", "drive", "--json"]);
    let steps = blocked(&answer.json());
    assert!(answer.code == Some(1) && steps.contains("drive -> gait -> drive"), "{steps}");
    // And: an absent application is reported as absent
    let answer = scenario.sinew("hip", &["why", "hip", "ankle"]);
    assert!(answer.code == Some(1) && answer.out.contains("'ankle'"), "{}", answer.out);
}

/// The count that the node's application handles, with a renamed field.
mod renamed {
    use super::*;
    payload!("scenario.count", Bulk => pub(super) struct Count { amount: u64 });
}

#[test]
fn client_with_renamed_field_is_named_by_each_node() {
    let scenario = Scenario::new();
    let _hip = scenario.start("hip", 1, &["--requires", "knee"]);
    let _knee = scenario.start("knee", 2, &[]);
    let api = NodeApi::connect(scenario.socket("hip")).expect("its socket");
    let registration = Registration::new().name("gait").sends::<renamed::Count>().requires(["hip", "knee"]);
    let _gait = api.register_transport_address(registration).expect("it is registered");
    for receiver in ["hip", "knee"] {
        let what = format!("the difference between the gait and the {receiver} is known");
        let json = scenario.until(&what, receiver, &["why", "gait", receiver], |json| {
            json["steps"].is_array() && blocked(json).contains("scenario.count")
        });
        let steps = blocked(&json);
        for part in ["`amount` (u64)", "`number` (u64)", "build both programs"] {
            assert!(steps.contains(part), "{part}: {steps}");
        }
    }
}

#[test]
fn shared_name_resolves_as_seen_from_the_other_end() {
    // Given: two nodes, each with an application of the same name
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
    let step = |json: &Value, what: &str| {
        let steps = json["steps"].as_array().cloned().unwrap_or_default();
        steps.into_iter().find(|step| step["step"] == what).unwrap_or_default()
    };
    // Then: for each queried node, and for each order of the two
    for here in ["hip", "knee"] {
        for (end, node) in [("127.0.0.1", "hip"), ("knee", "knee")] {
            for words in [["why", end, "drive"], ["why", "drive", end]] {
                let json = scenario.until("the way is free", here, &words, |json| json["free"] == true);
                let there = step(&json, "drive is there");
                assert!(
                    there["detail"].as_str().is_some_and(|seen| seen.starts_with(&format!("node {node} at"))),
                    "through {here}, {words:?}: {json}"
                );
                assert_eq!(step(&json, "drive is one of 2")["status"], "note", "{json}");
            }
        }
    }
    over.store(true, Ordering::Relaxed);
    drives.into_iter().for_each(|drive| drive.join().expect("it got nothing"));
}

#[test]
fn stream_transport_is_shown_from_both_ends() {
    // Given: two nodes with datagrams, and one with datagrams switched off
    let scenario = Scenario::new();
    let mut hip = scenario.start("hip", 1, &["--requires", "knee", "--requires", "ankle"]);
    let _knee = scenario.start("knee", 2, &[]);
    let off = [("[lncl]", "[gncl]\ndatagrams = false\n[lncl]")];
    let _ankle = scenario.start_changed("ankle", 3, &off, &[]);
    hip.wait_for(&["started"]);
    let seen = |json: &Value, what: &str| {
        let steps = json["steps"].as_array().cloned().unwrap_or_default();
        let step = steps.into_iter().find(|step| step["step"] == what);
        step.map_or_else(String::new, |step| format!("{} {}", step["detail"], step["suggested_fix"]))
    };
    // Then: values in both directions go by datagram after the first was answered
    scenario.until("datagrams get through", "hip", &["why", "hip", "knee"], |json| {
        ["class Stream from hip to knee", "class Stream from knee to hip"]
            .iter()
            .all(|what| seen(json, what).contains("by datagram (UDP)") && json["free"] == true)
    });
    // And: both report why they use none, and this does not block the path
    scenario.until("all links are up", "hip", &["why", "hip", "ankle"], |json| {
        let (there, back) =
            (seen(json, "class Stream from hip to ankle"), seen(json, "class Stream from ankle to hip"));
        json["free"] == true
            && there.contains("the other end takes no datagrams")
            && back.contains("switched off here")
            && back.contains("`datagrams = true` under [gncl] of ankle")
    });
}

#[test]
fn message_to_a_waiting_application_names_its_requirement() {
    // Given
    let scenario = Scenario::new();
    let _robot = scenario.start_a_knee_that_waits_for_an_ankle();
    // When
    let json = scenario.until("all links are up", "hip", &["why", "hip", "knee"], |json| {
        json["steps"].is_array() && blocked(json).lines().count() == 1
    });
    // Then
    let why = blocked(&json);
    assert!(why.starts_with("\"knee takes messages\"") && why.contains("ankle (not there)"), "{why}");
    let steps = json["steps"].as_array().expect("a list");
    let there = steps.iter().find(|step| step["step"] == "a message goes from hip to knee");
    let seen = there.expect("it is a step")["detail"].as_str().expect("a text");
    assert!(seen.starts_with("not tried: it is not ready: has waited "), "{seen}");
}
