//! The recorder is killed, its disk is full, its folder cannot be written, its disk is slow.

use std::{path::Path, time::Duration};

use sinew_testkit::until;
use sinew_tests::recording::{Accounts, Load, Recorded, Recorder, SlowWrites, messages_in};

use super::{SmallDisk, check};

#[test]
fn killed_recorder_leaves_a_file_without_findings() {
    // Given: a recording with some messages on the disk
    let mut node = Recorded::start(2, None);
    let file = node.directory.join("walk.mcap");
    let mut recorder = Recorder::start(node.recorder(&file, &[]), &file);
    let load = Load { rate: 1_000, length: 64, count: 500 };
    let sent = node.send(load);
    let written = || Accounts::of(&[&file]).source(1, false).written;
    until("messages are on the disk, and counted", || (written() > 0).then_some(()));
    // When: it is killed in the middle
    node.send(load);
    assert!(recorder.process.kill());
    // Then: the node is unaffected
    assert_eq!(node.send(load).total(), 1_000);
    // And: the file is checked up to its last chunk
    let (code, json) = check(&file);
    assert_eq!((code, &json["findings"]), (Some(0), &serde_json::json!([])), "{json}");
    assert_eq!(json["files"][0]["is_finished"], false, "{json}");
    let accounts = Accounts::of(&[&file]);
    for number in 0..2 {
        let account = accounts.source(number, false);
        assert!(account.written > 0 && account.seen == account.written + account.dropped, "{account:?}");
    }
    assert!(messages_in(&file) <= 2 * sent.total());
    node.stop();
}

#[test]
fn full_disk_counts_what_it_drops() {
    let Some(disk) = SmallDisk::mount("size=1m") else { return };
    let mut node = Recorded::start(2, None);
    let file = disk.folder.join("walk.mcap");
    // With a maximum size the chunks are an eighth of it, so that some fit.
    let recorder = node.recorder(&file, &["--compression", "none", "--max-size", "2M"]);
    let mut recorder = Recorder::start(recorder, &file);
    // When: more is sent than there is room for
    let sent = node.send(Load { rate: 500, length: 2_000, count: 500 });
    let (code, summary) = recorder.finish();
    // Then: the command names the disk
    let faults = summary["faults"].to_string();
    for words in ["walk.mcap", "No space left", "free space on this disk"] {
        assert!(faults.contains(words), "{words}: {summary}");
    }
    assert_eq!(code, Some(1), "{summary}");
    // And: each message is written or dropped
    let count = |key: &str| summary[key].as_u64().expect("a number");
    let [seen, written, dropped] = ["seen", "written", "dropped"].map(count);
    assert!(written > 0 && dropped > 0 && seen == written + dropped, "{summary}");
    assert!(seen >= sent.total(), "{} were sent: {summary}", sent.total());
    // And: the file is whole up to its last chunk
    assert_eq!(Accounts::of(&[&file]).findings(), Vec::<&sinew_bag::check::Finding>::new());
    assert_eq!(messages_in(&file), written);
    node.stop();
}

/// Records into `folder`, in which nothing can be made.
fn assert_refused(folder: &Path, cause: &str, remedy: &str) {
    let node = Recorded::start(1, None);
    let file = folder.join("walk.mcap");
    let output = node.recorder(&file, &["--for", "1s"]).output().expect("it starts");
    let text = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{text}");
    for words in [&*file.display().to_string(), cause, remedy] {
        assert!(text.contains(words), "{words}: {text}");
    }
    // Programs get the same.
    let json: serde_json::Value = serde_json::from_slice(&output.stdout).expect("it is JSON");
    assert!(json["fault"].as_str().is_some_and(|fault| fault.contains(remedy)), "{json}");
    node.stop();
}

#[test]
fn read_only_folder_is_named_with_a_remedy() {
    let Some(disk) = SmallDisk::mount("size=1m,ro") else { return };
    assert_refused(&disk.folder, "Read-only file system", "record to a folder in which this user may write");
}

#[test]
fn absent_folder_is_named_with_a_remedy() {
    let directory = sinew_testkit::TestDirectory::new();
    assert_refused(&directory.join("absent"), "No such file or directory", "make the folder first");
}

#[test]
fn slow_disk_holds_no_sender() {
    // Given: a disk on which each write takes 200 ms longer, and a ring that is full in less
    let mut node = Recorded::start(2, Some(256 << 10));
    let file = node.directory.join("walk.mcap");
    let slow = SlowWrites::new(&node.directory);
    let mut command = node.recorder(&file, &["--compression", "none"]);
    slow.apply(&mut command, Duration::from_millis(200));
    let mut recorder = Recorder::start(command, &file);
    // When
    let sent = node.send(Load { rate: 500, length: 4_000, count: 1_000 });
    let (code, summary) = recorder.finish();
    // Then: messages are dropped, and each is counted
    assert!(slow.count() > 2, "the library was not loaded: {}", slow.count());
    assert_eq!(code, Some(0), "{summary}");
    let accounts = Accounts::of(&[&file]);
    assert!(accounts.dropped() > 0, "{summary}");
    assert_eq!(accounts.differences(&sent.channels), Vec::<String>::new());
    node.stop();
}

#[test]
fn stopped_recorder_holds_no_sender() {
    // Given: a recorder that stands still
    let mut node = Recorded::start(2, Some(256 << 10));
    let file = node.directory.join("walk.mcap");
    let mut recorder = Recorder::start(node.recorder(&file, &[]), &file);
    recorder.process.pause();
    // When: more is sent than the ring has room for
    let sent = node.send(Load { rate: 1_000, length: 4_000, count: 500 });
    assert_eq!(sent.total(), 1_000);
    recorder.process.signal(rustix::process::Signal::CONT);
    // Then
    let (code, summary) = recorder.finish();
    assert_eq!(code, Some(0), "{summary}");
    let accounts = Accounts::of(&[&file]);
    assert!(accounts.dropped() > 0, "{summary}");
    assert_eq!(accounts.differences(&sent.channels), Vec::<String>::new());
    node.stop();
}
