//! A node is recorded through its client socket, from its start to its end, and around a fault.

use std::fs::DirBuilder;
use std::os::unix::fs::DirBuilderExt as _;
use std::path::PathBuf;
use std::sync::mpsc::{SyncSender, sync_channel};
use std::time::Instant;

use exoskeleton_model::message::JointSample;
use exoskeleton_recording::flight::{Frozen, gather, remove_own_journal};
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
    /// The sample at which it has the messages frozen; 0: none.
    fault_at: u32,
    /// Notified then.
    noticed: Option<SyncSender<()>>,
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
            if sensor.seq == sensor.fault_at {
                context.freeze_recording("the foot slips");
                let noticed = sensor.noticed.as_ref().expect("the test waits for it");
                noticed.try_send(()).expect("the test reads one");
            }
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

#[test]
fn span_around_a_fault_becomes_a_file() {
    let folder = TestFolder::new("flight");
    let [journals, frozen] = ["journals", "frozen"].map(|name| folder.0.join(name));
    let journal = journals.join("knee");
    for folder in [&journal, &frozen] {
        DirBuilder::new().recursive(true).mode(0o700).create(folder).unwrap();
    }
    // given: a node with a flight recorder, and a fault at its 50th sample
    let (memory, disk) = (journal.clone(), frozen.clone());
    let (noticed, fault) = sync_channel(1);
    let sensor = move || Sensor { fault_at: 50, noticed: Some(noticed.clone()), ..Sensor::default() };
    let node = Node::builder("knee")
        .address([127, 0, 0, 2])
        .configure(|config| {
            (config.ndl.multicast, config.ndl.mdns_port) = (None, None);
            (config.record.folder, config.record.frozen_folder) = (Some(memory), Some(disk));
            config.record.keep_bytes = 1 << 20;
        })
        .app(AppSpec::new("knee.sensor", sensor))
        .start()
        .unwrap();
    fault.recv_timeout(DEADLINE).expect("the sensor runs");
    node.stop();

    // when
    remove_own_journal(&journal).expect("its folder has nothing else");
    let found = gather(&frozen, &journals);

    // then
    assert!(found.faults.is_empty() && found.spans.len() == 1, "{found}");
    let span = &found.spans[0];
    assert!(span.cause.contains("the foot slips"), "{span:?}");
    let [file] = span.files.as_slice() else { panic!("one node has frozen it: {span:?}") };
    assert!(file.node == "knee" && !file.has_died && file.written >= 50, "{file:?}");
    assert!(file.begin_ns <= file.first_ns && file.last_ns <= file.end_ns, "{file:?}");
    let report = sinew_bag::check(&[&file.path]).unwrap();
    assert!(report.is_fine(), "{:?}", report.findings);
    assert!(found.to_string().starts_with("frozen: 1 file, span "), "{found}");
    // And: the file is in place of the copy
    assert_eq!(gather(&frozen, &journals), Frozen::default());
    assert!(file.path.exists());
}
