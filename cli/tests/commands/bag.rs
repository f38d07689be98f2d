//! `sinew bag` as a process: recordings that are whole, cut, of two nodes, and no recordings.

use std::{fs, path::PathBuf, process::Command};

use sinew_bag::{BagWriter, ChannelInfo, Class, ClockReading, Direction, Options, Origin, Party, Record};
use sinew_testkit::TestDirectory;

use crate::scenario::Answer;

const SECOND: u64 = 1_000_000_000;

/// Runs `sinew bag` in `directory`.
fn bag(directory: &TestDirectory, words: &[&str]) -> Answer {
    let mut command = Command::new(env!("CARGO_BIN_EXE_sinew"));
    Answer::of(command.arg("bag").args(words).current_dir(directory.join(".")))
}

/// Writes the recording of a node: 30 angles from the hip to the knee, of which `lost` is missing.
fn recorded(directory: &TestDirectory, node: &str, direction: Direction, lost: Option<u64>) -> PathBuf {
    let path = directory.join(&format!("{node}.mcap"));
    let address = |node: &str| if node == "hip" { "127.0.0.1" } else { "127.0.0.2" };
    let origin =
        Origin { node: node.into(), address: address(node).into(), incarnation: 1, ..Origin::default() };
    let mut bag = BagWriter::create(&path, Options::default(), origin).expect("the test's own directory");
    let party = |tid, node: &str| Party {
        tid,
        text: format!("{}/{tid}", address(node)),
        name: Some(format!("{node}.sensor")),
        node: Some(address(node).into()),
    };
    let channel = bag.channel(&ChannelInfo {
        source: &party(1, "hip"),
        destination: &party(2, "knee"),
        type_name: "demo.angle",
        kind: 7,
        class: Class::Control,
        direction,
        is_protected: false,
        schema: None,
        refused: None,
        seen_before: 0,
    });
    let channel = channel.expect("it is the first one");
    let sequences = (1..=30).filter(|sequence| Some(*sequence) != lost);
    for (number, sequence) in (1..).zip(sequences) {
        let at_ns = sequence * SECOND / 10;
        // The payload is {"degrees": 5}.
        let payload = b"\x81\xa7degrees\x05";
        let record =
            Record { number, sequence, sent_ns: at_ns, handed_over_ns: at_ns, payload, ..Record::default() };
        bag.message(channel, &record).expect("there is room");
    }
    let peer = if node == "hip" { "knee" } else { "hip" };
    let reading = ClockReading {
        peer: address(peer).into(),
        incarnation: 1,
        bound_ns: 1_500,
        ..ClockReading::default()
    };
    bag.clock(SECOND, &reading).expect("there is room");
    bag.finish(4 * SECOND).expect("there is room");
    path
}

#[test]
fn whole_recordings_are_complete() {
    let directory = TestDirectory::new();
    recorded(&directory, "hip", Direction::Sent, None);
    recorded(&directory, "knee", Direction::Received, None);
    let answer = bag(&directory, &["check", "hip.mcap", "knee.mcap"]);
    assert_eq!(answer.code, Some(0), "{}{}", answer.out, answer.err);
    assert!(answer.out.contains("complete"), "{}", answer.out);
    // Of one node alone the other end cannot be compared.
    let answer = bag(&directory, &["check", "hip.mcap", "--json"]);
    let json = answer.json();
    assert_eq!((answer.code, &json["findings"][0]["topic"]), (Some(1), &"127.0.0.2".into()), "{json}");
}

#[test]
fn lost_message_is_named() {
    let directory = TestDirectory::new();
    recorded(&directory, "hip", Direction::Sent, None);
    recorded(&directory, "knee", Direction::Received, Some(17));
    let answer = bag(&directory, &["check", "hip.mcap", "knee.mcap"]);
    assert_eq!(answer.code, Some(1), "{}{}", answer.out, answer.err);
    for words in ["/hip.sensor/demo.angle", "their sequence numbers: 17", "findings: 1"] {
        assert!(answer.out.contains(words), "{words}: {}", answer.out);
    }
}

#[test]
fn recording_is_summed_up_merged_and_exported() {
    let directory = TestDirectory::new();
    recorded(&directory, "hip", Direction::Sent, None);
    recorded(&directory, "knee", Direction::Received, None);
    let answer = bag(&directory, &["info", "hip.mcap"]);
    assert_eq!(answer.code, Some(0), "{}{}", answer.out, answer.err);
    for words in ["node hip at 127.0.0.1", "/hip.sensor/demo.angle", "10.0", "finished"] {
        assert!(answer.out.contains(words), "{words}: {}", answer.out);
    }
    let answer = bag(&directory, &["merge", "hip.mcap", "knee.mcap", "--out", "leg.mcap", "--json"]);
    assert_eq!(answer.code, Some(0), "{}{}", answer.out, answer.err);
    let json = answer.json();
    let knee = json["nodes"].as_array().and_then(|nodes| nodes.iter().find(|node| node["node"] == "knee"));
    assert_eq!(knee.expect("it is there")["bound_ns"], 1_500, "{json}");
    let answer = bag(&directory, &["export", "leg.mcap", "--out", "leg", "--json"]);
    assert_eq!(answer.code, Some(0), "{}{}", answer.out, answer.err);
    let text =
        fs::read_to_string(directory.join("leg/knee__hip.sensor__demo.angle.csv")).expect("it was exported");
    assert!(text.lines().count() == 31 && text.contains("degrees"), "{text}");
    let answer = bag(&directory, &["export", "leg.mcap", "--out", "columns", "--format", "parquet"]);
    assert_eq!(answer.code, Some(0), "{}{}", answer.out, answer.err);
}

#[test]
fn export_names_the_loss_of_a_damaged_file() {
    let directory = TestDirectory::new();
    let path = recorded(&directory, "hip", Direction::Sent, None);
    let whole = fs::read(&path).expect("it was written");
    // Given: a file without its end
    fs::write(&path, &whole[..whole.len() - 20]).expect("the test's own directory");
    let answer = bag(&directory, &["export", "hip.mcap", "--out", "cut"]);
    assert_eq!(answer.code, Some(0), "as of a killed recorder: {}{}", answer.out, answer.err);
    assert!(answer.out.contains("hip.mcap: unfinished: the file ends at byte"), "{}", answer.out);
    let answer = bag(&directory, &["merge", "hip.mcap", "--out", "all.mcap"]);
    assert!(answer.out.contains("unfinished: the file ends"), "{}{}", answer.out, answer.err);
    // And: a file with a damaged chunk, the third one: the first ones have the descriptions of the channels
    let (mut at, mut chunks) = (8, 0);
    loop {
        chunks += u32::from(whole[at] == 0x06);
        if chunks == 3 {
            break;
        }
        let length = u64::from_le_bytes(whole[at + 1..at + 9].try_into().expect("8 bytes"));
        at += 9 + usize::try_from(length).expect("it is in the file");
    }
    let middle = at + 60;
    let mut changed = whole.clone();
    changed[middle] ^= 0x40;
    fs::write(&path, changed).expect("the test's own directory");
    let answer = bag(&directory, &["export", "hip.mcap", "--out", "changed"]);
    assert_eq!(answer.code, Some(1), "{}{}", answer.out, answer.err);
    assert!(answer.out.contains("a chunk is damaged"), "{}", answer.out);
}

#[test]
fn file_that_is_no_recording_is_refused() {
    let directory = TestDirectory::new();
    fs::write(directory.join("notes.txt"), "no recording").expect("the test's own directory");
    for (words, part) in [(["check", "notes.txt"], "no MCAP file"), (["info", "gone.mcap"], "gone.mcap")] {
        let answer = bag(&directory, &words);
        assert!(
            answer.code == Some(1) && answer.err.contains(part),
            "{words:?}: {}{}",
            answer.out,
            answer.err
        );
    }
    assert_eq!(bag(&directory, &["merge", "notes.txt"]).code, Some(2), "without --out");
}
