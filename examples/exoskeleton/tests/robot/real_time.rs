//! The robot walks; its parts start, end and fail alone.

use std::path::Path;

use exoskeleton::robot::topology::{Topology, for_this_host};

use crate::{PROGRAM, alone, end, folder, journals, sinew, start};

fn topology_file(folder: &Path, text: &str) -> String {
    let path = folder.join("topology.toml");
    std::fs::write(&path, text).expect("a file in this test's folder");
    path.display().to_string()
}

fn topology_of_this_test() -> Topology {
    let mut topology = for_this_host(1).expect("free ports");
    topology.central.socket = None;
    topology.joints.iter_mut().for_each(|place| place.socket = None);
    topology
}

#[test]
fn five_processes_wait_for_the_late_one() {
    let _alone = alone();
    let folder = folder("walk");
    let (report, runs) = (folder.join("report.json"), folder.join("runs"));
    let arguments =
        ["--strides", "8", "--runs", runs.to_str().unwrap(), "--report", report.to_str().unwrap()];

    let child = start(&folder, &arguments);
    let id = child.id();
    let output = end(child, "the walk ends");

    let stdout = String::from_utf8_lossy(&output.stdout);
    let failed = String::from_utf8_lossy(&output.stderr);
    assert!(stdout.contains("waits for hip.sensor"), "the late hip is waited for:\n{stdout}\n{failed}");
    assert!(stdout.contains("stride 8 of 8"), "{stdout}\n{failed}");
    // Whether limits hold depends on the machine; that it walked does not.
    assert!(matches!(output.status.code(), Some(0 | 3 | 4)), "{:?}\n{stdout}\n{failed}", output.status);
    let report: serde_json::Value = serde_json::from_str(&std::fs::read_to_string(report).unwrap()).unwrap();
    assert_eq!(report["barrier"]["torque_before_release_nm"], 0.0);
    assert!(report["barrier"]["held_s"].as_f64().unwrap() > 1.0, "{report}");
    assert!(report["timing_measured"].as_bool().unwrap());
    assert_eq!(journals(id), Vec::<String>::new(), "they are removed with the robot");
    replay_finds_no_difference(&folder, &stdout);
    std::fs::remove_dir_all(&folder).unwrap();
}

/// Replays the recording that the walk names. A busy machine may have lost messages of it, and no torque may differ.
fn replay_finds_no_difference(folder: &Path, walk: &str) {
    let command = walk.lines().find_map(|line| line.strip_prefix("replay it: exoskeleton "));
    let command = command.unwrap_or_else(|| panic!("it is recorded:\n{walk}"));
    let output = end(start(folder, &command.split(' ').collect::<Vec<_>>()), "the replay ends");
    let words = String::from_utf8_lossy(&[&output.stdout[..], &output.stderr].concat()).into_owned();
    assert!(words.contains("SAME") || words.contains("INCOMPLETE"), "{words}");
    assert_eq!(output.status.code(), Some(i32::from(!words.contains("SAME"))), "{words}");
    if !words.contains("SAME") {
        return;
    }
    let other = [&["--gain-factor", "1.01"], &command.split(' ').collect::<Vec<_>>()[..]].concat();
    let output = end(start(folder, &other), "the replay ends");
    let words = String::from_utf8_lossy(&output.stdout);
    assert!(words.contains("DIFFERENT") && words.contains(", now "), "{words}");
    assert_eq!(output.status.code(), Some(1), "{words}");
    let file = command.strip_prefix("--replay ").expect("the file is the only word behind it");
    check_finds_no_difference(folder, &file.replace("walk.mcap", "knee-1.mcap"));
}

/// Checks the drive of the knee with `sinew play --check`, on the file of its node: a quarter of the messages.
fn check_finds_no_difference(folder: &Path, file: &str) {
    let check = |factor: &str| {
        let drive = [PROGRAM, "check-drive", "knee", "--gain-factor", factor];
        let words = ["play", "--check", file, "--turns", "exo.drive_tick", "--"];
        let output = sinew(folder, &[&words[..], &drive].concat());
        let all = String::from_utf8_lossy(&[&output.stdout[..], &output.stderr].concat()).into_owned();
        (output.status.code(), String::from_utf8_lossy(&output.stdout).into_owned(), all)
    };
    let (code, words, all) = check("1");
    assert!(code == Some(0) && words.starts_with("identical: "), "{code:?}: {all}");
    let (code, words, all) = check("1.01");
    assert!(code == Some(1) && words.contains("the first difference: message "), "{code:?}: {all}");
    assert!(words.contains("of knee.drive, exo.drive_tick") && words.contains("`torque_nm` was "), "{all}");
}

#[test]
fn bad_topology_is_rejected_with_exit_code_1() {
    let folder = folder("refused");
    let text = topology_of_this_test().to_toml().replacen("127.0.0.3", "127.0.0.2", 1);
    let file = topology_file(&folder, &text);

    let output = end(start(&folder, &["node", "hip", "--topology", &file]), "the node is refused");

    let words = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{words}");
    assert!(words.contains("another node's already"), "{words}");
    std::fs::remove_dir_all(&folder).unwrap();
}

#[test]
fn node_and_plant_stop_in_order_with_their_parent() {
    let folder = folder("alone");
    let file = topology_file(&folder, &topology_of_this_test().to_toml());
    for role in ["plant", "hip", "central"] {
        let child = start(&folder, &["node", role, "--stop-with-stdin", "--topology", &file]);
        let output = end(child, role);
        let words = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(0), "{role}: {words}");
    }
    std::fs::remove_dir_all(&folder).unwrap();
}

#[test]
fn second_plant_at_the_same_address_names_the_cause() {
    let folder = folder("twice");
    let taken = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
    let mut topology = topology_of_this_test();
    topology.plant.address = taken.local_addr().unwrap();
    let file = topology_file(&folder, &topology.to_toml());

    let output = end(start(&folder, &["node", "plant", "--topology", &file]), "the plant is refused");

    let words = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{words}");
    assert!(words.contains("is another plant running"), "{words}");
    std::fs::remove_dir_all(&folder).unwrap();
}
