//! Recordings: MCAP files, of which a person gives any.

use std::{io::Cursor, path::Path};

use sinew_bag::{
    check::check_readers,
    read::{Header, Item, Reader},
};

/// The first bytes of each file.
const MAGIC: &[u8] = b"\x89MCAP0\r\n";

// Opcodes of records.
const SCHEMA: u8 = 0x03;
const CHANNEL: u8 = 0x04;
const MESSAGE: u8 = 0x05;
const CHUNK: u8 = 0x06;
const METADATA: u8 = 0x0c;

/// Reads the bytes as a file, and as what follows its first bytes; then checks it.
pub(crate) fn recording(bytes: &[u8]) -> bool {
    let whole = [MAGIC, bytes].concat();
    let bytes = if bytes.starts_with(MAGIC) { bytes } else { &whole };
    let open = || Reader::new(Cursor::new(bytes), Path::new("a recording"));
    let Ok(mut reader) = open() else { return false };
    let mut messages = 0;
    loop {
        match reader.next_item() {
            Ok(Some(Item::Message(message))) => {
                messages += 1;
                std::hint::black_box(Header::of(&message));
            }
            // Damage is skipped.
            Ok(Some(Item::Metadata(..))) | Err(_) => {}
            Ok(None) => break,
        }
    }
    assert!(reader.position() <= bytes.len() as u64);
    if let Ok(reader) = open() {
        // A refusal has no effect.
        let _ = check_readers(vec![reader]);
    }
    messages > 0
}

/// A recording with one message and its tallies: without compression and checksums, so that changes of it are read.
pub(crate) fn some_recordings() -> Vec<Vec<u8>> {
    let origin = [("node", "knee"), ("address", "127.0.0.2"), ("part", "0")];
    let metadata = record(METADATA, &[text("sinew"), map(&origin)].concat());
    let ends =
        [("sinew.source_tid", "1"), ("sinew.destination_tid", "2"), ("sinew.destination_node", "127.0.0.3")];
    let raw = [&ends[..], &[("sinew.role", "raw"), ("sinew.direction", "sent"), ("sinew.class", "Stream")]]
        .concat();
    let view = [("sinew.role", "view"), ("sinew.raw", "/knee/angle")];
    let json = [("sinew.role", "json"), ("sinew.raw", "/knee/angle")];
    let tally = |count: u8| {
        let counts = format!(r#""seen":{count},"written":{count},"dropped":0"#);
        format!(r#"{{"is_whole":true,"channels":[{{"topic":"/knee/angle",{counts}}}]}}"#).into_bytes()
    };
    // The field 15,000 with sequence 1 and number 1.
    let header = [0xc2, 0xa9, 0x07, 4, 0x08, 1, 0x18, 1];
    let records = [
        record(
            SCHEMA,
            &[&1_u16.to_le_bytes()[..], &text("sinew.Angle"), &text("protobuf"), &text("")].concat(),
        ),
        channel(1, 0, "/knee/angle", "msgpack", &raw),
        channel(2, 1, "/knee/angle/view", "protobuf", &view),
        channel(3, 0, "/sinew/tally", "json", &[]),
        channel(4, 0, "/knee/angle/json", "json", &json),
        message(3, 1, &tally(0)),
        message(1, 2, b"\x81\xa1x\x05"),
        message(2, 2, &header),
        message(3, 3, &tally(1)),
        message(4, 4, br#"{"x":5,"sinew":{"sequence":2,"number":2}}"#),
    ]
    .concat();
    let head = [&[0; 16][..], &(records.len() as u64).to_le_bytes(), &[0; 4], &text("")].concat();
    let chunk = record(CHUNK, &[&head[..], &(records.len() as u64).to_le_bytes(), &records].concat());
    vec![[MAGIC, &metadata, &chunk].concat(), [metadata, records].concat()]
}

fn record(opcode: u8, body: &[u8]) -> Vec<u8> {
    [&[opcode][..], &(body.len() as u64).to_le_bytes(), body].concat()
}

fn text(text: &str) -> Vec<u8> {
    [&(text.len() as u32).to_le_bytes()[..], text.as_bytes()].concat()
}

fn map(all: &[(&str, &str)]) -> Vec<u8> {
    let all: Vec<u8> = all.iter().flat_map(|(key, value)| [text(key), text(value)].concat()).collect();
    [&(all.len() as u32).to_le_bytes()[..], &all].concat()
}

fn channel(id: u16, schema: u16, topic: &str, encoding: &str, metadata: &[(&str, &str)]) -> Vec<u8> {
    let ids = [id.to_le_bytes(), schema.to_le_bytes()].concat();
    record(CHANNEL, &[ids, text(topic), text(encoding), map(metadata)].concat())
}

fn message(channel: u16, at_ns: u64, data: &[u8]) -> Vec<u8> {
    let at = at_ns.to_le_bytes();
    record(MESSAGE, &[&channel.to_le_bytes()[..], &1_u32.to_le_bytes(), &at, &at, data].concat())
}
