//! The command itself, against real node processes: what it says of two nodes from one of them, and how it fails.

mod access;
mod doctor;
mod keys;
mod mistakes;
mod output;
mod scenario;
mod secured;
mod send;
mod watch;
mod why;

use std::{path::Path, time::Duration};

use rustix::process::Signal;
use serde_json::Value;
use sinew::{NodeApi, Registration, barrier::Barrier};
use sinew_tests::{OwnDirectory, Program};

use scenario::{Scenario, named, sinew};

#[test]
fn both_nodes_are_seen_from_either_of_them_with_their_links_and_lives() {
    // Given: two nodes, connected
    let scenario = Scenario::new();
    let mut hip = scenario.start("hip", 1, &["--requires", "knee"]);
    let knee = scenario.start("knee", 2, &[]);
    hip.wait_for(&["started"]);
    for (here, other) in [("hip", "knee"), ("knee", "hip")] {
        // When: each is asked, which knows the other's clock after a query
        let said = scenario.until("the other is linked and measured", here, &["nodes"], |said| {
            named(&said["nodes"], other).is_some_and(|node| {
                let links = node["links"].as_array().map_or(&[][..], Vec::as_slice);
                let all_up = links.len() == 3 && links.iter().all(|link| link["up"] == true);
                all_up
                    && node["round_trip_ns"].is_u64()
                    && node["clock_offset_ns"].is_i64()
                    && node["clock_drift_bound_ppb"].is_u64()
            })
        });
        // Then
        assert_eq!(said["nodes"].as_array().map(Vec::len), Some(2), "{said}");
        let (own, far) =
            (named(&said["nodes"], here).expect("itself"), named(&said["nodes"], other).expect("the other"));
        assert_eq!((&own["state"], &far["state"]), (&"here".into(), &"ready".into()), "{said}");
        assert!(far["incarnation"].is_u64() && far["up_us"].is_u64(), "{far}");
    }
    let said = scenario
        .until("the knee is there", "hip", &["nodes"], |said| named(&said["nodes"], "knee").is_some());
    assert_eq!(named(&said["nodes"], "knee").expect("it")["pid"], knee.id(), "it has answered itself");
    let table = scenario.sinew("hip", &["nodes"]);
    // On a machine that has no time for it a node says below the table that it was starved, or what of it did not get on.
    let is_starved = |line: &&str| line.contains("got no processor") || line.contains("does not get on");
    let lines = table.out.lines().filter(|line| !is_starved(line)).count();
    let code = i32::from(table.out.contains("does not get on"));
    assert_eq!((table.code, lines), (Some(code), 4), "{}{}", table.out, table.err);
    assert!(table.out.contains("127.0.0.2") && table.out.contains("3 up"), "{}", table.out);
    assert!(table.out.contains("hip finds others by: seed off, multicast 1"), "{}", table.out);
}

#[test]
fn who_waits_and_who_is_missing_is_seen_from_another_node() {
    // Given: an application that waits for one that is nowhere
    let scenario = Scenario::new();
    let _hip = scenario.start("hip", 1, &["--requires", "ankle"]);
    let _knee = scenario.start("knee", 2, &[]);
    // When: the other node is asked
    let waits = |said: &Value| named(&said["apps"], "hip").is_some_and(|app| app["state"] == "waits");
    let ready = |said: &Value| named(&said["apps"], "knee").is_some_and(|app| app["ready"] == true);
    let said =
        scenario.until("the hip waits, the knee runs", "knee", &["apps"], |said| waits(said) && ready(said));
    // Then
    let hip = named(&said["apps"], "hip").expect("it was there");
    assert_eq!((&hip["node"], &hip["ready"]), (&"127.0.0.1".into(), &false.into()), "{said}");
    let missing = &hip["missing"][0];
    assert_eq!((&missing["name"], &missing["why"]), (&"ankle".into(), &"not there".into()), "{hip}");
    assert!(
        missing["since_us"].is_u64() && hip["missing"].as_array().is_some_and(|all| all.len() == 1),
        "{hip}"
    );
    assert_eq!(said["apps"].as_array().map(Vec::len), Some(2), "the command shows nothing of itself: {said}");
    let barriers = scenario.sinew("knee", &["barriers", "--json"]);
    let said = barriers.json();
    assert_eq!(barriers.code, Some(1), "that somebody waits is a finding");
    assert_eq!(
        named(&said["missing"], "ankle").expect("it is missing")["blocks"],
        serde_json::json!(["hip"]),
        "{said}"
    );
    let table = scenario.sinew("knee", &["barriers"]).out;
    assert!(table.contains("ankle (not there)") && table.contains("hip"), "{table}");
}

#[test]
fn who_waits_at_a_run_time_barrier_and_who_is_missing_there_is_seen_from_another_node() {
    // Given: one of two parties has arrived
    let scenario = Scenario::new();
    let mut hip = scenario.start("hip", 1, &["--requires", "knee"]);
    let _knee = scenario.start("knee", 2, &[]);
    hip.wait_for(&["started"]);
    let barrier = Barrier::new("calibrated", ["hip.imu", "knee.imu"]);
    let party = |node: &str, name: &str| {
        let api = NodeApi::connect(scenario.socket(node)).expect("its socket");
        let mut imu =
            api.register_transport_address(Registration::new().name(name)).expect("it is registered");
        let barrier = barrier.clone();
        std::thread::spawn(move || imu.meet(&barrier))
    };
    let first = party("knee", "knee.imu");
    // When
    let said = scenario
        .until("it waits", "hip", &["barriers"], |said| named(&said["barriers"], "calibrated").is_some());
    // Then
    let seen = named(&said["barriers"], "calibrated").expect("it was there");
    assert_eq!(
        (&seen["node_name"], &seen["waiting"][0]["name"]),
        (&"knee".into(), &"knee.imu".into()),
        "{said}"
    );
    assert!(named(&seen["missing"], "hip.imu").is_some(), "{said}");
    let table = scenario.sinew("hip", &["barriers"]);
    assert!(table.code == Some(1) && table.out.contains("hip.imu ("), "{}", table.out);
    // And: when both are there, nobody waits any more
    let second = party("hip", "hip.imu");
    for waiting in [first, second] {
        waiting.join().expect("it does not panic").expect("it opens");
    }
    let table = scenario.sinew("hip", &["barriers"]);
    assert!(table.code == Some(0) && table.out.contains("nobody waits"), "{}", table.out);
}

#[test]
fn where_no_node_is_it_says_where_it_looked_and_how_to_start_one() {
    let directory = OwnDirectory::new();
    std::fs::create_dir(directory.join("sinew")).expect("the test's own directory");
    std::fs::write(directory.join("sinew/old.sock"), "").expect("the test's own directory");
    let nowhere = directory.join("gone.sock");
    let answer = sinew(&["--socket", nowhere.to_str().expect("a short path"), "nodes"], &directory.join(""));
    assert_eq!(answer.code, Some(3));
    for words in ["gone.sock", "--socket", "lncl", "sinew-node"] {
        assert!(answer.err.contains(words), "{words}: {}", answer.err);
    }
}

#[test]
fn a_node_is_found_in_the_usual_directory_beside_the_socket_of_one_that_has_gone() {
    // Given: a file of a node that was killed, and a node
    let scenario = Scenario::new();
    let sinew_directory = scenario.directory.join("sinew");
    std::fs::create_dir(&sinew_directory).expect("the test's own directory");
    std::fs::write(sinew_directory.join("a-former.sock"), "").expect("the test's own directory");
    let _knee = scenario.start("sinew/knee", 1, &[]);
    // When, then
    let answer = sinew(&["nodes"], &scenario.directory.join(""));
    assert!(answer.code == Some(0) && answer.out.contains("sinew/knee"), "{}{}", answer.out, answer.err);
}

#[test]
fn a_wrong_command_line_is_2_and_help_names_the_exit_codes() {
    for words in
        [&["nodse"][..], &["send", "knee"], &["ping", "knee", "--count", "0"], &["completions", "tcsh"]]
    {
        let answer = sinew(words, Path::new("/"));
        assert_eq!((answer.code, answer.out.as_str()), (Some(2), ""), "{words:?}");
        // And: a program is told why, too, wherever it asks for that.
        for asking in [[words, &["--json"]].concat(), [&["--json"], words].concat()] {
            let answer = sinew(&asking, Path::new("/"));
            assert_eq!(answer.code, Some(2), "{asking:?}");
            let why = answer.json()["fault"].as_str().expect("a text").to_owned();
            let is_told = !why.is_empty() && !why.starts_with("error") && answer.err.contains(&why);
            assert!(is_told, "{why}: {}", answer.err);
        }
    }
    let answer = sinew(&["nodse", "--", "--json"], Path::new("/"));
    assert_eq!((answer.code, answer.out.as_str()), (Some(2), ""), "what is behind -- is no option");
    let help = sinew(&["--help", "--json"], Path::new("/"));
    assert_eq!(help.code, Some(0));
    for words in [
        "nodes",
        "apps",
        "tree",
        "ping",
        "send",
        "watch",
        "why",
        "barriers",
        "audit",
        "doctor",
        "Exit codes",
        "SINEW_SOCKET",
    ] {
        assert!(help.out.contains(words), "{words}: {}", help.out);
    }
}

#[test]
fn help_of_commands_that_ask_no_node_offers_neither_a_socket_nor_a_deadline() {
    for words in [&["keys"][..], &["keys", "init"], &["keys", "show"], &["completions"]] {
        for help in ["--help", "-h"] {
            let answer = sinew(&[words, &[help]].concat(), Path::new("/"));
            assert_eq!(answer.code, Some(0), "{}", answer.err);
            assert!(
                !answer.out.contains("--socket") && !answer.out.contains("--deadline-ms"),
                "{}",
                answer.out
            );
            assert!(answer.out.contains("--json"), "{}", answer.out);
        }
    }
    for words in [&["--help"][..], &["nodes", "--help"]] {
        let answer = sinew(words, Path::new("/"));
        assert!(answer.out.contains("--socket") && answer.out.contains("--deadline-ms"), "{}", answer.out);
    }
    // And: who says them for all commands, as an alias does, is not refused
    let directory = OwnDirectory::new();
    let keys = directory.join("keys");
    let keys = keys.to_str().expect("a short path");
    for at_front in [true, false] {
        let options = ["--socket", "/tmp/none.sock", "--deadline-ms", "50"];
        let show = ["keys", "show", "--keys", keys];
        let words = if at_front { [options, show].concat() } else { [show, options].concat() };
        let answer = sinew(&words, Path::new("/"));
        assert!(answer.code == Some(1) && answer.err.contains("ca.pem"), "{}", answer.err);
    }
}

#[test]
fn every_application_and_node_is_pinged_by_tid_and_by_name_from_either_node() {
    // Given: two nodes with their applications, and one in another process, which receives
    let scenario = Scenario::new();
    let mut hip = scenario.start("hip", 1, &["--requires", "knee"]);
    let mut knee = scenario.start("knee", 2, &[]);
    hip.wait_for(&["started"]);
    let tid = knee.wait_for(&["started"]);
    let tid = tid.split_once(' ').expect("it says its TID").1;
    let api = NodeApi::connect(scenario.socket("knee")).expect("the knee's socket");
    let mut client =
        api.register_transport_address(Registration::new().name("leg/client")).expect("it is registered");
    let (say_over, over) = std::sync::mpsc::sync_channel(1);
    let receiving = std::thread::spawn(move || {
        while over.try_recv().is_err() {
            let received = client.receive(Duration::from_millis(10)).expect("its node lives");
            assert!(received.is_none(), "a ping is answered without the program");
        }
    });
    scenario.until("the client is known on the hip", "hip", &["apps"], |said| {
        named(&said["apps"], "leg/client").is_some_and(|app| app["ready"] == true)
    });
    for here in ["hip", "knee"] {
        for whom in [tid, "knee", "hip", "leg/client", "127.0.0.1", "127.0.0.2", "127.0.0.2/inspect"] {
            // When
            let answer = scenario.sinew(here, &["ping", whom, "--count", "20", "--json"]);
            // Then
            assert_eq!(answer.code, Some(0), "{whom}: {}{}", answer.out, answer.err);
            let said = answer.json();
            assert_eq!((&said["sent"], &said["answered"]), (&20.into(), &20.into()), "{whom}: {said}");
            assert_eq!(said["outcome"], "Delivered", "whoever it is knows a ping: {whom}: {said}");
            let [p50, p99] = ["p50_ns", "p99_ns"].map(|key| said[key].as_u64().expect("a time"));
            assert!(0 < p50 && p50 <= p99, "{said}");
        }
    }
    say_over.send(()).expect("it still receives");
    receiving.join().expect("it got nothing");
    // And: it was handled nowhere, so that the nodes say nothing of it
    let silent = |node: &Program| !node.said().iter().any(|line| line.starts_with("count"));
    assert!(silent(&hip) && silent(&knee));
}

#[test]
fn who_does_not_answer_a_ping_is_a_finding_with_a_reason() {
    let scenario = Scenario::new();
    let _robot = scenario.start_a_knee_that_waits_for_an_ankle();
    let answer = scenario.sinew("hip", &["ping", "knee", "--deadline-ms", "50"]);
    assert!(
        answer.code == Some(1) && answer.out.contains("ankle (not there)"),
        "{}{}",
        answer.out,
        answer.err
    );
    for (whom, words) in [
        ("ankle", "ankle"),
        ("127.0.0.9", "not known"),
        ("127.0.0.1/1fff", "no application"),
        ("x/y", "node address"),
    ] {
        let answer = scenario.sinew("hip", &["ping", whom]);
        let said = answer.out + &answer.err;
        assert!(answer.code == Some(1) && said.contains(words), "{whom}: {said}");
    }
}

#[test]
fn a_node_that_is_stopped_is_shown_as_such_and_does_not_hide_the_other() {
    // Given: two nodes that know each other, of which one is stopped
    let scenario = Scenario::new();
    let mut hip = scenario.start("hip", 1, &["--requires", "knee"]);
    let knee = scenario.start("knee", 2, &[]);
    hip.wait_for(&["started"]);
    knee.freeze();
    // When
    let said =
        scenario.until("it does not answer, or is lost", "hip", &["nodes", "--deadline-ms", "200"], |said| {
            named(&said["nodes"], "knee").is_none_or(|node| node["state"] != "ready")
        });
    // Then
    assert_eq!(named(&said["nodes"], "hip").expect("the one that lives")["state"], "here", "{said}");
    knee.signal(Signal::CONT);
}

#[test]
fn the_tree_of_another_node_has_its_layers_and_its_application() {
    let scenario = Scenario::new();
    let mut hip = scenario.start("hip", 1, &["--requires", "knee"]);
    let _knee = scenario.start("knee", 2, &[]);
    hip.wait_for(&["started"]);
    let said = scenario.sinew("hip", &["tree", "knee", "--json"]).json();
    let nodes = said["nodes"].as_array().expect("a list");
    assert_eq!(nodes.len(), 1, "the one that was asked for: {said}");
    let tree = &nodes[0]["tree"];
    for name in ["layers", "LNCL", "sync manager", "GNCL", "NDL", "applications"] {
        assert_eq!(named(tree, name).unwrap_or_else(|| panic!("no {name}: {said}"))["state"], "ready");
    }
    let app = named(tree, "knee").expect("its application");
    assert_eq!(
        (&app["depth"], &app["restarts"], &app["state"]),
        (&1.into(), &0.into(), &"ready".into()),
        "{app}"
    );
    let text = scenario.sinew("hip", &["tree"]).out;
    assert!(text.contains("127.0.0.1 hip\n") && text.contains("127.0.0.2 knee\n"), "{text}");
    assert_eq!(scenario.sinew("hip", &["tree", "ankle"]).code, Some(1));
}

#[test]
fn an_audit_explains_every_message_of_both_nodes_while_they_talk_and_names_who_does_not_answer() {
    // Given: the hip sends to the knee all the time
    let scenario = Scenario::new();
    let (_hip, knee) = scenario.start_a_hip_that_sends_to_a_knee();
    for here in ["hip", "knee"] {
        // When
        let answer = scenario.sinew(here, &["audit", "--json"]);
        // Then: what was sent is where it was handled, and nothing is missing
        let said = answer.json();
        assert_eq!(answer.code, Some(0), "{said}");
        assert_eq!((&said["unexplained"], &said["silent"]), (&serde_json::json!([]), &serde_json::json!([])));
        let knee = named(&said["nodes"], "knee").expect("it has answered");
        let is_bulk_of_the_knee = |entry: &&Value| {
            let mailbox = &entry["place"]["Mailbox"];
            mailbox["name"] == "knee" && mailbox["class"] == "Bulk"
        };
        let entry = knee["entries"].as_array().and_then(|entries| entries.iter().find(is_bulk_of_the_knee));
        let entry = entry.unwrap_or_else(|| panic!("no mailbox of the knee: {said}"));
        assert!(entry["account"]["delivered"].as_u64() >= Some(5), "{entry}");
    }
    let table = scenario.sinew("knee", &["audit"]).out;
    for words in ["every message is explained", "mailbox knee", "127.0.0.1 -> 127.0.0.2, Bulk"] {
        assert!(table.contains(words), "{words}: {table}");
    }
    // And: who is stopped is named, and a finding
    knee.freeze();
    let answer = scenario.sinew("hip", &["audit", "--deadline-ms", "200"]);
    assert!(answer.code == Some(1) && answer.out.contains("127.0.0.2 did not answer"), "{}", answer.out);
    knee.signal(Signal::CONT);
}

#[test]
fn the_doctor_tries_each_thing_and_every_finding_has_what_mends_it() {
    let scenario = Scenario::new();
    let _hip = scenario.start("hip", 1, &[]);
    let answer = scenario.sinew("hip", &["doctor", "--json"]);
    let said = answer.json();
    let checks = said["checks"].as_array().expect("a list");
    let names: Vec<_> = checks.iter().filter_map(|check| check["check"].as_str()).collect();
    assert_eq!(
        names,
        [
            "interfaces",
            "multicast",
            "open files",
            "locked memory",
            "real-time rights",
            "CPU governor",
            "clock",
            "shared memory",
            "own processes",
            "socket directory",
            "leftover sockets",
            "node",
            "security",
            "reach"
        ]
    );
    assert!(checks.iter().all(|check| check["fine"] == check["mend"].is_null()), "{said}");
    assert_eq!(answer.code, Some(i32::from(checks.iter().any(|check| check["fine"] == false))));
    // Its nodes have found each other in a group, and its socket is there.
    let is_fine = |said: &Value, name: &str| {
        let checks = said["checks"].as_array().expect("a list");
        checks.iter().find(|check| check["check"] == name).expect("it is there")["fine"] == true
    };
    // It is open, and nobody but this host reaches it.
    for name in ["multicast", "shared memory", "node", "security"] {
        assert!(is_fine(&said, name), "{name}: {said}");
    }
    // So no other host sees it, either.
    let reach = checks.iter().find(|check| check["check"] == "reach").expect("it is there");
    let mend = reach["mend"].as_str().expect("a finding");
    assert!(mend.contains("[ndl]") && mend.contains("interface = \""), "{mend}");
    // What cannot be is a finding: nobody has this address.
    let said = scenario.sinew("hip", &["doctor", "--interface", "192.0.2.1", "--json"]).json();
    assert!(!is_fine(&said, "multicast"), "{said}");
}

#[test]
fn a_node_that_was_put_on_loopback_by_its_name_is_no_finding_of_the_doctor() {
    let scenario = Scenario::new();
    let _hip = scenario.start_changed("hip", 1, &[("[ndl]", "[ndl]\ninterface = \"lo\"")], &[]);
    let said = scenario.sinew("hip", &["doctor", "--json"]).json();
    for name in ["security", "reach"] {
        let check = said["checks"].as_array().expect("a list").iter().find(|check| check["check"] == name);
        let seen = check.expect("it is there")["seen"].as_str().expect("a text");
        assert!(check.is_some_and(|check| check["fine"] == true) && seen.contains("hip"), "{said}");
    }
}

#[test]
fn the_socket_of_a_node_that_was_killed_is_a_finding_and_one_of_a_node_that_lives_is_none() {
    // Given
    let scenario = Scenario::new();
    std::fs::create_dir(scenario.directory.join("sinew")).expect("the test's own directory");
    let _knee = scenario.start("sinew/knee", 1, &[]);
    let hip = scenario.start("sinew/hip", 2, &[]);
    let leftover = || {
        let said = sinew(&["doctor", "--json"], &scenario.directory.join("")).json();
        let checks = said["checks"].as_array().expect("a list").iter();
        checks.into_iter().find(|check| check["check"] == "leftover sockets").expect("it is there").clone()
    };
    let names = |check: &Value, name: &str| check["mend"].as_str().is_some_and(|mend| mend.contains(name));
    assert!(!names(&leftover(), "knee.sock") && !names(&leftover(), "hip.sock"));
    // When: killed
    drop(hip);
    // Then
    let check = leftover();
    assert!(names(&check, "hip.sock") && !names(&check, "knee.sock"), "{check}");
}

#[test]
fn every_shell_is_told_the_commands() {
    for shell in ["bash", "zsh", "fish"] {
        let answer = sinew(&["completions", shell], Path::new("/"));
        assert!(
            answer.code == Some(0) && answer.out.contains("barriers"),
            "{shell}: {}{}",
            answer.out,
            answer.err
        );
    }
}
