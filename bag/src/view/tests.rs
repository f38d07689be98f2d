//! Views read by another implementation of protocol buffers.

use std::collections::BTreeMap;

use proptest::prelude::*;
use prost_reflect::{DescriptorPool, DynamicMessage, Value};
use serde::Serialize;
use sinew_schema::{Field, Schema, Shape, Variant};

use super::{View, header};
use crate::{messagepack::MisfitError, protobuf::Output, terms::Record};

#[derive(Clone, Serialize)]
enum Mode {
    #[expect(dead_code, reason = "the value 0 of the enum")]
    Idle,
    Walk,
}

#[derive(Clone, Serialize)]
enum Command {
    Stop,
    Torque(f32),
    Path(Vec<f64>),
    Pair(i8, i16),
    Move { to: f64, fast: Option<bool> },
}

#[derive(Clone, Serialize)]
struct Sample {
    sinew: u8,
    angle: f64,
    torque: f32,
    big: u64,
    low: i64,
    wide: u128,
    wide_low: i128,
    letter: char,
    name: String,
    #[serde(with = "serde_bytes")]
    raw: Vec<u8>,
    mode: Mode,
    commands: Vec<Command>,
    gains: BTreeMap<String, f64>,
    limit: Option<f32>,
    none: Option<u32>,
    maybe_list: Option<Vec<u16>>,
    matrix: [[f32; 2]; 2],
    pair: (u8, String),
    nothing: (),
}

fn sample() -> Sample {
    Sample {
        sinew: 9,
        angle: f64::NAN,
        torque: f32::NEG_INFINITY,
        big: u64::MAX,
        low: i64::MIN,
        wide: u128::MAX,
        wide_low: i128::MIN,
        letter: 'é',
        name: "knee".into(),
        raw: vec![0, 255, 128],
        mode: Mode::Walk,
        commands: vec![
            Command::Stop,
            Command::Torque(-0.0),
            Command::Path(vec![1.5, f64::INFINITY]),
            Command::Pair(-128, 300),
            Command::Move { to: 0.1, fast: Some(false) },
        ],
        gains: BTreeMap::from([("kp".into(), 1.5), ("kd".into(), f64::NAN)]),
        limit: Some(0.0),
        none: None,
        maybe_list: Some(vec![]),
        matrix: [[1.0, 2.0], [3.0, 4.0]],
        pair: (7, "seven".into()),
        nothing: (),
    }
}

fn field(name: &str, shape: Shape) -> Field {
    let optional = matches!(shape, Shape::Option(_));
    Field { name: name.into(), shape, optional }
}

fn variant(name: &str, shape: Shape) -> Variant {
    Variant { name: name.into(), shape }
}

fn boxed(shape: Shape) -> Box<Shape> {
    Box::new(shape)
}

fn schema() -> Schema {
    let mode = Shape::Enum(vec![variant("Idle", Shape::Unit), variant("Walk", Shape::Unit)]);
    let moved = vec![field("to", Shape::F64), field("fast", Shape::Option(boxed(Shape::Bool)))];
    let command = Shape::Enum(vec![
        variant("Stop", Shape::Unit),
        variant("Torque", Shape::Newtype(boxed(Shape::F32))),
        variant("Path", Shape::Newtype(boxed(Shape::List(boxed(Shape::F64))))),
        variant("Pair", Shape::Tuple(vec![Shape::I8, Shape::I16])),
        variant("Move", Shape::Struct(moved)),
    ]);
    let row = Shape::Array(boxed(Shape::F32), 2);
    let fields = vec![
        field("sinew", Shape::U8),
        field("angle", Shape::Named("Degrees".into())),
        field("torque", Shape::F32),
        field("big", Shape::U64),
        field("low", Shape::I64),
        field("wide", Shape::U128),
        field("wide_low", Shape::I128),
        field("letter", Shape::Char),
        field("name", Shape::Text),
        field("raw", Shape::Bytes),
        field("mode", Shape::Named("Mode".into())),
        field("commands", Shape::List(boxed(Shape::Named("Command".into())))),
        field("gains", Shape::Map(boxed(Shape::Text), boxed(Shape::F64))),
        field("limit", Shape::Option(boxed(Shape::F32))),
        field("none", Shape::Option(boxed(Shape::U32))),
        field("maybe_list", Shape::Option(boxed(Shape::List(boxed(Shape::U16))))),
        field("matrix", Shape::Array(boxed(row), 2)),
        field("pair", Shape::Tuple(vec![Shape::U8, Shape::Text])),
        field("nothing", Shape::Unit),
    ];
    let types = BTreeMap::from([
        ("Sample".into(), Shape::Struct(fields)),
        ("Degrees".into(), Shape::Newtype(boxed(Shape::F64))),
        ("Mode".into(), mode),
        ("Command".into(), command),
    ]);
    Schema { root: Shape::Named("Sample".into()), types }
}

fn read(view: &View, bytes: &[u8]) -> DynamicMessage {
    let pool = DescriptorPool::decode(view.descriptor().as_slice()).expect("the description is valid");
    let message = pool.get_message_by_name(&view.name()).expect("the message is described");
    DynamicMessage::decode(message, bytes).expect("the message is valid")
}

fn viewed(view: &View, payload: &impl Serialize) -> DynamicMessage {
    let mut out = Output::default();
    view.encode(&rmp_serde::to_vec_named(payload).unwrap(), &mut out).expect("it fits");
    read(view, &out.0)
}

fn get(message: &DynamicMessage, name: &str) -> Value {
    message.get_field_by_name(name).unwrap_or_else(|| panic!("no field {name}")).into_owned()
}

#[test]
fn values_are_those_that_were_sent() {
    let view = View::new("exo.sample", &schema()).unwrap();
    assert_eq!(view.name(), "sinew.exo.Sample");
    let message = viewed(&view, &sample());
    let get = |name: &str| get(&message, name);
    assert!(get("angle").as_f64().unwrap().is_nan());
    assert_eq!(get("sinew_v2"), Value::U32(9), "the header has the name");
    assert_eq!(get("torque"), Value::F32(f32::NEG_INFINITY));
    assert_eq!(get("big"), Value::U64(u64::MAX));
    assert_eq!(get("low"), Value::I64(i64::MIN));
    assert_eq!(get("wide"), Value::String(u128::MAX.to_string()));
    assert_eq!(get("wide_low"), Value::String(i128::MIN.to_string()));
    assert_eq!(get("letter"), Value::String("é".into()));
    assert_eq!(get("raw"), Value::Bytes(vec![0, 255, 128].into()));
    assert_eq!(get("mode"), Value::EnumNumber(1));
    assert_eq!(get("gains"), Value::String(r#"{"kd":"NaN","kp":1.5}"#.into()));
    assert!(message.has_field_by_name("limit"), "0 is a value");
    assert!(!message.has_field_by_name("none"));
    assert!(message.has_field_by_name("maybe_list"), "an empty list is a value");
    let row = |value: &Value| self::get(value.as_message().unwrap(), "value");
    let numbers = |value: Value| {
        value.as_list().unwrap().iter().map(|value| value.as_f32().unwrap()).collect::<Vec<_>>()
    };
    assert_eq!(numbers(row(&get("matrix").as_list().unwrap()[1])), [3.0, 4.0]);
    assert_eq!(self::get(get("pair").as_message().unwrap(), "item_1"), Value::String("seven".into()));
}

#[test]
fn variants_keep_their_data() {
    let view = View::new("exo.sample", &schema()).unwrap();
    let message = viewed(&view, &sample());
    let commands = get(&message, "commands");
    let commands: Vec<_> =
        commands.as_list().unwrap().iter().map(|value| value.as_message().unwrap()).collect();
    let set: Vec<_> =
        commands.iter().map(|command| command.fields().next().unwrap().0.name().to_owned()).collect();
    assert_eq!(set, ["Stop", "Torque", "Path", "Pair", "Move"]);
    let torque = get(commands[1], "Torque").as_f32().unwrap();
    assert!(torque == 0.0 && torque.is_sign_negative());
    let moved = get(commands[4], "Move");
    assert_eq!(get(moved.as_message().unwrap(), "fast"), Value::Bool(false));
}

#[test]
fn header_stands_beside_the_payload() {
    let view = View::new("exo.sample", &schema()).unwrap();
    let mut out = Output::default();
    let record =
        Record { number: 3, sequence: u64::MAX, sent_ns: 50, handed_over_ns: 40, ..Record::default() };
    out.message(super::HEADER_FIELD, |out| header(&record, Some(MisfitError::new("f32")), out));
    let message = read(&view, &out.0);
    let header = get(&message, "sinew");
    let get = |name: &str| get(header.as_message().unwrap(), name);
    assert_eq!([get("sequence"), get("number")], [Value::U64(u64::MAX), Value::U64(3)]);
    assert_eq!(get("age_ns"), Value::I64(-10), "a clock that is wrong is shown as it is");
    assert_eq!(get("misfit"), Value::String("f32".into()));
}

#[test]
fn payload_of_another_type_does_not_fit() {
    #[derive(Serialize)]
    struct Other {
        angle: &'static str,
    }
    let view = View::new("exo.sample", &schema()).unwrap();
    let payloads = [
        rmp_serde::to_vec_named(&Other { angle: "far" }).unwrap(),
        rmp_serde::to_vec_named(&()).unwrap(),
        [rmp_serde::to_vec_named(&sample()).unwrap(), vec![0]].concat(),
        vec![],
    ];
    for payload in payloads {
        assert!(view.encode(&payload, &mut Output::default()).is_err());
    }
    // Without names of fields, as other languages may write it.
    assert!(view.encode(&rmp_serde::to_vec(&sample()).unwrap(), &mut Output::default()).is_ok());
}

#[test]
fn type_that_contains_itself_has_a_view() {
    #[derive(Serialize)]
    struct Node {
        id: u32,
        below: Vec<Self>,
    }
    let below = Shape::List(boxed(Shape::Named("Node".into())));
    let node = Shape::Struct(vec![field("id", Shape::U32), field("below", below)]);
    let types = BTreeMap::from([("Node".into(), node)]);
    let view = View::new("tree", &Schema { root: Shape::Named("Node".into()), types }).unwrap();
    let inner = Node { id: 2, below: vec![] };
    let message = viewed(&view, &Node { id: 1, below: vec![inner] });
    let below = get(&message, "below");
    assert_eq!(get(below.as_list().unwrap()[0].as_message().unwrap(), "id"), Value::U32(2));
}

#[test]
fn payload_that_is_one_value_has_a_field() {
    let plain = |root: Shape| Schema { root, types: BTreeMap::new() };
    let view = View::new("demo.count", &plain(Shape::Newtype(boxed(Shape::U16)))).unwrap();
    assert_eq!(get(&viewed(&view, &7_u16), "value"), Value::U32(7));
    let view = View::new("demo.stop", &plain(Shape::Unit)).unwrap();
    assert_eq!(viewed(&view, &()).fields().count(), 0);
}

proptest! {
    #[test]
    fn any_payload_fits_or_is_refused(payload: Vec<u8>) {
        let view = View::new("exo.sample", &schema()).unwrap();
        let mut out = Output::default();
        if view.encode(&payload, &mut out).is_ok() {
            read(&view, &out.0);
        }
    }

    #[test]
    fn changed_payload_fits_or_is_refused(at: prop::sample::Index, byte: u8) {
        let view = View::new("exo.sample", &schema()).unwrap();
        let mut payload = rmp_serde::to_vec_named(&sample()).unwrap();
        let at = at.index(payload.len());
        payload[at] = byte;
        let mut out = Output::default();
        if view.encode(&payload, &mut out).is_ok() {
            read(&view, &out.0);
        }
    }
}

#[test]
fn fields_of_all_messages_are_limited() {
    // A list is not a type of its own, so each use of it is a message with 1,000 fields.
    let list = Shape::List(Box::new(Shape::Tuple(vec![Shape::U8; 1_000])));
    let view = |uses| {
        let root = Shape::Tuple(vec![Shape::Named("list".to_owned()); uses]);
        let types = BTreeMap::from([("list".to_owned(), list.clone())]);
        View::new("demo.wide", &Schema { root, types })
    };
    assert!(view(30).is_some());
    assert!(view(100).is_none());
}
