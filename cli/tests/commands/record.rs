//! `sinew record`: from a node to a file that `sinew bag check` finds complete.

use std::{
    path::{Path, PathBuf},
    process::Command,
    sync::atomic::{AtomicBool, Ordering},
    time::Duration,
};

use rustix::process::Signal;
use sinew::{
    AppAddress, Endpoint, NodeApi, Outcome, Payload, Registration, Tid, client::DirectLinks, payload,
};
use sinew_bag::read::{Item, Reader};
use sinew_recorder::{Recording, RecordingOptions};
use sinew_testkit::{NodeProcess, TestDirectory, program, until};

use crate::scenario::{Answer, Scenario};

payload!("scenario.count", Bulk => pub(crate) struct Count { pub(crate) number: u64 });

/// Ends the traffic when it is dropped.
struct End<'a>(&'a AtomicBool);

impl Drop for End<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

/// Calls `record` while the application `sensor` sends counts to the application `knee`, each after the outcome of the
/// one before.
fn with_traffic<R>(scenario: &Scenario, knee: &mut NodeProcess, record: impl FnOnce() -> R) -> R {
    let line = knee.wait_for(&["started"]);
    let tid: Tid = line.split_once(' ').expect("it says its TID").1.parse().expect("a TID");
    let api = NodeApi::connect(scenario.socket("knee")).expect("the knee's socket");
    let mut sensor =
        api.register_transport_address(Registration::new().name("sensor")).expect("it is registered");
    let is_over = AtomicBool::new(false);
    let ends = End(&is_over);
    std::thread::scope(|scope| {
        scope.spawn(|| {
            for number in 0_u64.. {
                let sent = sensor.message(tid, &Count { number }).confirmed(Duration::from_secs(10));
                // The node may have been killed.
                if is_over.load(Ordering::Relaxed) || sent.is_err() {
                    break;
                }
            }
        });
        // Also where it panics: the scope waits for the sender.
        let _ends = ends;
        record()
    })
}

/// Starts `sinew record`. Returns when it records.
fn start(scenario: &Scenario, file: &Path) -> NodeProcess {
    let mut command = Command::new(env!("CARGO_BIN_EXE_sinew"));
    command.arg("--socket").arg(scenario.socket("knee")).arg("record").arg(file).arg("--json");
    let recorder = NodeProcess::start("sinew record", command);
    until("the file is there", || file.exists().then_some(()));
    recorder
}

fn bag(order: &str, file: &Path) -> Answer {
    Answer::of(Command::new(env!("CARGO_BIN_EXE_sinew")).args(["bag", order]).arg(file))
}

fn assert_complete(file: &Path) {
    let answer = bag("check", file);
    assert_eq!(answer.code, Some(0), "{}{}", answer.out, answer.err);
    assert!(answer.out.contains("complete"), "{}", answer.out);
}

#[test]
fn recorded_traffic_is_complete() {
    let scenario = Scenario::new();
    let mut knee = scenario.start("knee", 2, &[]);
    let file = scenario.directory.join("walk.mcap");
    let name = file.to_str().expect("a path of text").to_owned();
    let answer = with_traffic(&scenario, &mut knee, || {
        scenario.sinew("knee", &["record", &name, "--for", "1s", "--json"])
    });
    assert_eq!(answer.code, Some(0), "{}{}", answer.out, answer.err);
    let json = answer.json();
    let count = |key: &str| json[key].as_u64().expect("a number");
    assert!(count("written") > 0 && count("seen") == count("written") + count("dropped"), "{json}");
    assert_eq!((&json["end"], &json["node"]), (&"time".into(), &"knee".into()), "{json}");
    assert_complete(&file);
    let info = bag("info", &file);
    assert_eq!(info.code, Some(0), "{}{}", info.out, info.err);
    for words in ["node knee at 127.0.0.2", "/sensor/scenario.count", "finished"] {
        assert!(info.out.contains(words), "{words}: {}", info.out);
    }
    assert!(!info.out.contains("sinew.inspect"), "its own questions are left out: {}", info.out);
    // And: the file is not replaced
    let answer = scenario.sinew("knee", &["record", &name, "--for", "1s"]);
    assert!(answer.code == Some(1) && answer.err.contains("choose another name"), "{}", answer.err);
    let answer = scenario.sinew("knee", &["record", &name, "--for", "1s", "--force"]);
    assert_eq!(answer.code, Some(0), "{}{}", answer.out, answer.err);
}

#[test]
fn request_to_stop_finishes_the_file() {
    let scenario = Scenario::new();
    let mut knee = scenario.start("knee", 2, &[]);
    let file = scenario.directory.join("walk.mcap");
    let code = with_traffic(&scenario, &mut knee, || {
        let mut recorder = start(&scenario, &file);
        recorder.signal(Signal::TERM);
        recorder.wait_for_exit()
    });
    assert_eq!(code, Some(0));
    assert_complete(&file);
}

#[test]
fn killed_node_leaves_a_finished_file() {
    let scenario = Scenario::new();
    // In the folder of the test, which is removed: the ring of a killed node stays.
    let folder = scenario.directory.join("");
    let record = format!("[record]\nfolder = \"{}\"\nkeep_bytes = 16_777_216\n[ndl]", folder.display());
    let mut knee = scenario.start_changed("knee", 2, &[("[ndl]", &record)], &[]);
    let file = scenario.directory.join("walk.mcap");
    let mut recorder = with_traffic(&scenario, &mut knee, || start(&scenario, &file));
    assert!(knee.kill());
    assert_eq!(recorder.wait_for_exit(), Some(0));
    assert!(recorder.output().iter().any(|line| line.contains("node_died")), "{:?}", recorder.output());
    assert_complete(&file);
}

/// Registers an application that sends one count to an address without an application. The node rejects it.
/// The application has its name for as long as the endpoint lives: a recorder asks for it after the message.
fn send_one(scenario: &Scenario) -> Endpoint {
    let api = NodeApi::connect(scenario.socket("knee")).expect("the knee's socket");
    let registration = Registration::new().name("sensor").handles::<Count>();
    let mut sensor = api.register_transport_address(registration).expect("it is registered");
    let nobody = Tid::new(sensor.tid().node, AppAddress::new(0x1fff));
    let outcome = sensor.message(nobody, &Count { number: 1 }).confirmed(Duration::from_secs(10));
    assert_ne!(outcome.expect("an outcome"), Outcome::Delivered);
    sensor
}

/// Asserts that the file is complete and finished, and has the message of [`send_one`].
fn assert_has_the_count(file: &Path) {
    assert_complete(file);
    let info = bag("info", file);
    let is_finished = info.out.contains("finished") && !info.out.contains("unfinished");
    assert!(info.out.contains("/sensor/scenario.count") && is_finished, "{}", info.out);
}

/// Returns the recordings in the folder of a test.
fn recordings(folder: &TestDirectory) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder.join("")).expect("it is there");
    entries
        .map(|entry| entry.expect("it can be read").path())
        .filter(|path| path.extension().is_some_and(|ending| ending == "mcap"))
        .collect()
}

#[test]
fn node_finishes_the_file_of_its_configuration() {
    let scenario = Scenario::new();
    let file = scenario.directory.join("{node}.mcap");
    let section = format!("[record]\nfile = \"{}\"\nkeep_bytes = 1048576\n[ndl]", file.display());
    let path = scenario.configure("knee", 2, &[("[ndl]", &section)]);
    let mut command = Command::new(program("sinew-node"));
    command.arg(&path);
    let mut knee = NodeProcess::start("sinew-node", command);
    knee.wait_for(&["up"]);
    let sensor = send_one(&scenario);
    // The recorder asks the node for the name. The file has its chunk a second later.
    until("the message is in the file with its name", || {
        let files = recordings(&scenario.directory);
        let info = bag("info", files.first()?);
        info.out.contains("/sensor/scenario.count").then_some(())
    });
    drop(sensor);
    knee.signal(Signal::TERM);
    assert_eq!(knee.wait_for_exit(), Some(0));
    let files = recordings(&scenario.directory);
    assert!(files.len() == 1 && files[0].display().to_string().contains("/knee-20"), "{files:?}");
    assert_has_the_count(&files[0]);
}

#[test]
fn node_without_recording_folder_serves_and_fails_at_end() {
    let scenario = Scenario::new();
    let file = scenario.directory.join("absent/{node}.mcap");
    let section = format!("[record]\nfile = \"{}\"\nkeep_bytes = 1048576\n[ndl]", file.display());
    let path = scenario.configure("knee", 2, &[("[ndl]", &section)]);
    let mut command = Command::new(program("sinew-node"));
    command.arg(&path);
    let mut knee = NodeProcess::start("sinew-node", command);
    knee.wait_for(&["up"]);
    drop(send_one(&scenario));
    knee.signal(Signal::TERM);
    assert_eq!(knee.wait_for_exit(), Some(1));
}

#[test]
fn program_records_its_node() {
    let scenario = Scenario::new();
    let _knee = scenario.start("knee", 2, &[]);
    let file = scenario.directory.join("walk.mcap");
    let api = NodeApi::connect(scenario.socket("knee")).expect("the knee's socket");
    let options = RecordingOptions { path: Some(file.clone()), ..RecordingOptions::default() };
    let recording = Recording::begin(&api, options).expect("it begins");
    let sensor = send_one(&scenario);
    let summary = recording.finish_within(Duration::from_secs(60)).expect("it ends");
    drop(sensor);
    assert!(summary.totals.written > 0 && summary.totals.dropped == 0, "{summary:?}");
    assert_has_the_count(&file);
}

#[test]
fn messages_on_a_direct_link_are_recorded() {
    // Given: two clients of a node, and a link that bypasses it
    let scenario = Scenario::new();
    let _knee = scenario.start("knee", 2, &[]);
    let file = scenario.directory.join("walk.mcap");
    let api = NodeApi::connect(scenario.socket("knee")).expect("the knee's socket");
    let register = |name: &str| {
        let registration = Registration::new().name(name).direct(DirectLinks::Always);
        api.register_transport_address(registration).expect("it is registered")
    };
    let (mut sensor, mut drive) = (register("sensor"), register("drive"));
    let mut exchange = || {
        sensor.send(drive.tid(), &Count { number: 1 }).expect("it is sent");
        let received = drive.receive(Duration::from_secs(10)).expect("the node lives");
        assert_eq!(received.expect("the count").kind(), Count::KIND);
    };
    until("there is a direct link", || {
        exchange();
        // Both are asked for an echo, and neither receives.
        let words = ["why", "sensor", "drive", "--json", "--deadline-ms", "200"];
        let answer = scenario.sinew("knee", &words);
        answer.out.contains("has a direct link to").then_some(())
    });
    // When: the node is recorded
    let options = RecordingOptions { path: Some(file.clone()), ..RecordingOptions::default() };
    let recording = Recording::begin(&api, options).expect("it begins");
    // Then: the file has messages of the link
    until("a message of the link is in the file", || {
        exchange();
        bag("info", &file).out.contains("/sensor/scenario.count").then_some(())
    });
    let summary = recording.finish_within(Duration::from_secs(60)).expect("it ends");
    assert!(summary.totals.written > 0, "{summary:?}");
    assert_complete(&file);
}

payload!("commands.client_only" => struct ClientOnly { milliamperes: u32 });

#[test]
fn type_known_only_to_client_is_printed_and_viewed() {
    // Given: a node in another process, which knows the type by the client's declaration alone
    let scenario = Scenario::new();
    let _knee = scenario.start("knee", 2, &[]);
    let file = scenario.directory.join("walk.mcap");
    let api = NodeApi::connect(scenario.socket("knee")).expect("the knee's socket");
    let registration = Registration::new().name("sensor").sends::<ClientOnly>();
    let mut sensor = api.register_transport_address(registration).expect("it is registered");
    // When
    let json =
        scenario.until("the node knows the structure", "knee", &["schema", ClientOnly::NAME], |json| {
            !json["structures"][0]["schema"].is_null()
        });
    // Then
    assert_eq!(json["structures"][0]["sent_by"][0]["name"], "sensor", "{json}");
    let text = scenario.sinew("knee", &["schema", ClientOnly::NAME]);
    assert!(text.out.contains("milliamperes: u32"), "{}{}", text.out, text.err);
    // When: a message of it is recorded
    let options = RecordingOptions { path: Some(file.clone()), ..RecordingOptions::default() };
    let recording = Recording::begin(&api, options).expect("it begins");
    let nobody = Tid::new(sensor.tid().node, AppAddress::new(0x1fff));
    let outcome = sensor.message(nobody, &ClientOnly { milliamperes: 7 }).confirmed(Duration::from_secs(10));
    assert_ne!(outcome.expect("an outcome"), Outcome::Delivered);
    recording.finish_within(Duration::from_secs(60)).expect("it ends");
    // Then: its view is protobuf
    let mut reader = Reader::open(&file).expect("the file");
    let mut views = Vec::new();
    while let Some(item) = reader.next_item().expect("it can be read") {
        if let Item::Message(message) = item
            && message.channel.topic.starts_with("/sensor/commands.client_only/")
            && message.channel.topic.ends_with("/view")
        {
            let schema = message.channel.schema.as_ref().map(|schema| schema.encoding.clone());
            views.push((message.channel.encoding.clone(), schema));
        }
    }
    assert_eq!(views, [("protobuf".to_owned(), Some("protobuf".to_owned()))]);
}

#[test]
fn wrong_words_are_refused_with_an_example() {
    let scenario = Scenario::new();
    let _knee = scenario.start("knee", 2, &[]);
    for (words, part) in [
        (["--for", "soon"], "30s"),
        (["--max-size", "1"], "500M"),
        (["--split", "5 bytes"], "30s"),
        (["--group", "leg*"], "without `*`"),
    ] {
        let answer = scenario.sinew("knee", &[&["record", "never.mcap"][..], &words].concat());
        assert!(answer.code == Some(2) && answer.err.contains(part), "{words:?}: {}", answer.err);
    }
}
