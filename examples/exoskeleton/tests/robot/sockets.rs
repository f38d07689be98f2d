//! A user with a second terminal queries the robot with `sinew`, through the sockets that its nodes have by
//! default.

use std::path::Path;
use std::time::{Duration, Instant};

use serde_json::Value;

use crate::{DEADLINE, SOCKETS, alone, end, folder, journals, sinew, start};

const NODES: [&str; 4] = ["ankle", "central", "hip", "knee"];
const LOOK_PERIOD: Duration = Duration::from_millis(100);

/// Repeats the check until it succeeds.
#[track_caller]
fn until(what: &str, mut query: impl FnMut() -> Result<(), String>) {
    let deadline = Instant::now() + DEADLINE;
    while let Err(seen) = query() {
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

/// Checks that `sinew`, without `--socket`, has an answer of each of the four nodes itself.
fn see_all_nodes(folder: &Path) -> Result<(), String> {
    let output = sinew(folder, &["nodes", "--json"]);
    let words = || String::from_utf8_lossy(&[&output.stdout[..], &output.stderr].concat()).into_owned();
    let json: Value = serde_json::from_slice(&output.stdout).map_err(|_| words())?;
    let nodes = json["nodes"].as_array().ok_or_else(words)?;
    // A node that has answered itself reports its process ID.
    let mut seen: Vec<&str> =
        nodes.iter().filter(|node| node["pid"].is_u64()).filter_map(|node| node["name"].as_str()).collect();
    seen.sort_unstable();
    if seen == NODES { Ok(()) } else { Err(words()) }
}

#[test]
fn killed_launcher_leaves_no_socket_and_no_journal() {
    let _alone = alone();
    let folder = folder("sockets");
    // given: a robot without configured sockets
    let mut child = start(&folder, &["--strides", "1000", "--runs", "runs"]);
    let id = child.id();

    // when, then
    until("all nodes are seen", || see_all_nodes(&folder));
    let expected = NODES.map(|node| format!("sinew-exoskeleton-{id}-{node}.sock"));
    assert_eq!(sockets(&folder), expected, "a socket for each node");
    assert_eq!(journals(id).len(), 1, "a folder with the journals");

    // and: they are removed with the robot
    child.kill().expect("it is a child of this process");
    let _ = end(child, "it is killed");
    until("the sockets and the journals are gone", || {
        let left = [sockets(&folder), journals(id)].concat();
        if left.is_empty() { Ok(()) } else { Err(left.join(", ")) }
    });
    // The nodes may still be writing their last rows there.
    let _ = std::fs::remove_dir_all(&folder);
}
