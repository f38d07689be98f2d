//! A recording in the hands of the official readers: PyPI's `mcap` and `mcap-protobuf-support`.

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
    process::Command,
};

use serde::Serialize;
use serde_json::{Value, json};
use sinew_bag::{BagWriter, ChannelId, ChannelInfo, Class, Direction, Options, Origin, Party, Record};
use sinew_schema::{Field, Schema, Shape, Variant};

/// The packages that the script needs.
const PACKAGES: [&str; 2] = ["mcap", "mcap-protobuf-support"];
const SECOND: u64 = 1_000_000_000;

#[derive(Serialize)]
enum Mode {
    #[expect(dead_code, reason = "the value 0 of the enum")]
    Idle,
    Walk,
}

#[derive(Serialize)]
enum Order {
    Stop,
    Torque(f32),
}

#[derive(Serialize)]
struct Sample {
    angle: f64,
    torque: f32,
    big: u64,
    low: i64,
    wide: u128,
    #[serde(with = "serde_bytes")]
    raw: Vec<u8>,
    mode: Mode,
    commands: Vec<Order>,
    gains: BTreeMap<String, f64>,
    limit: Option<f32>,
    none: Option<u32>,
    list: Vec<u16>,
}

fn schema() -> Schema {
    let boxed = Box::new;
    let field = |name: &str, shape: Shape| Field {
        name: name.into(),
        optional: matches!(shape, Shape::Option(_)),
        shape,
    };
    let variant = |name: &str, shape: Shape| Variant { name: name.into(), shape };
    let fields = vec![
        field("angle", Shape::F64),
        field("torque", Shape::F32),
        field("big", Shape::U64),
        field("low", Shape::I64),
        field("wide", Shape::U128),
        field("raw", Shape::Bytes),
        field("mode", Shape::Named("Mode".into())),
        field("commands", Shape::List(boxed(Shape::Named("Order".into())))),
        field("gains", Shape::Map(boxed(Shape::Text), boxed(Shape::F64))),
        field("limit", Shape::Option(boxed(Shape::F32))),
        field("none", Shape::Option(boxed(Shape::U32))),
        field("list", Shape::List(boxed(Shape::U16))),
    ];
    let mode = Shape::Enum(vec![variant("Idle", Shape::Unit), variant("Walk", Shape::Unit)]);
    let order =
        Shape::Enum(vec![variant("Stop", Shape::Unit), variant("Torque", Shape::Newtype(boxed(Shape::F32)))]);
    let types = [("Sample", Shape::Struct(fields)), ("Mode", mode), ("Order", order)];
    let types = types.into_iter().map(|(name, shape)| (name.to_owned(), shape)).collect();
    Schema { root: Shape::Named("Sample".into()), types }
}

fn sample() -> Vec<u8> {
    let sample = Sample {
        angle: f64::from_bits(0x7ff8_0000_0000_0001),
        torque: -0.0,
        big: u64::MAX,
        low: i64::MIN,
        wide: u128::MAX,
        raw: vec![0, 255, 128],
        mode: Mode::Walk,
        commands: vec![Order::Stop, Order::Torque(0.1)],
        gains: BTreeMap::from([("kd".into(), f64::NAN), ("kp".into(), 1.5)]),
        limit: Some(0.0),
        none: None,
        list: vec![1, 65_535],
    };
    rmp_serde::to_vec_named(&sample).expect("it has a form in MessagePack")
}

fn recording(path: &Path) -> (BagWriter, ChannelId) {
    let origin = Origin {
        node: "knee".into(),
        address: "127.0.0.2".into(),
        wall_offset_ns: 1_000,
        ..Origin::default()
    };
    let options = Options { replace: true, ..Options::default() };
    let mut bag = BagWriter::create(path, options, origin).expect("the folder is writable");
    let party = |tid, name: &str| Party {
        tid,
        text: format!("127.0.0.2/{tid}"),
        name: Some(name.into()),
        node: None,
    };
    let channel = bag.channel(&ChannelInfo {
        source: &party(1, "knee.sensor"),
        destination: &party(2, "knee.drive"),
        type_name: "exo.sample",
        kind: 7,
        class: Class::Stream,
        direction: Direction::Sent,
        is_protected: false,
        schema: Some(&schema()),
        refused: None,
        seen_before: 0,
    });
    (bag, channel.expect("it is the first one"))
}

fn record(number: u64, payload: &[u8]) -> Record<'_> {
    let handed_over_ns = number * SECOND / 10;
    let (sequence, sent_ns) = (u64::MAX - 100 + number, handed_over_ns - 250);
    Record { number, sequence, sent_ns, handed_over_ns, payload, ..Record::default() }
}

/// Returns the Python that has the packages, or the reason why there is none.
fn python(folder: &Path) -> Result<PathBuf, String> {
    let venv = folder.join("venv");
    let python = venv.join("bin/python");
    let has_packages = |python: &Path| {
        let imported =
            Command::new(python).args(["-c", "import mcap.reader, mcap_protobuf.decoder"]).output();
        imported.is_ok_and(|output| output.status.success())
    };
    if has_packages(&python) {
        return Ok(python);
    }
    let run = |command: &mut Command| {
        let output = command.output().map_err(|error| format!("{command:?}: {error}"))?;
        let text = String::from_utf8_lossy(&output.stderr);
        let last = text.lines().last().unwrap_or_default().to_owned();
        if output.status.success() { Ok(()) } else { Err(format!("{command:?}: {last}")) }
    };
    run(Command::new("python3").args(["-m", "venv"]).arg(&venv))?;
    // Without a network it fails in seconds.
    let pip = [
        "-m",
        "pip",
        "install",
        "--quiet",
        "--disable-pip-version-check",
        "--timeout",
        "10",
        "--retries",
        "1",
    ];
    run(Command::new(&python).args(pip).args(PACKAGES))?;
    Ok(python)
}

#[test]
fn official_readers_decode_the_values_that_were_sent() {
    let folder = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join("official");
    fs::create_dir_all(&folder).expect("the target folder is writable");
    let python = match python(&folder) {
        Ok(python) => python,
        Err(reason) => {
            println!("skipped: {reason}");
            return;
        }
    };
    let payload = sample();
    let (whole, killed) = (folder.join("whole.mcap"), folder.join("killed.mcap"));
    let (mut bag, channel) = recording(&whole);
    bag.message(channel, &record(1, &payload)).expect("there is room");
    bag.message(channel, &record(2, b"\x01")).expect("there is room");
    bag.finish(SECOND).expect("there is room");
    let (mut bag, channel) = recording(&killed);
    for number in 1..=15 {
        bag.message(channel, &record(number, &payload)).expect("there is room");
    }
    // As by SIGKILL: nothing runs.
    std::mem::forget(bag);

    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/read.py");
    let output = Command::new(python).arg(script).args([&whole, &killed]).output().expect("it starts");
    let (out, err) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{out}{err}");
    let read: Value = serde_json::from_str(&out).unwrap_or_else(|error| panic!("{error}: {out}{err}"));

    let bits = |value: f64| format!("{:016x}", value.to_bits());
    let expected = json!({
        "angle": "7ff8000000000001", "torque": bits(-0.0), "big": u64::MAX, "low": i64::MIN,
        "wide": u128::MAX.to_string(), "raw": "00ff80", "mode": "Walk", "variants": ["Stop", "Torque"],
        "torque of the command": bits(f64::from(0.1_f32)), "gains": { "kd": "NaN", "kp": 1.5 },
        "limit": 0.0, "none": null, "list": [1, 65_535], "sequence": u64::MAX - 99, "number": 1, "age_ns": 250,
        "misfit": "", "times": [SECOND / 10 + 1_000, SECOND / 10 + 750],
    });
    assert_eq!(read["views"][0], expected);
    let misfit = &read["views"][1];
    assert_eq!((&misfit["misfit"], &misfit["number"]), (&"a map for a struct".into(), &2.into()), "{misfit}");
    let hex: String = payload.iter().map(|byte| format!("{byte:02x}")).collect();
    assert_eq!(read["raw"], json!([hex, "01"]));
    // Two messages with what stands beside them, and the tallies at the beginning and the end.
    assert_eq!((&read["messages"], &read["killed"]), (&6.into(), &10.into()));
    assert_eq!(
        read["topics"],
        json!(["/knee.sensor/exo.sample", "/knee.sensor/exo.sample/view", "/sinew/tally"])
    );
    assert_eq!(read["metadata"], json!([["sinew", "knee"]]));
}
