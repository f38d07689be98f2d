//! Whoever has a second terminal asks the robot with `sinew`, through the sockets that its nodes have by themselves.

use std::path::Path;
use std::time::{Duration, Instant};

use serde_json::Value;

use crate::{DEADLINE, SOCKETS, alone, end, folder, sinew, start};

const NODES: [&str; 4] = ["ankle", "central", "hip", "knee"];
const LOOK_PERIOD: Duration = Duration::from_millis(100);

/// Asks until this is so.
#[track_caller]
fn until(what: &str, mut look: impl FnMut() -> Result<(), String>) {
    let deadline = Instant::now() + DEADLINE;
    while let Err(seen) = look() {
        assert!(Instant::now() < deadline, "{what} within {DEADLINE:?}: {seen}");
        std::thread::sleep(LOOK_PERIOD);
    }
}

/// The names of the sockets in a test's folder, in their order.
fn sockets(folder: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(folder.join(SOCKETS)).expect("the folder of this test").flatten();
    let names = entries.map(|entry| entry.file_name().to_string_lossy().into_owned());
    let mut names: Vec<String> = names.filter(|name| name.ends_with(".sock")).collect();
    names.sort();
    names
}

/// Whether `sinew`, which is told no socket, has had an answer of each of the four nodes itself.
fn see_all_nodes(folder: &Path) -> Result<(), String> {
    let output = sinew(folder, &["nodes", "--json"]);
    let words = || String::from_utf8_lossy(&[&output.stdout[..], &output.stderr].concat()).into_owned();
    let said: Value = serde_json::from_slice(&output.stdout).map_err(|_| words())?;
    let nodes = said["nodes"].as_array().ok_or_else(words)?;
    // A node that has answered itself says which process it is.
    let mut seen: Vec<&str> =
        nodes.iter().filter(|node| node["pid"].is_u64()).filter_map(|node| node["name"].as_str()).collect();
    seen.sort_unstable();
    if seen == NODES { Ok(()) } else { Err(words()) }
}

#[test]
fn sinew_finds_the_walking_robot_by_itself_and_a_launcher_that_is_killed_leaves_no_socket() {
    let _alone = alone();
    let folder = folder("sockets");
    // Given: a robot whose user has said nothing of sockets
    let mut child = start(&folder, &["--strides", "1000", "--runs", "runs"]);
    let id = child.id();

    // When, then
    until("all nodes are seen", || see_all_nodes(&folder));
    let expected = NODES.map(|node| format!("sinew-exoskeleton-{id}-{node}.sock"));
    assert_eq!(sockets(&folder), expected, "a door for each node");

    // And: they go with the robot
    child.kill().expect("it is a child of this process");
    let _ = end(child, "it is killed");
    until("the sockets are gone", || {
        let left = sockets(&folder);
        if left.is_empty() { Ok(()) } else { Err(left.join(", ")) }
    });
    // The nodes may still be writing their last rows there.
    let _ = std::fs::remove_dir_all(&folder);
}
