use super::*;
use crate::{
    BagWriter, ClockReading, Options, Origin,
    testing::{TestFolder, angle, record},
};

const SECOND: u64 = 1_000_000_000;

/// A node with a clock that is `ahead_ns` ahead of that of the first node, and a wall clock that is wrong.
fn write(
    folder: &TestFolder,
    name: &str,
    ahead_ns: i64,
    wall_offset_ns: i64,
    peer: Option<(&str, i64)>,
) -> std::path::PathBuf {
    let path = folder.path(&format!("{name}.mcap"));
    let address = name.to_owned();
    let origin = Origin { node: name.into(), address, incarnation: 1, wall_offset_ns, ..Origin::default() };
    let mut bag = BagWriter::create(&path, Options::default(), origin).unwrap();
    let channel = angle(&mut bag, crate::Direction::Sent);
    for number in 1..=20_u64 {
        // Each message of this node was at this time of the first node's clock.
        let at_ns = (number * SECOND).saturating_add_signed(ahead_ns);
        bag.message(channel, &record(number, at_ns)).unwrap();
        if let Some((peer, offset_ns)) = peer {
            let reading = ClockReading {
                peer: peer.into(),
                incarnation: 1,
                offset_ns,
                bound_ns: 500,
                ..ClockReading::default()
            };
            bag.clock(at_ns, &reading).unwrap();
        }
    }
    bag.finish((21 * SECOND).saturating_add_signed(ahead_ns)).unwrap();
    path
}

#[test]
fn times_are_those_of_the_first_node() {
    let folder = TestFolder::new();
    // Wall clocks are 5 s apart, monotonic clocks by minutes. The third one knows only the second one.
    let files = [
        write(&folder, "a", 0, 1_000_000 * SECOND as i64, Some(("b", 60 * SECOND as i64))),
        write(&folder, "b", 60 * SECOND as i64, 1_000_005 * SECOND as i64, None),
        write(&folder, "c", 7 * SECOND as i64 + 123, -5, Some(("b", 53 * SECOND as i64 - 123))),
    ];
    let out = folder.path("all.mcap");
    let merged = merge(&files, &out).unwrap();
    assert_eq!(merged.reference, "a");
    let bounds: Vec<_> = merged.nodes.iter().map(|node| node.bound_ns).collect();
    assert_eq!(bounds, [0, 500, 1_000]);
    let mut all = Ordered::open(&out).unwrap();
    let mut raw = Vec::new();
    while let Some(message) = all.next_message().unwrap() {
        if message.channel.encoding == "msgpack" {
            raw.push((message.log_ns, message.sequence));
        }
    }
    let expected = |at: usize| ((1_000_000 + at as u64 / 3 + 1) * SECOND, at as u32 / 3 + 1);
    assert_eq!(raw, (0..60).map(expected).collect::<Vec<_>>());
    assert_eq!(all.metadata("sinew.merged").unwrap()["bound_ns c"], "1000");
}

#[test]
fn readings_that_differ_turn_no_time_back() {
    // Given: two readings within 100 us. Each is wrong by its bound, in the other direction
    const BOUND_NS: i64 = 1_000_000;
    let folder = TestFolder::new();
    let reference = write(&folder, "a", 0, 0, None);
    let path = folder.path("b.mcap");
    let origin = Origin { node: "b".into(), address: "b".into(), incarnation: 1, ..Origin::default() };
    let mut bag = BagWriter::create(&path, Options::default(), origin).unwrap();
    let channel = angle(&mut bag, crate::Direction::Sent);
    let truth = |number: u64| 10 * SECOND + number * 10_000;
    for number in 1..=20 {
        bag.message(channel, &record(number, truth(number))).unwrap();
    }
    for (number, offset_ns) in [(5, BOUND_NS), (15, -BOUND_NS)] {
        let bound_ns = BOUND_NS.unsigned_abs();
        let reading =
            ClockReading { peer: "a".into(), incarnation: 1, offset_ns, bound_ns, ..ClockReading::default() };
        bag.clock(truth(number), &reading).unwrap();
    }
    bag.finish(11 * SECOND).unwrap();
    // When
    let out = folder.path("all.mcap");
    merge(&[reference, path], &out).unwrap();
    // Then: the file is in the order of its times, and all are within the bound
    let mut reader = crate::read::Reader::open(&out).unwrap();
    let (mut last_ns, mut count) = (0, 0);
    while let Some(item) = reader.next_item().unwrap() {
        let crate::read::Item::Message(message) = item else { continue };
        assert!(message.log_ns >= last_ns, "{} after {last_ns}", message.log_ns);
        last_ns = message.log_ns;
        if message.channel.encoding == "msgpack" && message.channel.value("node") == "b" {
            let wrong_ns = message.log_ns.abs_diff(truth(message.sequence.into()));
            assert!(wrong_ns <= BOUND_NS.unsigned_abs(), "{wrong_ns}");
            count += 1;
        }
    }
    assert_eq!(count, 20);
}

#[test]
fn node_without_a_clock_reading_is_named() {
    let folder = TestFolder::new();
    let files = [write(&folder, "a", 0, 0, None), write(&folder, "b", 0, 0, None)];
    let fault = merge(&files, folder.path("all.mcap")).unwrap_err().to_string();
    assert!(fault.contains("connects its node b with a"), "{fault}");
}

#[test]
fn recording_that_is_given_twice_is_refused() {
    let folder = TestFolder::new();
    let path = write(&folder, "a", 0, 0, None);
    let copy = folder.path("copy.mcap");
    fs::copy(&path, &copy).unwrap();
    for second in [&path, &copy] {
        let out = folder.path("all.mcap");
        let fault = merge(&[&path, second], &out).unwrap_err().to_string();
        let words = format!("{} and {} are the same part", path.display(), second.display());
        assert!(fault.starts_with(&words), "{fault}");
        assert!(!out.exists());
    }
    // And: a later recording of the same node is another one
    let later = folder.path("later.mcap");
    let origin =
        Origin { node: "a".into(), address: "a".into(), incarnation: 1, began_ns: 9, ..Origin::default() };
    BagWriter::create(&later, Options::default(), origin).unwrap().finish(10).unwrap();
    merge(&[&path, &later], folder.path("all.mcap")).unwrap();
}

#[test]
fn loss_of_a_merged_file_is_known_later() {
    let folder = TestFolder::new();
    let files = [
        write(&folder, "a", 0, 0, Some(("b", 60 * SECOND as i64))),
        write(&folder, "b", 60 * SECOND as i64, 0, None),
    ];
    let losses = |out: &str| {
        let out = folder.path(out);
        merge(&files, &out).unwrap();
        let merged = Ordered::open(&out).unwrap();
        assert_eq!(merged.missing_end(), None);
        merged.damage().to_vec()
    };
    assert_eq!(losses("whole.mcap"), [""; 0]);
    // When: the end of one file is cut off
    let bytes = fs::read(&files[1]).unwrap();
    fs::write(&files[1], &bytes[..bytes.len() - 20]).unwrap();
    let found = losses("cut.mcap");
    assert!(
        matches!(&found[..], [loss] if loss.contains("cut.mcap: one of the files") && loss.contains("b.mcap: unfinished")),
        "{found:?}"
    );
}
