//! `sinew up` with the robot file of this example: one command starts all parts, they walk, and one command ends them.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use exoskeleton::robot::topology::for_this_host;

use crate::{DEADLINE, PROGRAM, SOCKETS, alone, folder, sinew};

/// A robot that is down at the end of the test, also if the test fails.
struct Robot {
    folder: PathBuf,
}

impl Robot {
    /// Writes both files of the example, with the program, the ports and the sockets of this test.
    fn new(name: &str) -> Self {
        let folder = folder(name);
        // Without the command the test ends here, and has nothing to stop.
        assert!(sinew(&folder, &["--version"]).status.success());
        let sockets = folder.join(SOCKETS);
        let mut topology = for_this_host(1).expect("free ports");
        let joints = ["hip", "knee", "ankle"].into_iter().zip(&mut topology.joints);
        for (part, place) in joints.chain([("central", &mut topology.central)]) {
            place.socket = Some(sockets.join(format!("{part}.sock")));
        }
        let write = |name: &str, text: String| {
            std::fs::write(folder.join(name), text).expect("a file in this test's folder");
        };
        write("here.toml", topology.to_toml());
        let file = include_str!("../../robot.toml")
            .replace("../../target/release/exoskeleton", PROGRAM)
            .replace("/tmp/sinew-my-leg-", &format!("{}/", sockets.display()))
            .replace("[robot]\n", "[robot]\nready_within_ms = 120000\n");
        write(
            "robot.toml",
            format!("{file}\n[host.here]\nfolder = \"{}\"\n", folder.join("state").display()),
        );
        Self { folder }
    }

    /// Runs the command, which has to succeed. Returns its output.
    fn sinew(&self, words: &[&str]) -> String {
        let output = sinew(&self.folder, words);
        let out = String::from_utf8_lossy(&output.stdout).into_owned();
        let err = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "sinew {words:?}: {out}{err}");
        out
    }
}

impl Drop for Robot {
    fn drop(&mut self) {
        // A test that has failed leaves no processes.
        let _ = sinew(&self.folder, &["down"]);
        let _ = std::fs::remove_dir_all(&self.folder);
    }
}

#[test]
fn robot_file_starts_a_leg_that_walks() {
    let _alone = alone();
    let robot = Robot::new("up");
    let up = robot.sinew(&["up"]);
    assert!(up.ends_with("released: all 5 nodes are ready\n"), "{up}");
    let deadline = Instant::now() + DEADLINE;
    loop {
        let log = robot.sinew(&["logs", "--robot", "robot.toml", "--node", "plant"]);
        if log.contains("stride 2") {
            break;
        }
        assert!(Instant::now() < deadline, "the leg does not walk: {log}");
        // Between two looks, until the deadline.
        std::thread::sleep(Duration::from_millis(100));
    }
    let down = robot.sinew(&["down"]);
    assert!(down.ends_with("my-leg: nothing is left\n"), "{down}");
    assert!(!robot.folder.join("state").exists(), "files of the robot are left");
}
