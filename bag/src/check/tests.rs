use std::{
    fs,
    path::{Path, PathBuf},
};

use super::*;
use crate::{
    BagWriter, Class, Direction, Options, Origin,
    read::{Item, Reader},
    testing::{TestFolder, channel, chunks, record, typed_channel},
};

const SECOND: u64 = 1_000_000_000;
const RAW: &str = "/knee.sensor/exo.angle";
const VIEW: &str = "/knee.sensor/exo.angle/view";

fn origin(address: &str) -> Origin {
    Origin { node: format!("node {address}"), address: address.into(), incarnation: 1, ..Origin::default() }
}

/// A recording of four seconds with ten messages each; those of `numbers` are written.
fn recording(path: &Path, address: &str, class: Class, direction: Direction, is_there: impl Fn(u64) -> bool) {
    let mut bag = BagWriter::create(path, Options::default(), origin(address)).unwrap();
    let channel = channel(&mut bag, class, direction);
    let mut number = 0;
    for sequence in 1..=40 {
        if is_there(sequence) {
            number += 1;
            let message = crate::Record { sequence, ..record(number, sequence * SECOND / 10) };
            bag.message(channel, &message).unwrap();
        }
        if sequence % 10 == 0 {
            bag.tally(sequence * SECOND / 10).unwrap();
        }
    }
    bag.finish(5 * SECOND).unwrap();
}

fn sent(path: &Path) {
    recording(path, "127.0.0.2", Class::Control, Direction::Sent, |_| true);
}

/// Writes a file again: each message passes through `change`, which returns its new bytes, or nothing to cut it out.
fn forge(path: &Path, change: impl Fn(&str, u32, &[u8]) -> Option<Vec<u8>>) -> PathBuf {
    let out = path.with_extension("forged.mcap");
    let mut writer = mcap::Writer::new(fs::File::create(&out).unwrap()).unwrap();
    let mut reader = Reader::open(path).unwrap();
    let mut tallies = 0;
    while let Some(item) = reader.next_item().unwrap() {
        match item {
            Item::Metadata(name, metadata) => {
                writer.write_metadata(&mcap::records::Metadata { name, metadata }).unwrap()
            }
            Item::Message(message) => {
                let channel = &message.channel;
                let is_tally = channel.topic == "/sinew/tally";
                let number = if is_tally { tallies } else { message.sequence };
                tallies += u32::from(is_tally);
                let Some(data) = change(&channel.topic, number, message.data) else { continue };
                let id = writer.add_channel(0, &channel.topic, &channel.encoding, &channel.metadata).unwrap();
                let header = mcap::records::MessageHeader {
                    channel_id: id,
                    sequence: message.sequence,
                    log_time: message.log_ns,
                    publish_time: message.publish_ns,
                };
                writer.write_to_known_channel(&header, &data).unwrap();
            }
        }
    }
    writer.finish().unwrap();
    out
}

/// Returns kinds and texts, without those of nodes without a given file.
fn findings<P: AsRef<Path>>(files: &[P]) -> Vec<(Kind, String)> {
    let all = check(files).unwrap().findings.into_iter();
    all.filter(|finding| finding.kind != Kind::NoFile).map(|finding| (finding.kind, finding.text)).collect()
}

/// Returns the topics of the findings.
fn topics(file: &Path) -> Vec<String> {
    let all = check(&[file]).unwrap().findings.into_iter();
    all.filter(|finding| finding.kind != Kind::NoFile).map(|finding| finding.topic).collect()
}

#[test]
fn whole_recording_is_fine() {
    let folder = TestFolder::new();
    let [one, other] = ["one.mcap", "other.mcap"].map(|name| folder.path(name));
    sent(&one);
    recording(&other, "127.0.0.3", Class::Control, Direction::Received, |_| true);
    let report = check(&[&one, &other]).unwrap();
    assert!(report.is_fine(), "{:#?}", report.findings);
    assert_eq!((report.ends[0].sent, report.ends[0].received), (40, 40));
    let counts = &report.files[0].channels[0];
    assert_eq!((counts.seen, counts.written, counts.dropped, counts.in_file), (40, 40, 0, 40));
}

#[test]
fn type_without_a_name_is_joined_by_its_id() {
    let folder = TestFolder::new();
    let ends = [
        ("one.mcap", "127.0.0.2", Direction::Sent, "exo.angle"),
        ("other.mcap", "127.0.0.3", Direction::Received, "00000007"),
    ];
    let files = ends.map(|(name, address, direction, type_name)| {
        let path = folder.path(name);
        let mut bag = BagWriter::create(&path, Options::default(), origin(address)).unwrap();
        let channel = typed_channel(&mut bag, Class::Control, direction, type_name);
        (1..=5).for_each(|number| bag.message(channel, &record(number, number * SECOND)).unwrap());
        bag.finish(6 * SECOND).unwrap();
        path
    });
    let report = check(&files).unwrap();
    assert!(report.is_fine(), "{:#?}", report.findings);
    let [end] = &report.ends[..] else { panic!("{:#?}", report.ends) };
    assert_eq!((end.sent, end.received, end.type_name.as_str()), (5, 5, "exo.angle"));
}

#[test]
fn cut_message_is_found_exactly() {
    let folder = TestFolder::new();
    let path = folder.path("walk.mcap");
    sent(&path);
    let forged =
        forge(&path, |topic, sequence, data| (topic != RAW || sequence != 17).then(|| data.to_vec()));
    assert_eq!(topics(&forged), [RAW]);
    assert_eq!(
        findings(&[forged]),
        [(Kind::Missing, "message 17 (sequence 17) is missing; its view is there".to_owned())]
    );
    let forged =
        forge(&path, |topic, sequence, data| (topic != VIEW || sequence != 17).then(|| data.to_vec()));
    let found = findings(&[forged]);
    assert!(matches!(&found[..], [(Kind::Missing, text)] if text.contains("sequence 17")), "{found:?}");
}

#[test]
fn message_cut_with_its_view_lies_between_two_tallies() {
    let folder = TestFolder::new();
    let path = folder.path("walk.mcap");
    sent(&path);
    let forged = forge(&path, |topic, sequence, data| {
        (![RAW, VIEW].contains(&topic) || sequence != 17).then(|| data.to_vec())
    });
    let report = check(&[forged]).unwrap();
    let found: Vec<_> = report.findings.iter().filter(|finding| finding.kind == Kind::Missing).collect();
    assert_eq!(found.len(), 1, "{found:?}");
    assert_eq!((found[0].from_ns, found[0].to_ns, found[0].topic.as_str()), (SECOND, 2 * SECOND, RAW));
    assert!(
        found[0].text.contains("two tallies: 1;") && found[0].text.contains("the numbers 17"),
        "{}",
        found[0].text
    );
}

#[test]
fn falsified_counter_is_named() {
    let folder = TestFolder::new();
    let path = folder.path("walk.mcap");
    sent(&path);
    // The tally at 2 s. The first one is at the beginning of the file.
    let forge = |counters: [&'static str; 2]| {
        forge(&path, move |topic, number, data| {
            let text = String::from_utf8_lossy(data).into_owned();
            let is_changed = topic == "/sinew/tally" && number == 2;
            Some(
                if is_changed {
                    counters.iter().fold(text, |text, name| {
                        text.replace(&format!("\"{name}\":20"), &format!("\"{name}\":21"))
                    })
                } else {
                    text
                }
                .into_bytes(),
            )
        })
    };
    // Views are JSON here, so all messages are text.
    let found = findings(&[forge(["seen", "seen"])]);
    assert!(
        matches!(&found[..], [(Kind::Counter, text)] if text.contains("21 seen are not 20 written")),
        "{found:?}"
    );
    let forged = forge(["seen", "written"]);
    assert_eq!(topics(&forged), [RAW]);
    let found = findings(&[forged]);
    assert!(
        matches!(&found[..], [(Kind::Counter, text)] if text.contains("wrong by 1 in this tally alone")),
        "{found:?}"
    );
}

#[test]
fn parts_continue_each_other() {
    let folder = TestFolder::new();
    let path = folder.path("walk.mcap");
    let options = Options { split_time: Some(std::time::Duration::from_secs(1)), ..Options::default() };
    let mut bag = BagWriter::create(&path, options, origin("127.0.0.2")).unwrap();
    let channel = channel(&mut bag, Class::Control, Direction::Sent);
    for number in 1..=30 {
        bag.message(channel, &record(number, number * SECOND / 10)).unwrap();
    }
    let parts = bag.finish(3 * SECOND).unwrap().parts;
    let files: Vec<_> = (0..parts)
        .map(|part| if part == 0 { path.clone() } else { folder.path(&format!("walk.{part}.mcap")) })
        .collect();
    assert_eq!(findings(&files), []);
    let found = findings(&[&files[0], &files[2]]);
    assert_eq!(found, [(Kind::Part, "part 1 is absent: give this file, too".to_owned())]);
}

#[test]
fn killed_recorder_is_no_fault() {
    let folder = TestFolder::new();
    let path = folder.path("walk.mcap");
    let mut bag = BagWriter::create(&path, Options::default(), origin("127.0.0.2")).unwrap();
    let channel = channel(&mut bag, Class::Control, Direction::Sent);
    for number in 1..=15 {
        bag.message(channel, &record(number, number * SECOND / 10)).unwrap();
    }
    bag.tally(15 * SECOND / 10).unwrap();
    bag.message(channel, &record(16, 16 * SECOND / 10)).unwrap();
    std::mem::forget(bag);
    let report = check(&[&path]).unwrap();
    let found: Vec<_> = report.findings.iter().filter(|finding| finding.kind != Kind::NoFile).collect();
    assert!(found.is_empty(), "{found:?}");
    assert!(!report.files[0].is_finished);
    assert_eq!(report.files[0].channels[0].in_file, 15);
}

#[test]
fn lost_message_is_named_by_its_sequence() {
    let folder = TestFolder::new();
    for (class, expected) in [(Class::Control, 3), (Class::Stream, 0)] {
        let [one, other] = ["one", "other"].map(|name| folder.path(&format!("{name} {class}.mcap")));
        recording(&one, "127.0.0.2", class, Direction::Sent, |_| true);
        recording(&other, "127.0.0.3", class, Direction::Received, |sequence| {
            !(21..=23).contains(&sequence) && sequence > 2
        });
        let report = check(&[&one, &other]).unwrap();
        let end = &report.ends[0];
        assert_eq!((end.lost, end.lost + end.superseded_or_lost, end.before), (expected, 3, 2));
        assert_eq!(report.is_fine(), class == Class::Stream, "{:?}", report.findings);
        let is_named = report.findings.iter().any(|finding| finding.text.contains("sequence numbers: 21-23"));
        assert_eq!(is_named, class == Class::Control);
    }
}

/// Writes a recording of an incarnation with these sequence numbers, in this order.
fn incarnation(
    path: &Path,
    (address, incarnation): (&str, u64),
    direction: Direction,
    all: impl Iterator<Item = u64>,
) {
    let origin = Origin { incarnation, ..origin(address) };
    let options = Options { replace: true, ..Options::default() };
    let mut bag = BagWriter::create(path, options, origin).unwrap();
    let channel = channel(&mut bag, Class::Control, direction);
    for (number, sequence) in (1..).zip(all) {
        let message = crate::Record { sequence, ..record(number, number * SECOND / 10) };
        bag.message(channel, &message).unwrap();
    }
    bag.finish(60 * SECOND).unwrap();
}

#[test]
fn incarnation_that_is_recorded_later_is_no_finding() {
    let folder = TestFolder::new();
    let files = ["first.mcap", "second.mcap", "other.mcap"].map(|name| folder.path(name));
    // The numbers of both incarnations begin at 1, with other messages of the source between them.
    let (evens, odds) = ((2..=80).step_by(2), (1..=79).step_by(2));
    incarnation(&files[0], ("127.0.0.2", 1), Direction::Sent, evens.clone());
    incarnation(&files[1], ("127.0.0.2", 2), Direction::Sent, odds.clone().filter(|number| *number > 20));
    incarnation(&files[2], ("127.0.0.3", 1), Direction::Received, evens.chain(odds.clone()));
    assert_eq!(findings(&files), []);
    // And: a message behind the begin is a finding
    let later = odds.filter(|number| *number > 20 && *number != 31);
    incarnation(&files[1], ("127.0.0.2", 3), Direction::Sent, later);
    let found = findings(&files);
    assert!(
        matches!(&found[..], [(Kind::Unsent, text)] if text.ends_with("sequence numbers: 31")),
        "{found:?}"
    );
}

#[test]
fn messages_between_two_recordings_give_no_finding() {
    let folder = TestFolder::new();
    let files = ["one.mcap", "first.mcap", "second.mcap"].map(|name| folder.path(name));
    incarnation(&files[0], ("127.0.0.2", 1), Direction::Sent, 1..=80);
    incarnation(&files[1], ("127.0.0.3", 1), Direction::Received, 1..=30);
    incarnation(&files[2], ("127.0.0.3", 2), Direction::Received, (41..=80).filter(|number| *number != 50));
    let report = check(&files).unwrap();
    let end = &report.ends[0];
    assert_eq!((end.before, end.lost, end.after), (10, 1, 0));
    assert!(report.findings.iter().any(|finding| finding.text.ends_with("sequence numbers: 50")));
}

/// Writes the file of a node that sent messages at these times to another one, which began its recording at 20 s of the
/// same clock and has none of them. The clocks differ by 1 s, and the reading of them may be wrong by 100 ms.
fn joined_late(folder: &TestFolder, sent_ms: &[u64], has_reading: bool) -> [PathBuf; 2] {
    let files = ["one.mcap", "late.mcap"].map(|name| folder.path(name));
    let options = || Options { replace: true, ..Options::default() };
    let mut one = BagWriter::create(&files[0], options(), origin("127.0.0.2")).unwrap();
    let sent = channel(&mut one, Class::Control, Direction::Sent);
    for (number, at_ms) in (1..).zip(sent_ms) {
        one.message(sent, &record(number, at_ms * 1_000_000)).unwrap();
    }
    if has_reading {
        let reading = crate::ClockReading {
            peer: "127.0.0.3".into(),
            incarnation: 1,
            offset_ns: SECOND as i64,
            bound_ns: SECOND / 10,
            ..crate::ClockReading::default()
        };
        one.clock(25 * SECOND, &reading).unwrap();
    }
    one.finish(40 * SECOND).unwrap();
    // 20 s of the first clock are 21 s of this one. Its wall clock is another one.
    let late = Origin { began_ns: 21 * SECOND, wall_offset_ns: 7 * SECOND as i64, ..origin("127.0.0.3") };
    let mut late = BagWriter::create(&files[1], options(), late).unwrap();
    late.tally(22 * SECOND).unwrap();
    late.finish(31 * SECOND).unwrap();
    files
}

#[test]
fn messages_before_the_receiver_recorded_are_no_finding() {
    let folder = TestFolder::new();
    // Given: four messages before its recording began, the last one less than the bound after it
    let files = joined_late(&folder, &[5_000, 10_000, 19_999, 20_099], true);
    // Then
    let report = check(&files).unwrap();
    assert!(report.is_fine(), "{:#?}", report.findings);
    let end = &report.ends[0];
    assert_eq!((end.sent, end.received, end.before, end.after), (4, 0, 4, 0));
    // And: a message beyond the bound is a finding, and one that may be on its way at the end is none
    let found = findings(&joined_late(&folder, &[5_000, 20_101, 29_500], true));
    assert!(
        matches!(&found[..], [(Kind::Lost, text)]
            if text.starts_with("1 messages were sent") && text.contains("while it recorded")),
        "{found:?}"
    );
    // And: without a clock in common, nothing is excused
    let found = findings(&joined_late(&folder, &[5_000, 10_000], false));
    assert!(
        matches!(&found[..], [(Kind::Lost, text)]
            if text.starts_with("2 messages were sent") && text.contains("no clock reading connects")),
        "{found:?}"
    );
}

#[test]
fn dropped_messages_of_all_recordings_count_together() {
    // Given: a receiver that was recorded twice, and dropped three messages each time
    let folder = TestFolder::new();
    let files = ["one.mcap", "first.mcap", "second.mcap"].map(|name| folder.path(name));
    incarnation(&files[0], ("127.0.0.2", 1), Direction::Sent, 1..=80);
    for (number, dropped) in [(1, 11..=13_u64), (2, 51..=53)] {
        let origin = Origin { incarnation: number, ..origin("127.0.0.3") };
        let mut bag = BagWriter::create(&files[number as usize], Options::default(), origin).unwrap();
        let channel = channel(&mut bag, Class::Control, Direction::Received);
        let all = (1 + 40 * (number - 1))..=(40 * number);
        for (at, sequence) in (1..).zip(all) {
            if dropped.contains(&sequence) {
                bag.dropped(channel, 1, (at * SECOND / 10, at * SECOND / 10)).unwrap();
            } else {
                let message = crate::Record { sequence, ..record(at, at * SECOND / 10) };
                bag.message(channel, &message).unwrap();
            }
        }
        bag.finish(60 * SECOND).unwrap();
    }
    // Then
    let report = check(&files).unwrap();
    assert!(report.is_fine(), "{:#?}", report.findings);
    assert_eq!((report.ends[0].not_recorded, report.ends[0].lost), (6, 0));
}

#[test]
fn dropped_messages_of_overlapping_recordings_count_once() {
    // Given: a receiver with two recordings at the same time. Both have dropped 11 to 13, and 21 to 23 have not arrived
    let folder = TestFolder::new();
    let files = ["one.mcap", "first.mcap", "second.mcap"].map(|name| folder.path(name));
    incarnation(&files[0], ("127.0.0.2", 1), Direction::Sent, 1..=80);
    for began in [1, 2] {
        let origin = Origin { began_ns: began * 1_000, ..origin("127.0.0.3") };
        let mut bag = BagWriter::create(&files[began as usize], Options::default(), origin).unwrap();
        let channel = channel(&mut bag, Class::Control, Direction::Received);
        for (at, sequence) in (1..).zip((1..=80).filter(|sequence| !(21..=23).contains(sequence))) {
            if (11..=13).contains(&sequence) {
                bag.dropped(channel, 1, (at * SECOND / 10, at * SECOND / 10)).unwrap();
            } else {
                let message = crate::Record { sequence, ..record(at, at * SECOND / 10) };
                bag.message(channel, &message).unwrap();
            }
        }
        bag.finish(60 * SECOND).unwrap();
    }
    // Then
    let report = check(&files).unwrap();
    assert_eq!((report.ends[0].not_recorded, report.ends[0].lost), (3, 3), "{:#?}", report.findings);
    assert!(!report.is_fine());
}

#[test]
fn receiver_without_a_tally_proves_nothing() {
    let folder = TestFolder::new();
    let [one, other] = ["one.mcap", "other.mcap"].map(|name| folder.path(name));
    sent(&one);
    recording(&other, "127.0.0.3", Class::Control, Direction::Received, |_| false);
    let forged = forge(&other, |topic, _, data| (topic != "/sinew/tally").then(|| data.to_vec()));
    let found = findings(&[&one, &forged]);
    assert!(
        matches!(&found[..], [(Kind::NoTally, text)] if text.starts_with("not provable: no tally")),
        "{found:?}"
    );
}

#[test]
fn merged_file_is_refused_with_names_of_its_files() {
    let folder = TestFolder::new();
    let files = ["one.mcap", "again.mcap"].map(|name| folder.path(name));
    for (path, address) in files.iter().zip(["127.0.0.2", "127.0.0.3"]) {
        let mut bag = BagWriter::create(path, Options::default(), origin(address)).unwrap();
        let reading = crate::ClockReading { peer: "127.0.0.2".into(), incarnation: 1, ..Default::default() };
        bag.clock(SECOND, &reading).unwrap();
        bag.finish(2 * SECOND).unwrap();
    }
    let out = folder.path("all.mcap");
    crate::merge(&files, &out).unwrap();
    let fault = check(&[out]).unwrap_err().to_string();
    assert!(fault.contains("all.mcap: it is a merged file"), "{fault}");
    assert!(fault.ends_with("check the files that it was made of: one.mcap again.mcap"), "{fault}");
}

#[test]
fn node_without_a_file_is_named() {
    let folder = TestFolder::new();
    let path = folder.path("walk.mcap");
    sent(&path);
    let found = check(&[&path]).unwrap().findings;
    assert!(
        matches!(&found[..], [Finding { kind: Kind::NoFile, topic, .. }] if topic == "127.0.0.3"),
        "{found:?}"
    );
}

#[test]
fn damaged_chunk_is_named_and_the_rest_is_read() {
    let folder = TestFolder::new();
    let path = folder.path("walk.mcap");
    sent(&path);
    let bytes = fs::read(&path).unwrap();
    let (at, length) = chunks(&bytes)[2];
    let found = |changed: usize| {
        let mut bytes = bytes.clone();
        bytes[changed] ^= 0x40;
        fs::write(&path, bytes).unwrap();
        let all = check(&[&path]).unwrap().findings;
        let damage: Vec<_> = all.iter().filter(|finding| finding.kind == Kind::Damaged).collect();
        assert_eq!(damage.len(), 1, "{all:?}");
        damage[0].text.clone()
    };
    assert!(found(at + 9 + length / 2).contains("a chunk is damaged"));
    assert!(found(at + 3).contains("the length of a record is damaged"));
}
