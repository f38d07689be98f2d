use parquet::{
    file::reader::{FileReader as _, SerializedFileReader},
    record::Field,
};

use super::*;
use crate::{
    BagWriter, ChannelInfo, Class, Direction, Options, Origin, Party, Record,
    testing::{TestFolder, angle, chunks, record},
};

/// A recording with these payloads.
fn recording(folder: &TestFolder, payloads: &[serde_json::Value]) -> PathBuf {
    let path = folder.path("walk.mcap");
    let mut bag = BagWriter::create(&path, Options::default(), Origin::default()).unwrap();
    let channel = angle(&mut bag, Direction::Sent);
    for (number, payload) in (1..).zip(payloads) {
        let payload = rmp_serde::to_vec_named(payload).unwrap();
        let record = Record {
            number,
            sequence: number,
            sent_ns: 5,
            handed_over_ns: 9,
            payload: &payload,
            ..Record::default()
        };
        bag.message(channel, &record).unwrap();
    }
    bag.finish(10).unwrap();
    path
}

#[test]
fn protected_payload_has_the_columns_of_its_value() {
    let folder = TestFolder::new();
    let path = folder.path("walk.mcap");
    let mut bag = BagWriter::create(&path, Options::default(), Origin::default()).unwrap();
    let party = Party { text: "127.0.0.2/1".to_owned(), ..Party::default() };
    let info = ChannelInfo {
        source: &party,
        destination: &party,
        type_name: "exo.torque",
        kind: 7,
        class: Class::Stream,
        direction: Direction::Sent,
        is_protected: true,
        schema: None,
        refused: None,
        seen_before: 0,
    };
    let channel = bag.channel(&info).unwrap();
    let sealed = [&[1; 32][..], b"\x81\xa1x\x05", &[9; 8]].concat();
    bag.message(channel, &Record { number: 1, sequence: 1, payload: &sealed, ..Record::default() }).unwrap();
    bag.finish(10).unwrap();
    let exported = export(&path, folder.path("out"), Format::Csv).unwrap().files;
    let text = fs::read_to_string(&exported[0].file).unwrap();
    let heading = text.lines().next().unwrap();
    assert!(heading.split(',').any(|column| column == "x"), "{text}");
    assert!(text.lines().nth(1).unwrap().split(',').any(|cell| cell == "5"), "{text}");
}

#[test]
fn text_has_a_column_for_each_value() {
    let folder = TestFolder::new();
    let path = recording(
        &folder,
        &[
            serde_json::json!({ "degrees": 1.5, "joint": { "name": "knee, left", "limits": [-1, 2] }, "log_ns": null }),
            serde_json::json!({ "degrees": -3, "log_ns": 7, "big": u64::MAX }),
        ],
    );
    let exported = export(&path, folder.path("out"), Format::Csv).unwrap().files;
    assert_eq!((exported[0].rows, exported[0].columns), (2, 14));
    assert!(exported[0].file.ends_with("knee.sensor__exo.angle.csv"));
    let text = fs::read_to_string(&exported[0].file).unwrap();
    let lines: Vec<_> = text.lines().collect();
    assert_eq!(
        lines[0],
        "log_ns,publish_ns,sequence,number,correlation,age_ns,error_ns,flags,degrees,joint.limits.0,joint.limits.1,joint.name,big,payload.log_ns"
    );
    assert_eq!(lines[1], r#"9,5,1,1,0,4,0,0,1.5,-1,2,"knee, left",,"#);
    assert_eq!(lines[2], "9,5,2,2,0,4,0,0,-3,,,,18446744073709551615,7");
    assert!(export(&path, folder.path("out"), Format::Csv).is_err(), "no file is overwritten");
}

#[test]
fn parquet_keeps_types() {
    let folder = TestFolder::new();
    let path = recording(
        &folder,
        &[
            serde_json::json!({ "big": u64::MAX, "low": i64::MIN, "on": true, "text": "é", "mixed": 1, "odd": 1 }),
            serde_json::json!({ "big": 0, "low": 1, "mixed": 0.5, "odd": "one" }),
        ],
    );
    let exported = export(&path, folder.path("out"), Format::Parquet).unwrap().files;
    let reader = SerializedFileReader::new(fs::File::open(&exported[0].file).unwrap()).unwrap();
    let rows: Vec<Vec<(String, Field)>> =
        reader.get_row_iter(None).unwrap().map(|row| row.unwrap().into_columns()).collect();
    let get = |row: usize, name: &str| rows[row].iter().find(|(column, _)| column == name).unwrap().1.clone();
    assert_eq!([get(0, "big"), get(1, "big")], [Field::ULong(u64::MAX), Field::ULong(0)]);
    assert_eq!([get(0, "low"), get(1, "low")], [Field::Long(i64::MIN), Field::Long(1)]);
    assert_eq!([get(0, "on"), get(1, "on")], [Field::Bool(true), Field::Null]);
    assert_eq!([get(0, "mixed"), get(1, "mixed")], [Field::Double(1.0), Field::Double(0.5)]);
    assert_eq!([get(0, "odd"), get(1, "odd")], [Field::Str("1".into()), Field::Str("one".into())]);
    assert_eq!(get(0, "text"), Field::Str("é".into()));
    assert_eq!(get(1, "age_ns"), Field::Long(4));
}

#[test]
fn payload_with_nested_keys_or_long_paths_stays_whole() {
    let long = "a".repeat(600);
    let long = long.as_str();
    let long_path = rmp_serde::to_vec_named(&serde_json::json!({ long: { long: 1 } })).unwrap();
    let nested_keys = [vec![0x81_u8; 60], vec![0x01_u8; 61]].concat();
    for payload in [long_path, nested_keys] {
        let mut columns = Columns::default();
        columns.add(&Row { log_ns: 0, publish_ns: 0, header: None, payload });
        let described = columns.described();
        assert_eq!(described.len(), columns::FIXED.len() + 1);
        assert_eq!(described[columns::FIXED.len()].0, "bytes");
    }
}

#[test]
fn loss_of_damaged_recording_is_named() {
    let folder = TestFolder::new();
    let path = folder.path("walk.mcap");
    let options = Options { chunk_bytes: 1_024, ..Options::default() };
    let mut bag = BagWriter::create(&path, options, Origin::default()).unwrap();
    let channel = angle(&mut bag, Direction::Sent);
    (1..=60).for_each(|number| bag.message(channel, &record(number, number * 100_000_000)).unwrap());
    bag.finish(7_000_000_000).unwrap();
    let whole = fs::read(&path).unwrap();
    let exported = |bytes: &[u8], out: &str| {
        fs::write(&path, bytes).unwrap();
        let exports = export(&path, folder.path(out), Format::Csv).unwrap();
        (exports.files[0].rows, exports.damage, exports.unfinished)
    };
    assert_eq!(exported(&whole, "whole"), (60, Vec::new(), None));
    // When: the file is cut off in the middle of a chunk
    let (rows, damage, unfinished) = exported(&whole[..chunks(&whole)[4].0 + 20], "cut");
    let unfinished = unfinished.expect("the end is missing");
    assert!(rows > 0 && rows < 60 && damage.is_empty(), "{rows}: {damage:?}");
    let is_named = unfinished.contains("the file ends at byte ") && unfinished.contains("messages after ");
    assert!(is_named, "{unfinished}");
    // When: a byte of a chunk is changed
    let (at, length) = chunks(&whole)[2];
    let mut changed = whole.clone();
    changed[at + 9 + length / 2] ^= 0x40;
    let (rows, damage, unfinished) = exported(&changed, "changed");
    assert!(rows > 0 && rows < 60 && unfinished.is_none(), "{rows}: {unfinished:?}");
    assert!(
        matches!(&damage[..], [line] if line.contains("its messages, from ") && line.contains(&format!("at byte {at}"))),
        "{damage:?}"
    );
}
