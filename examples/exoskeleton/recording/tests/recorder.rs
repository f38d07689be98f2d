//! A node is recorded through its client socket, from its start to its end.

use std::path::PathBuf;
use std::time::Instant;

use exoskeleton_model::message::JointSample;
use exoskeleton_recording::recorder::{KnownNames, WalkRecorder};
use sinew::prelude::*;
use sinew_bag::read::Ordered;

const DEADLINE: Duration = Duration::from_secs(60);
const LOOK_PERIOD: Duration = Duration::from_millis(20);
/// A group without members: only the recorder sees its messages.
const GROUP: &str = "test.samples";

/// A folder of one test, which is removed at its end.
struct TestFolder(PathBuf);

impl TestFolder {
    fn new(name: &str) -> Self {
        let folder = std::env::temp_dir().join(format!("exoskeleton-{name}-{}", std::process::id()));
        std::fs::create_dir_all(&folder).expect("a folder of this test");
        Self(folder)
    }
}

impl Drop for TestFolder {
    fn drop(&mut self) {
        // The folder of temporary files is cleared by the system, too.
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

/// Sends a sample each millisecond.
#[derive(Default)]
struct Sensor {
    seq: u32,
}

impl Actor for Sensor {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        context.every(Duration::from_millis(1), |sensor, _, context| {
            sensor.seq += 1;
            let sample = JointSample {
                seq: sensor.seq,
                t_ns: context.now().as_nanos(),
                t_error_ns: Some(0),
                angle_rad: 0.2,
                velocity_rad_s: 1.5,
                torque_nm: 0.0,
                temperature_c: 30,
                flags: 0,
            };
            let _ = context.send(Tid::group(GROUP), &sample);
        });
    }
}

#[test]
fn node_is_recorded_from_its_start_to_its_end() {
    let folder = TestFolder::new("recorder");
    let socket = folder.0.join("hip.sock");
    let names = KnownNames {
        apps: vec!["hip.sensor".to_owned()],
        groups: vec![GROUP],
        types: vec![(JointSample::KIND, JointSample::NAME)],
    };
    // given: a recorder that waits for its node
    let recorder = WalkRecorder::start(&[("hip".to_owned(), socket.clone())], names, &folder.0).unwrap();

    // when: the node runs until a chunk is in the file, and ends
    let node = Node::builder("hip")
        .address([127, 0, 0, 1])
        .configure(|config| {
            (config.ndl.multicast, config.ndl.mdns_port) = (None, None);
            config.lncl.socket = Some(socket);
            config.record.keep_bytes = 1 << 20;
        })
        .app(AppSpec::new("hip.sensor", Sensor::default))
        .start()
        .unwrap();
    let (file, deadline) = (folder.0.join("hip-1.mcap"), Instant::now() + DEADLINE);
    while std::fs::metadata(&file).map_or(0, |file| file.len()) < 4_096 {
        assert!(Instant::now() < deadline, "nothing is recorded within {DEADLINE:?}");
        std::thread::sleep(LOOK_PERIOD);
    }
    recorder.close();
    node.stop();
    let recorded = recorder.finish();

    // then: its messages are in both files, by name
    assert!(recorded.faults.is_empty() && recorded.written > 0, "{recorded}");
    assert_eq!((recorded.files, recorded.bound_ns), (vec![file], 0));
    let merged = recorded.merged.expect("the files are merged");
    assert_eq!(merged, folder.0.join("walk.mcap"));
    let file = Ordered::open(merged).unwrap();
    let topics: Vec<&str> = file.channels().values().map(|channel| channel.topic.as_str()).collect();
    assert!(topics.contains(&"/hip/hip.sensor/exo.joint_sample/view"), "{topics:?}");
}
