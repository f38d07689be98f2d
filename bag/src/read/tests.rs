use std::{fs, io::Cursor, path::Path};

use proptest::prelude::*;

use super::*;
use crate::{
    BagWriter, Compression, Options, Origin,
    testing::{TestFolder, angle, chunks, record},
};

const SECOND: u64 = 1_000_000_000;

fn written(folder: &TestFolder, options: Options) -> PathBuf {
    let path = folder.path("walk.mcap");
    let mut bag =
        BagWriter::create(&path, options, Origin { node: "knee".into(), ..Origin::default() }).unwrap();
    let channel = angle(&mut bag, crate::Direction::Sent);
    for number in 1..=50_u64 {
        // Each second message was handed over late.
        let at_ns = number * SECOND / 10 + u64::from(number % 2 == 0) * 2 * SECOND;
        bag.message(channel, &record(number, at_ns)).unwrap();
    }
    bag.finish(10 * SECOND).unwrap();
    path
}

/// Reads to the end; returns the messages and the faults.
fn read(bytes: &[u8]) -> (Vec<(String, u64)>, usize, End) {
    let Ok(mut reader) = Reader::new(Cursor::new(bytes), Path::new("some")) else {
        return (Vec::new(), 1, End::Open);
    };
    let (mut messages, mut faults) = (Vec::new(), 0);
    loop {
        match reader.next_item() {
            Ok(Some(Item::Message(message))) => {
                messages.push((message.channel.topic.clone(), message.log_ns))
            }
            Ok(Some(Item::Metadata(..))) => {}
            Ok(None) => return (messages, faults, reader.end()),
            Err(_) => faults += 1,
        }
    }
}

#[test]
fn every_compression_is_read() {
    for compression in [Compression::None, Compression::Lz4, Compression::Zstd] {
        let folder = TestFolder::new();
        let bytes = fs::read(written(&folder, Options { compression, ..Options::default() })).unwrap();
        let (messages, faults, end) = read(&bytes);
        assert_eq!((messages.len(), faults), (102, 0));
        assert_eq!(end, End::Finished { messages: Some(102) });
    }
}

#[test]
fn file_cut_anywhere_is_read_up_to_the_cut() {
    let folder = TestFolder::new();
    let bytes = fs::read(written(&folder, Options::default())).unwrap();
    let whole = read(&bytes).0;
    let mut last = 0;
    for length in 0..bytes.len() - 8 {
        let (messages, _, end) = read(&bytes[..length]);
        assert!(messages.len() >= last && whole.starts_with(&messages), "cut at {length}");
        assert!(!matches!(end, End::Finished { .. }) || messages.len() == whole.len());
        last = messages.len();
    }
    assert_eq!(last, whole.len(), "the summary is not needed");
}

#[test]
fn damaged_chunk_is_named_with_its_times() {
    let folder = TestFolder::new();
    let path = folder.path("walk.mcap");
    // Given: messages that are all in one chunk
    let mut bag = BagWriter::create(&path, Options::default(), Origin::default()).unwrap();
    let channel = angle(&mut bag, crate::Direction::Sent);
    (1..=50).for_each(|number| bag.message(channel, &record(number, number * SECOND / 1_000)).unwrap());
    bag.finish(SECOND / 10).unwrap();
    let mut bytes = fs::read(&path).unwrap();
    let times = |at: usize| chunk::times(&bytes[at + 9..]).unwrap();
    // The first message of the file is at 0, in a chunk of its own.
    let first = chunks(&bytes).into_iter().find(|(at, _)| times(*at).1 > 0);
    let (at, length) = first.expect("the file has messages");
    let (first_ns, last_ns) = times(at);
    assert!(first_ns < last_ns, "{first_ns} to {last_ns}");
    bytes[at + 9 + length / 2] ^= 0x40;
    let mut reader = Reader::new(Cursor::new(&bytes[..]), Path::new("some")).unwrap();
    let fault = std::iter::repeat_with(|| reader.next_item().map(|item| item.is_some()))
        .take_while(|item| !matches!(item, Ok(false)))
        .find_map(Result::err);
    let fault = fault.expect("the chunk is damaged").to_string();
    let [first, last] = [first_ns, last_ns].map(|at_ns| format!("{}.{:09}s", at_ns / SECOND, at_ns % SECOND));
    let times = format!("from {first} to {last} of the file");
    assert!(fault.contains(&times), "{times}: {fault}");
}

#[test]
fn order_of_times_is_that_of_all_messages() {
    let folder = TestFolder::new();
    let path = written(&folder, Options { chunk_bytes: 1_024, ..Options::default() });
    let mut ordered = Ordered::open(&path).unwrap();
    let mut times = Vec::new();
    while let Some(message) = ordered.next_message().unwrap() {
        times.push(message.log_ns);
    }
    let mut expected: Vec<_> =
        read(&fs::read(&path).unwrap()).0.into_iter().map(|(_, log_ns)| log_ns).collect();
    assert!(!expected.is_sorted());
    expected.sort_unstable();
    assert_eq!(times, expected);
}

#[test]
fn header_is_that_of_the_message() {
    for raw_only in [false, true] {
        let folder = TestFolder::new();
        let path = written(&folder, Options { raw_only, ..Options::default() });
        let mut reader = Reader::open(&path).unwrap();
        let mut numbers = Vec::new();
        while let Some(item) = reader.next_item().unwrap() {
            if let Item::Message(message) = item {
                numbers.extend(
                    Header::of(&message).map(|header| (header.number, header.sequence, header.age_ns)),
                );
            }
        }
        assert_eq!(numbers, (1..=50).map(|number| (number, number, 0)).collect::<Vec<_>>());
    }
}

#[test]
fn stated_lengths_reserve_nothing() {
    let head = b"\x89MCAP0\r\n";
    // A record of 255 MiB, and a chunk of as many bytes, of which nothing is there.
    let record = [&head[..], &[frames::METADATA], &(255_u64 << 20).to_le_bytes()].concat();
    let (messages, _, end) = read(&record);
    assert_eq!((messages.len(), end), (0, End::Unfinished { at: 8 }));
    let endless = [&head[..], &[frames::METADATA], &u64::MAX.to_le_bytes(), &[0; 100]].concat();
    assert_eq!(read(&endless).1, 1);
}

#[test]
fn schemas_and_channels_are_limited_together() {
    let (mut channels, mut schemas) = (BTreeMap::new(), BTreeMap::new());
    // Number, name, encoding, and data of one byte.
    let schema = |id: u8| [id, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 7];
    let length = schema(1).len() as u64 - 2;
    let mut declared = frames::DECLARED_MAX - length;
    let mut declare =
        |id| frames::declare(frames::SCHEMA, Body(&schema(id)), &mut channels, &mut schemas, &mut declared);
    assert_eq!(declare(1), Some(()));
    assert_eq!(declare(1), Some(()), "it is kept already");
    assert_eq!(declare(2), None);
    assert_eq!((schemas.len(), declared), (1, frames::DECLARED_MAX));
}

proptest! {
    #[test]
    fn any_bytes_are_read_to_an_end(bytes: Vec<u8>) {
        read(&bytes);
        read(&[b"\x89MCAP0\r\n", &bytes[..]].concat());
    }
}

#[test]
fn changed_bytes_are_read_to_an_end() {
    let folder = TestFolder::new();
    for compression in [Compression::None, Compression::Lz4, Compression::Zstd] {
        let bytes =
            fs::read(written(&folder, Options { compression, replace: true, ..Options::default() })).unwrap();
        for at in (0..bytes.len()).step_by(7) {
            let mut changed = bytes.clone();
            changed[at] = changed[at].wrapping_add(1 + (at % 254) as u8);
            read(&changed);
        }
    }
}
