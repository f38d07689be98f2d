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
/// The sample at which a sensor has the messages frozen.
const FAULT_AT: u32 = 50;
/// Time after the fault that is frozen, too.
const AFTER: Duration = Duration::from_secs(1);
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
    /// The end of the span around its fault, or later.
    span_end: Option<Time>,
    /// Notified after a sample behind that span; `None`: it has no fault.
    noticed: Option<SyncSender<()>>,
}

impl Actor for Sensor {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        context.every(Duration::from_millis(1), |sensor, _, context| {
            sensor.seq += 1;
            let is_behind = sensor.span_end.is_some_and(|end| Time::now() > end);
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
            let Some(noticed) = &sensor.noticed else { return };
            if sensor.seq == FAULT_AT {
                context.freeze_recording("the foot slips");
                sensor.span_end = Some(Time::now() + AFTER);
            }
            if is_behind {
                noticed.try_send(()).expect("there is room for one");
                sensor.span_end = None;
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
    // given: a node with a flight recorder, and a fault at one of its samples
    let (memory, disk) = (journal.clone(), frozen.clone());
    let (noticed, samples) = sync_channel(1);
    let sensor = move || Sensor { noticed: Some(noticed.clone()), ..Sensor::default() };
    let node = Node::builder("knee")
        .address([127, 0, 0, 2])
        .configure(|config| {
            (config.ndl.multicast, config.ndl.mdns_port) = (None, None);
            (config.record.folder, config.record.frozen_folder) = (Some(memory), Some(disk));
            config.record.keep_bytes = 4 << 20;
            config.record.after = AFTER;
        })
        .app(AppSpec::new("knee.sensor", sensor))
        .start()
        .unwrap();
    samples.recv_timeout(DEADLINE).expect("the sensor runs");
    // And: the journal of a node that was killed later than the span, which no living node has frozen
    let killed = journals.join("killed");
    std::fs::create_dir(&killed).unwrap();
    let is_journal = |path: &PathBuf| path.extension().is_some_and(|ending| ending == "journal");
    let own =
        std::fs::read_dir(&journal).unwrap().map(|entry| entry.unwrap().path()).find(is_journal).unwrap();
    std::fs::copy(&own, killed.join("sinew-killed.journal")).unwrap();
    node.stop();

    // when
    remove_own_journal(&journal).expect("its folder has nothing else");
    let found = gather(&frozen, &journals);

    // then
    assert!(found.faults.is_empty() && found.spans.len() == 2, "{found:?}");
    let of_cause = |cause: &str| found.spans.iter().find(|span| span.cause.contains(cause)).unwrap();
    let span = of_cause("the foot slips");
    let [file, of_killed] = span.files.as_slice() else { panic!("two journals have it: {span:?}") };
    assert!(file.node == "knee" && !file.has_died && file.written >= u64::from(FAULT_AT), "{file:?}");
    assert!(file.begin_ns <= file.first_ns && file.last_ns <= file.end_ns, "{file:?}");
    let report = sinew_bag::check(&[&file.path]).unwrap();
    assert!(report.is_fine(), "{:?}", report.findings);
    assert!(of_killed.has_died && of_killed.last_ns <= span.end_ns, "{of_killed:?}");
    // And: the last messages of the killed node are in a file of its whole journal
    let [whole] = of_cause("has died").files.as_slice() else { panic!("{found:?}") };
    assert!(whole.last_ns > span.end_ns && whole.written > of_killed.written, "{whole:?}");
    assert!(found.to_string().contains("frozen: 1 file, span "), "{found}");
    // And: the file is in place of the copy
    assert_eq!(gather(&frozen, &journals), Frozen::default());
    assert!(file.path.exists());
}
