//! The command itself, against real node processes: its view of two nodes from one of them, and its failures.

mod access;
mod bag;
mod contracts;
mod doctor;
mod fault;
mod foxglove;
mod keys;
mod logs;
mod mistakes;
mod output;
mod page;
mod param;
mod play;
mod record;
mod reference;
mod scenario;
mod secured;
mod send;
mod shipped;
mod stop;
mod top;
mod up;
mod up_hosts;
mod view;
mod watch;
mod why;

use std::{path::Path, time::Duration};

use rustix::process::Signal;
use serde_json::Value;
use sinew::{NodeApi, Registration, barrier::Barrier};
use sinew_testkit::{NodeProcess, TestDirectory};

use scenario::{Scenario, named, sinew};

#[test]
fn both_nodes_are_shown_from_either_one() {
    // Given: two nodes, connected
    let scenario = Scenario::new();
    let mut hip = scenario.start("hip", 1, &["--requires", "knee"]);
    let knee = scenario.start("knee", 2, &[]);
    hip.wait_for(&["started"]);
    for (here, other) in [("hip", "knee"), ("knee", "hip")] {
        // When: each is asked, and the clock of the other was measured by a query
        let json = scenario.until("the other is linked and measured", here, &["nodes"], |json| {
            named(&json["nodes"], other).is_some_and(|node| {
                let links = node["links"].as_array().map_or(&[][..], Vec::as_slice);
                let all_up = links.len() == 3 && links.iter().all(|link| link["up"] == true);
                all_up
                    && node["round_trip_ns"].is_u64()
                    && node["clock_offset_ns"].is_i64()
                    && node["clock_drift_bound_ppb"].is_u64()
            })
        });
        // Then
        assert_eq!(json["nodes"].as_array().map(Vec::len), Some(2), "{json}");
        let (own, far) =
            (named(&json["nodes"], here).expect("itself"), named(&json["nodes"], other).expect("the other"));
        assert_eq!((&own["state"], &far["state"]), (&"here".into(), &"ready".into()), "{json}");
        assert!(far["incarnation"].is_u64() && far["up_us"].is_u64(), "{far}");
    }
    let json = scenario
        .until("the knee is there", "hip", &["nodes"], |json| named(&json["nodes"], "knee").is_some());
    assert_eq!(named(&json["nodes"], "knee").expect("it")["pid"], knee.id(), "it has answered itself");
    let table = scenario.sinew("hip", &["nodes"]);
    // On a busy machine a node reports below the table that it was starved, or that some of its applications do not get
    // on.
    let is_starved = |line: &&str| line.contains("got no processor") || line.contains("does not get on");
    let lines = table.out.lines().filter(|line| !is_starved(line)).count();
    let code = i32::from(table.out.contains("does not get on"));
    assert_eq!((table.code, lines), (Some(code), 4), "{}{}", table.out, table.err);
    assert!(table.out.contains("127.0.0.2") && table.out.contains("3 up"), "{}", table.out);
    assert!(table.out.contains("hip finds others by: seed off, multicast 1"), "{}", table.out);
}

#[test]
fn waiting_application_is_shown_from_another_node() {
    // Given: an application that waits for an absent one
    let scenario = Scenario::new();
    let _hip = scenario.start("hip", 1, &["--requires", "ankle"]);
    let _knee = scenario.start("knee", 2, &[]);
    // When: the other node is asked
    let waits = |json: &Value| named(&json["apps"], "hip").is_some_and(|app| app["state"] == "waits");
    let ready = |json: &Value| named(&json["apps"], "knee").is_some_and(|app| app["ready"] == true);
    let json =
        scenario.until("the hip waits, the knee runs", "knee", &["apps"], |json| waits(json) && ready(json));
    // Then
    let hip = named(&json["apps"], "hip").expect("it was there");
    assert_eq!((&hip["node"], &hip["ready"]), (&"127.0.0.1".into(), &false.into()), "{json}");
    let missing = &hip["missing"][0];
    assert_eq!((&missing["name"], &missing["why"]), (&"ankle".into(), &"not there".into()), "{hip}");
    assert!(
        missing["since_us"].is_u64() && hip["missing"].as_array().is_some_and(|all| all.len() == 1),
        "{hip}"
    );
    assert_eq!(json["apps"].as_array().map(Vec::len), Some(2), "the command shows nothing of itself: {json}");
    let barriers = scenario.sinew("knee", &["barriers", "--json"]);
    let json = barriers.json();
    assert_eq!(barriers.code, Some(1), "that somebody waits is a finding");
    assert_eq!(
        named(&json["missing"], "ankle").expect("it is missing")["blocks"],
        serde_json::json!(["hip"]),
        "{json}"
    );
    let table = scenario.sinew("knee", &["barriers"]).out;
    assert!(table.contains("ankle (not there)") && table.contains("hip"), "{table}");
}

#[test]
fn waiting_and_missing_barrier_parties_are_shown_remotely() {
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
    let json = scenario
        .until("it waits", "hip", &["barriers"], |json| named(&json["barriers"], "calibrated").is_some());
    // Then
    let seen = named(&json["barriers"], "calibrated").expect("it was there");
    assert_eq!(
        (&seen["node_name"], &seen["waiting"][0]["name"]),
        (&"knee".into(), &"knee.imu".into()),
        "{json}"
    );
    assert!(named(&seen["missing"], "hip.imu").is_some(), "{json}");
    let table = scenario.sinew("hip", &["barriers"]);
    assert!(table.code == Some(1) && table.out.contains("hip.imu ("), "{}", table.out);
    // And: when both parties are there, none waits any more
    let second = party("hip", "hip.imu");
    for waiting in [first, second] {
        waiting.join().expect("it does not panic").expect("it opens");
    }
    let table = scenario.sinew("hip", &["barriers"]);
    assert!(table.code == Some(0) && table.out.contains("no application waits"), "{}", table.out);
}

#[test]
fn missing_node_is_reported_with_a_start_hint() {
    let directory = TestDirectory::new();
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
fn node_is_found_beside_a_stale_socket() {
    // Given: the socket file of a killed node, and a running node
    let scenario = Scenario::new();
    let sinew_directory = scenario.directory.join("sinew");
    std::fs::create_dir(&sinew_directory).expect("the test's own directory");
    std::fs::write(sinew_directory.join("a-former.sock"), "").expect("the test's own directory");
    let _knee = scenario.start("sinew/knee", 1, &[]);
    // When, then
    let answer = sinew(&["nodes"], &scenario.directory.join(""));
    assert!(answer.code == Some(0) && answer.out.contains("knee"), "{}{}", answer.out, answer.err);
}

#[test]
fn wrong_usage_exits_with_2() {
    for words in
        [&["nodse"][..], &["send", "knee"], &["ping", "knee", "--count", "0"], &["completions", "tcsh"]]
    {
        let answer = sinew(words, Path::new("/"));
        assert_eq!((answer.code, answer.out.as_str()), (Some(2), ""), "{words:?}");
        // And: with `--json`, wherever it stands, the reason is also in JSON.
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
fn help_of_offline_commands_omits_node_options() {
    for words in [&["keys"][..], &["keys", "init"], &["keys", "show"], &["completions"], &["man"]] {
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
    // And: options set for all commands, as by a shell alias, are not refused
    let directory = TestDirectory::new();
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
fn applications_and_nodes_answer_pings_by_tid_and_name() {
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
            let received = client.receive(Duration::from_millis(10)).expect("its node is alive");
            assert!(received.is_none(), "a ping is answered without the program");
        }
    });
    scenario.until("the client is known on the hip", "hip", &["apps"], |json| {
        named(&json["apps"], "leg/client").is_some_and(|app| app["ready"] == true)
    });
    for here in ["hip", "knee"] {
        for target in [tid, "knee", "hip", "leg/client", "127.0.0.1", "127.0.0.2", "127.0.0.2/inspect"] {
            // When
            let answer = scenario.sinew(here, &["ping", target, "--count", "20", "--json"]);
            // Then
            assert_eq!(answer.code, Some(0), "{target}: {}{}", answer.out, answer.err);
            let json = answer.json();
            assert_eq!((&json["sent"], &json["answered"]), (&20.into(), &20.into()), "{target}: {json}");
            assert_eq!(json["outcome"], "Delivered", "every target answers a ping: {target}: {json}");
            let [p50, p99] = ["p50_ns", "p99_ns"].map(|key| json[key].as_u64().expect("a time"));
            assert!(0 < p50 && p50 <= p99, "{json}");
        }
    }
    say_over.send(()).expect("it still receives");
    receiving.join().expect("it got nothing");
    // And: no handler was called, so that the nodes print nothing
    let silent = |node: &NodeProcess| !node.output().iter().any(|line| line.starts_with("count"));
    assert!(silent(&hip) && silent(&knee));
}

#[test]
fn missing_ping_answer_is_a_finding_with_a_reason() {
    let scenario = Scenario::new();
    let _robot = scenario.start_a_knee_that_waits_for_an_ankle();
    let answer = scenario.sinew("hip", &["ping", "knee", "--deadline-ms", "50"]);
    assert!(
        answer.code == Some(1) && answer.out.contains("ankle (not there)"),
        "{}{}",
        answer.out,
        answer.err
    );
    for (target, words) in [
        ("kneee", "no application and no node is called `kneee`; nearest: knee (application)"),
        (&"k".repeat(64), "it has 64 bytes, and a name has at most 63"),
        ("127.0.0.9", "not known"),
        ("127.0.0.1/1fff", "no application"),
        ("x/y", "node address"),
    ] {
        let answer = scenario.sinew("hip", &["ping", target]);
        let text = answer.out + &answer.err;
        assert!(answer.code == Some(1) && text.contains(words), "{target}: {text}");
    }
}

#[test]
fn stopped_node_does_not_hide_the_other() {
    // Given: two connected nodes, one of them stopped
    let scenario = Scenario::new();
    let mut hip = scenario.start("hip", 1, &["--requires", "knee"]);
    let knee = scenario.start("knee", 2, &[]);
    hip.wait_for(&["started"]);
    knee.pause();
    // When
    let json =
        scenario.until("it does not answer, or is lost", "hip", &["nodes", "--deadline-ms", "200"], |json| {
            named(&json["nodes"], "knee").is_none_or(|node| node["state"] != "ready")
        });
    // Then
    assert_eq!(named(&json["nodes"], "hip").expect("the surviving node")["state"], "here", "{json}");
    knee.signal(Signal::CONT);
}

#[test]
fn tree_of_another_node_has_its_layers_and_application() {
    let scenario = Scenario::new();
    let mut hip = scenario.start("hip", 1, &["--requires", "knee"]);
    let _knee = scenario.start("knee", 2, &[]);
    hip.wait_for(&["started"]);
    let json = scenario.sinew("hip", &["tree", "knee", "--json"]).json();
    let nodes = json["nodes"].as_array().expect("a list");
    assert_eq!(nodes.len(), 1, "the one that was asked for: {json}");
    let tree = &nodes[0]["tree"];
    for name in ["layers", "LNCL", "sync manager", "GNCL", "NDL", "applications"] {
        assert_eq!(named(tree, name).unwrap_or_else(|| panic!("no {name}: {json}"))["state"], "ready");
    }
    let app = named(tree, "knee").expect("its application");
    assert_eq!(
        (&app["depth"], &app["restarts"], &app["state"]),
        (&1.into(), &0.into(), &"ready".into()),
        "{app}"
    );
    let text = scenario.sinew("hip", &["tree"]).out;
    assert!(text.contains("127.0.0.1 hip\n") && text.contains("127.0.0.2 knee\n"), "{text}");
    let unknown = scenario.sinew("hip", &["tree", "kneee"]);
    let words = "no node is called `kneee` or has this address; nearest: knee (node)";
    assert!(unknown.code == Some(1) && unknown.err.contains(words), "{}", unknown.err);
    // After `--` a name may begin with a dash.
    let option = scenario.sinew("hip", &["tree", "--", "-x"]);
    assert!(option.code == Some(1) && option.err.contains("no node is called `-x`"), "{}", option.err);
}

#[test]
fn audit_accounts_for_every_message_and_names_silent_nodes() {
    // Given: the hip sends to the knee all the time
    let scenario = Scenario::new();
    let (_hip, knee) = scenario.start_a_hip_that_sends_to_a_knee();
    for here in ["hip", "knee"] {
        // When
        let answer = scenario.sinew(here, &["audit", "--json"]);
        // Then: every sent message is handled, and none is missing
        let json = answer.json();
        assert_eq!(answer.code, Some(0), "{json}");
        assert_eq!((&json["unexplained"], &json["silent"]), (&serde_json::json!([]), &serde_json::json!([])));
        let knee = named(&json["nodes"], "knee").expect("it has answered");
        let is_bulk_of_the_knee = |entry: &&Value| {
            let mailbox = &entry["place"]["Mailbox"];
            mailbox["name"] == "knee" && mailbox["class"] == "Bulk"
        };
        let entry = knee["entries"].as_array().and_then(|entries| entries.iter().find(is_bulk_of_the_knee));
        let entry = entry.unwrap_or_else(|| panic!("no mailbox of the knee: {json}"));
        assert!(entry["account"]["delivered"].as_u64() >= Some(5), "{entry}");
    }
    let table = scenario.sinew("knee", &["audit"]).out;
    for words in ["every message is explained", "mailbox knee", "127.0.0.1 -> 127.0.0.2, Bulk"] {
        assert!(table.contains(words), "{words}: {table}");
    }
    // And: a stopped node is named, and a finding
    knee.pause();
    let answer = scenario.sinew("hip", &["audit", "--deadline-ms", "200"]);
    assert!(answer.code == Some(1) && answer.out.contains("127.0.0.2 did not answer"), "{}", answer.out);
    knee.signal(Signal::CONT);
}

#[test]
fn every_doctor_finding_has_a_fix() {
    let scenario = Scenario::new();
    let _hip = scenario.start("hip", 1, &[]);
    let answer = scenario.sinew("hip", &["doctor", "--json"]);
    let json = answer.json();
    let checks = json["checks"].as_array().expect("a list");
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
    assert!(checks.iter().all(|check| check["fine"] == check["suggested_fix"].is_null()), "{json}");
    assert_eq!(answer.code, Some(i32::from(checks.iter().any(|check| check["fine"] == false))));
    // Its nodes have discovered each other in a group, and its socket exists.
    let is_fine = |json: &Value, name: &str| {
        let checks = json["checks"].as_array().expect("a list");
        checks.iter().find(|check| check["check"] == name).expect("it is there")["fine"] == true
    };
    // The node is open, and reachable only from this host.
    for name in ["multicast", "shared memory", "node", "security"] {
        assert!(is_fine(&json, name), "{name}: {json}");
    }
    // So no other host discovers it, either.
    let reach = checks.iter().find(|check| check["check"] == "reach").expect("it is there");
    let fix = reach["suggested_fix"].as_str().expect("a finding");
    assert!(fix.contains("[ndl]") && fix.contains("interface = \""), "{fix}");
    // An impossible interface is a finding: no interface has this address.
    let json = scenario.sinew("hip", &["doctor", "--interface", "192.0.2.1", "--json"]).json();
    assert!(!is_fine(&json, "multicast"), "{json}");
}

#[test]
fn node_configured_for_loopback_is_no_finding() {
    let scenario = Scenario::new();
    let _hip = scenario.start_changed("hip", 1, &[("[ndl]", "[ndl]\ninterface = \"lo\"")], &[]);
    let json = scenario.sinew("hip", &["doctor", "--json"]).json();
    for name in ["security", "reach"] {
        let check = json["checks"].as_array().expect("a list").iter().find(|check| check["check"] == name);
        let seen = check.expect("it is there")["detail"].as_str().expect("a text");
        assert!(check.is_some_and(|check| check["fine"] == true) && seen.contains("hip"), "{json}");
    }
}

#[test]
fn socket_of_a_killed_node_is_a_finding() {
    // Given
    let scenario = Scenario::new();
    std::fs::create_dir(scenario.directory.join("sinew")).expect("the test's own directory");
    let _knee = scenario.start("sinew/knee", 1, &[]);
    let hip = scenario.start("sinew/hip", 2, &[]);
    let leftover = || {
        let json = sinew(&["doctor", "--json"], &scenario.directory.join("")).json();
        let checks = json["checks"].as_array().expect("a list").iter();
        checks.into_iter().find(|check| check["check"] == "leftover sockets").expect("it is there").clone()
    };
    let names =
        |check: &Value, name: &str| check["suggested_fix"].as_str().is_some_and(|fix| fix.contains(name));
    assert!(!names(&leftover(), "knee.sock") && !names(&leftover(), "hip.sock"));
    // When: killed
    drop(hip);
    // Then
    let check = leftover();
    assert!(names(&check, "hip.sock") && !names(&check, "knee.sock"), "{check}");
}
