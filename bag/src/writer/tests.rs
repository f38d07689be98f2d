use std::{fs, io, os::unix::fs::PermissionsExt as _, time::Duration};

use super::*;
use crate::{
    terms::{Class, Compression, Direction, EventTopic, Level},
    testing::{TestFolder, angle, record, with_info},
};

fn origin() -> Origin {
    Origin { node: "knee".into(), address: "127.0.0.2".into(), wall_offset_ns: 1_000, ..Origin::default() }
}

const SECOND: u64 = 1_000_000_000;

fn messages(path: &std::path::Path) -> Vec<(String, u64, u32)> {
    let bytes = fs::read(path).unwrap();
    let all = mcap::MessageStream::new(&bytes).unwrap();
    all.map_while(Result::ok)
        .map(|message| (message.channel.topic.clone(), message.log_time, message.sequence))
        .collect()
}

fn on<'m>(all: &'m [(String, u64, u32)], topic: &str) -> Vec<&'m (String, u64, u32)> {
    all.iter().filter(|(other, ..)| other == topic).collect()
}

#[test]
fn official_reader_has_all_messages() {
    for compression in [Compression::None, Compression::Lz4, Compression::Zstd] {
        let folder = TestFolder::new();
        let file = folder.path("walk.mcap");
        let options = Options { compression, ..Options::default() };
        let mut bag = BagWriter::create(&file, options, origin()).unwrap();
        let channel = angle(&mut bag, Direction::Sent);
        for number in 1..=100 {
            bag.message(channel, &record(number, number * 10_000_000)).unwrap();
        }
        let totals = bag.finish(SECOND).unwrap();
        assert_eq!((totals.seen, totals.written, totals.parts), (100, 100, 1));
        assert_eq!(totals.bytes, fs::metadata(&file).unwrap().len());
        let all = messages(&file);
        let raw = on(&all, "/knee.sensor/exo.angle");
        assert_eq!((raw.len(), on(&all, "/knee.sensor/exo.angle/view").len()), (100, 100));
        assert_eq!(*raw[0], ("/knee.sensor/exo.angle".into(), 10_001_000, 1));
    }
}

#[test]
fn each_channel_names_its_recorder_and_incarnation() {
    let folder = TestFolder::new();
    let file = folder.path("walk.mcap");
    let mut bag =
        BagWriter::create(&file, Options::default(), Origin { incarnation: 7, ..origin() }).unwrap();
    let channel = angle(&mut bag, Direction::Sent);
    bag.message(channel, &record(1, SECOND)).unwrap();
    bag.finish(SECOND).unwrap();
    let bytes = fs::read(&file).unwrap();
    let mut topics = BTreeSet::new();
    for message in mcap::MessageStream::new(&bytes).unwrap().map(Result::unwrap) {
        let of = |key: &str| message.channel.metadata.get(key).cloned().unwrap_or_default();
        assert_eq!((of("sinew.node"), of("sinew.incarnation")), ("127.0.0.2".into(), "7".into()));
        topics.insert(message.channel.topic.clone());
    }
    let expected = ["/knee.sensor/exo.angle", "/knee.sensor/exo.angle/view", "/sinew/tally"];
    assert_eq!(topics, expected.map(str::to_owned).into());
}

#[test]
fn second_destination_has_a_topic_of_its_own() {
    let folder = TestFolder::new();
    let file = folder.path("walk.mcap");
    let mut bag = BagWriter::create(&file, Options::default(), origin()).unwrap();
    let channels = [(); 3].map(|()| angle(&mut bag, Direction::Sent));
    let topics = channels.map(|channel| bag.of(channel).topic.clone());
    let all = [
        "/knee.sensor/exo.angle",
        "/knee.sensor/exo.angle/to/127.0.0.3/1",
        "/knee.sensor/exo.angle/to/127.0.0.3/1/sent",
    ];
    assert_eq!(topics, all);
}

#[test]
fn killed_recorder_leaves_all_but_the_last_second() {
    let folder = TestFolder::new();
    let file = folder.path("walk.mcap");
    let mut bag = BagWriter::create(&file, Options::default(), origin()).unwrap();
    let channel = angle(&mut bag, Direction::Sent);
    for number in 1..=25 {
        bag.message(channel, &record(number, number * SECOND / 10)).unwrap();
    }
    // As by SIGKILL: nothing runs.
    std::mem::forget(bag);
    assert_eq!(on(&messages(&file), "/knee.sensor/exo.angle").len(), 20);
}

#[test]
fn each_part_is_a_file_of_its_own() {
    let folder = TestFolder::new();
    let file = folder.path("walk.mcap");
    let options = Options { split_time: Some(Duration::from_secs(2)), ..Options::default() };
    let mut bag = BagWriter::create(&file, options, origin()).unwrap();
    let channel = angle(&mut bag, Direction::Sent);
    for second in 1..=6 {
        bag.message(channel, &record(second, second * SECOND)).unwrap();
        bag.tally(second * SECOND).unwrap();
    }
    let totals = bag.finish(7 * SECOND).unwrap();
    assert_eq!((totals.written, totals.parts), (6, 4));
    let parts = [0, 1, 2, 3].map(|number| part::path(&file, number));
    let counts = parts.map(|path| {
        assert!(mcap::Summary::read(&fs::read(&path).unwrap()).unwrap().is_some(), "{}", path.display());
        on(&messages(&path), "/knee.sensor/exo.angle").len()
    });
    assert_eq!(counts, [2, 2, 2, 0]);
}

#[test]
fn size_is_limited_and_reported_once() {
    let folder = TestFolder::new();
    let file = folder.path("walk.mcap");
    let options = Options { size_max: Some(64 << 10), compression: Compression::None, ..Options::default() };
    let mut bag = BagWriter::create(&file, options, origin()).unwrap();
    let channel = angle(&mut bag, Direction::Sent);
    let faults: Vec<_> =
        (1..=2_000).filter_map(|number| bag.message(channel, &record(number, number)).err()).collect();
    assert!(matches!(faults[..], [BagError::Full { .. }]), "{faults:?}");
    let totals = bag.finish(SECOND).unwrap();
    assert!(fs::metadata(&file).unwrap().len() <= 64 << 10);
    assert!(
        totals.written > 100 && totals.dropped > 100 && totals.seen == totals.written + totals.dropped,
        "{totals:?}"
    );
    assert_eq!(on(&messages(&file), "/knee.sensor/exo.angle").len() as u64, totals.written);
}

#[test]
fn failed_write_is_reported_once_and_new_part_follows() {
    let folder = TestFolder::new();
    let file = folder.path("walk.mcap");
    // Without `replace` the name of the folder below would be skipped.
    let options = Options { replace: true, ..Options::default() };
    let mut bag = BagWriter::create(&file, options, origin()).unwrap();
    let channel = angle(&mut bag, Direction::Sent);
    bag.message(channel, &record(1, 1)).unwrap();
    bag.tally(2).unwrap();
    // The next part cannot be made, and the current one fails.
    let next = part::path(&file, 1);
    fs::create_dir(&next).unwrap();
    bag.message(channel, &record(2, 3)).unwrap();
    let fault = bag.fail(io::Error::from(ErrorKind::StorageFull), 4);
    assert!(fault.to_string().contains("free space on this disk"), "{fault}");
    bag.message(channel, &record(3, 5)).unwrap();
    bag.message(channel, &record(4, 5 + 2 * SECOND)).unwrap();
    assert!(!bag.is_writing());
    fs::remove_dir(&next).unwrap();
    bag.message(channel, &record(5, 5 + 4 * SECOND)).unwrap();
    assert!(bag.is_writing());
    let totals = bag.finish(6 * SECOND).unwrap();
    assert_eq!((totals.seen, totals.written, totals.dropped), (5, 2, 3));
    assert_eq!(on(&messages(&file), "/knee.sensor/exo.angle").len(), 1);
    assert_eq!(on(&messages(&next), "/knee.sensor/exo.angle").len(), 1);
}

#[test]
fn existing_file_is_kept() {
    let folder = TestFolder::new();
    let file = folder.path("walk.mcap");
    fs::write(&file, "kept").unwrap();
    let fault = BagWriter::create(&file, Options::default(), origin()).unwrap_err();
    assert!(fault.to_string().contains("choose another name"), "{fault}");
    assert_eq!(fs::read(&file).unwrap(), b"kept");
}

#[test]
fn only_the_owner_may_read_a_new_file() {
    let folder = TestFolder::new();
    let file = folder.path("walk.mcap");
    let bag = BagWriter::create(&file, Options::default(), origin()).unwrap();
    bag.finish(SECOND).unwrap();
    assert_eq!(fs::metadata(&file).unwrap().permissions().mode() & 0o777, 0o600);
}

#[test]
fn later_part_skips_the_name_of_an_existing_file() {
    let folder = TestFolder::new();
    let file = folder.path("walk.mcap");
    let [existing, next] = [1, 2].map(|number| part::path(&file, number));
    fs::write(&existing, "kept").unwrap();
    let options = Options { split_time: Some(Duration::from_secs(1)), ..Options::default() };
    let mut bag = BagWriter::create(&file, options, origin()).unwrap();
    let channel = angle(&mut bag, Direction::Sent);
    bag.message(channel, &record(1, SECOND)).unwrap();
    assert_eq!(bag.path(), next);
    bag.message(channel, &record(2, SECOND + 1)).unwrap();
    assert_eq!(bag.finish(SECOND + 2).unwrap().parts, 2);
    assert_eq!(fs::read(&existing).unwrap(), b"kept");
    let ordered = crate::read::Ordered::open(&next).unwrap();
    assert_eq!(ordered.metadata(METADATA).unwrap()["part"], "1", "parts are numbered without a gap");
}

#[test]
fn event_has_the_schema_of_log_lines() {
    let folder = TestFolder::new();
    let file = folder.path("walk.mcap");
    let mut bag = BagWriter::create(&file, Options::default(), origin()).unwrap();
    let data = serde_json::json!({ "node": "hip" });
    for topic in EventTopic::ALL {
        bag.event(&Event {
            topic,
            at_ns: SECOND,
            level: Level::Warning,
            name: "ndl",
            text: "hip is lost",
            data: &data,
        })
        .unwrap();
    }
    bag.finish(2 * SECOND).unwrap();
    let bytes = fs::read(&file).unwrap();
    let message = mcap::MessageStream::new(&bytes)
        .unwrap()
        .map(Result::unwrap)
        .find(|message| message.channel.topic == "/sinew/events")
        .unwrap();
    assert_eq!(message.channel.schema.as_ref().unwrap().name, "foxglove.Log");
    let value: serde_json::Value = serde_json::from_slice(&message.data).unwrap();
    assert_eq!((&value["timestamp"]["nsec"], &value["data"]["node"]), (&1_000.into(), &"hip".into()));
}

#[test]
fn thread_of_a_recorder_can_have_it() {
    fn is_send<T: Send>(_: &T) {}
    let folder = TestFolder::new();
    is_send(&BagWriter::create(folder.path("walk.mcap"), Options::default(), origin()).unwrap());
}

#[test]
fn view_of_a_protected_payload_shows_the_value_inside() {
    let folder = TestFolder::new();
    let file = folder.path("walk.mcap");
    let mut bag = BagWriter::create(&file, Options::default(), origin()).unwrap();
    let channel = angle(&mut bag, Direction::Sent);
    // The bytes before and behind the value stand for an envelope.
    let sealed = [&[1; 32][..], b"\x81\xa1x\x05", &[9; 8]].concat();
    let sent = Record { payload: &sealed, inner: Some(&sealed[32..36]), ..record(1, SECOND) };
    bag.message(channel, &sent).unwrap();
    assert_eq!(bag.finish(2 * SECOND).unwrap().misfits, 0);
    let bytes = fs::read(&file).unwrap();
    let all = mcap::MessageStream::new(&bytes).unwrap().map(Result::unwrap);
    let found: Vec<_> = all.filter(|message| message.channel.topic.starts_with("/knee.sensor")).collect();
    assert_eq!(&*found[0].data, &*sealed, "the payload stays as it was sent");
    let view: serde_json::Value = serde_json::from_slice(&found[1].data).unwrap();
    assert_eq!(view["x"], 5);
}

/// Same as [`angle`], for views without a file.
fn viewed_angle(views: &mut ViewWriter) -> ChannelId {
    with_info(Class::Stream, Direction::Sent, "exo.angle", |info| views.channel(info)).unwrap()
}

#[test]
fn views_without_a_file_are_those_of_the_file() {
    // Given: the same messages for a file and for a stream of views
    let folder = TestFolder::new();
    let file = folder.path("walk.mcap");
    let mut bag = BagWriter::create(&file, Options::default(), origin()).unwrap();
    let mut views = ViewWriter::new(origin());
    views.want(&BTreeSet::from(["/knee.sensor/exo.angle/view".to_owned()]));
    let in_bag = angle(&mut bag, Direction::Sent);
    let in_views = viewed_angle(&mut views);
    for number in 1..=3 {
        let record = record(number, number * SECOND);
        bag.message(in_bag, &record).unwrap();
        views.message(in_views, &record);
    }
    bag.finish(4 * SECOND).unwrap();
    // When
    let items = views.take();
    // Then
    let bytes = fs::read(&file).unwrap();
    let written: Vec<_> = mcap::MessageStream::new(&bytes)
        .unwrap()
        .map(Result::unwrap)
        .filter(|message| message.channel.topic == "/knee.sensor/exo.angle/view")
        .collect();
    let ViewItem::Channel(channel) = &items[0] else { panic!("{items:?}") };
    let schema = written[0].channel.schema.as_ref().unwrap();
    assert_eq!(channel.encoding, written[0].channel.message_encoding);
    assert_eq!((&channel.schema_name, channel.schema_encoding), (&schema.name, schema.encoding.as_str()));
    assert_eq!(channel.schema, &*schema.data);
    for (key, value) in &written[0].channel.metadata {
        assert_eq!(channel.metadata.get(key), Some(value), "{key}");
    }
    assert_eq!(channel.metadata["sinew.source_name"], "knee.sensor");
    let streamed = items[1..].iter().map(|item| match item {
        ViewItem::Message { topic, time_ns, data } => (topic.to_string(), *time_ns, data.clone()),
        ViewItem::Channel(_) | ViewItem::Missed { .. } => panic!("{item:?}"),
    });
    let filed = written
        .iter()
        .map(|message| (message.channel.topic.clone(), message.log_time, message.data.to_vec()));
    assert_eq!(streamed.collect::<Vec<_>>(), filed.collect::<Vec<_>>());
    assert!(views.take().is_empty());
}

#[test]
fn unwanted_messages_are_counted_and_not_encoded() {
    let mut views = ViewWriter::new(origin());
    let channel = viewed_angle(&mut views);
    views.message(channel, &record(1, SECOND));
    views.dropped(channel, 2, (SECOND, SECOND));
    assert_eq!(views.take().len(), 1, "the channel alone");
    views.want(&BTreeSet::from([TALLY_TOPIC.to_owned(), "/knee.sensor/exo.angle/view".to_owned()]));
    views.message(channel, &record(4, SECOND));
    views.dropped(channel, 1, (SECOND, SECOND));
    views.tally(SECOND);
    let items = views.take();
    let [ViewItem::Message { .. }, ViewItem::Missed { count: 1, .. }, ViewItem::Message { topic, data, .. }] =
        &items[..]
    else {
        panic!("{items:?}")
    };
    let tally: serde_json::Value = serde_json::from_slice(data).unwrap();
    assert_eq!(&**topic, TALLY_TOPIC);
    let counts = &tally["channels"][0];
    assert_eq!((&counts["seen"], &counts["written"], &counts["dropped"]), (&5.into(), &2.into(), &3.into()));
}

#[test]
fn expected_channel_is_the_one_that_comes() {
    let mut views = ViewWriter::new(origin());
    let expected = with_info(Class::Stream, Direction::Sent, "exo.angle", ViewWriter::expected);
    viewed_angle(&mut views);
    let items = views.take();
    let [ViewItem::Channel(found)] = &items[..] else { panic!("{items:?}") };
    assert_eq!((&found.topic, &found.schema), (&expected.topic, &expected.schema));
    let fixed: Vec<_> = ViewWriter::fixed_channels().into_iter().map(|channel| channel.topic).collect();
    assert_eq!(fixed.len(), 6);
    assert!(fixed.iter().all(|topic| topic.starts_with("/sinew/")), "{fixed:?}");
}
