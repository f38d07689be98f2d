//! The bridge, as `zenoh_ros2_sdk` and `rosbags` of PyPI see it.

use std::{path::Path, process::Command, thread, time::Duration};

use sinew_testkit::{NodeProcess, until};

use crate::stage::{Done, Stage};

/// Returns a Python with both packages, or prints the reason why there is none.
fn python() -> Option<String> {
    let python = std::env::var("SINEW_ROS_PYTHON").unwrap_or_else(|_| "python3".to_owned());
    let found = Command::new(&python).args(["-c", "import rosbags, zenoh, zenoh_ros2_sdk"]).output();
    match found {
        Ok(output) if output.status.success() => Some(python),
        Ok(output) => {
            let why =
                String::from_utf8_lossy(&output.stderr).trim().lines().last().unwrap_or_default().to_owned();
            println!(
                "skipped: {python}: {why}; pip install zenoh-ros2-sdk rosbags, and set SINEW_ROS_PYTHON"
            );
            None
        }
        Err(why) => {
            println!("skipped: {python}: {why}; set SINEW_ROS_PYTHON");
            None
        }
    }
}

#[test]
fn python_peer_agrees_in_both_directions() {
    let Some(python) = python() else { return };
    let mut stage = Stage::start();
    let mut command = Command::new(python);
    command.arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/peers/peer.py"));
    // Its loader would clone definitions from the network.
    command.args([stage.port.to_string(), "7".to_owned()]).env("ROS_DOMAIN_ID", "7");
    let mut peer = NodeProcess::start("peer.py", command);
    peer.wait_for(&["joints: leg ['knee'] [3.0]"]);
    peer.wait_for(&["stamp is of now: True"]);
    let rate = peer.wait_for(&["rate:"]);
    println!("{rate} Hz");
    peer.wait_for(&["attachments: [0, 1, 2] 16 application/cdr"]);
    peer.wait_for(&["rosbags writes the same bytes: True"]);
    let topics = peer.wait_for(&["topics:"]);
    for topic in ["/joint_states=sensor_msgs/msg/JointState", "/knee/torque=std_msgs/msg/Float64"] {
        assert!(topics.split(' ').any(|one| one == topic), "{topic}: {topics}");
    }
    let services = peer.wait_for(&["services:"]);
    for service in ["/exo/stop", "/knee_drive/set_parameters", "/knee_drive/describe_parameters"] {
        assert!(services.split(' ').any(|one| one == service), "{service}: {services}");
    }
    peer.wait_for(&["set: assistance 0.5 True"]);
    peer.wait_for(&["set: assistance 1.5 False", "outside 0.0 to 1.0"]);
    peer.wait_for(&["set: damped 1.0 False", "read-only for ROS 2"]);
    peer.wait_for(&["ready"]);
    until("a torque of 3.5 from Python", || {
        peer.send_line("torque 7");
        peer.wait_for(&["published"]);
        thread::sleep(Duration::from_millis(20));
        stage.log.all().contains(&Done::Torque(35)).then_some(())
    });
    stage.bridge.wait_for(&["refused", "of /exo/knee/torque", "no rule"]);
    peer.send_line("end");
    peer.wait_for(&["stop: True stopped: 1 nodes have confirmed"]);
    peer.wait_for(&["done"]);
    assert_eq!(peer.wait_for_exit(), Some(0));
}
