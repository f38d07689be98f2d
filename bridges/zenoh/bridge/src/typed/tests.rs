//! Values with and without the structure of their type.

use std::collections::BTreeMap;

use proptest::prelude::*;
use sinew::{
    schema::schema_of,
    serde::{Deserialize, Serialize},
};

use super::*;
use crate::value::tests::values;

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(crate = "sinew::serde")]
struct Joint {
    name: String,
    limits: (f32, f32),
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(crate = "sinew::serde")]
enum Step {
    Stand,
    Metres(f64),
    Turn { degrees: f32, mark: char },
}

sinew::payload!("rules.report" => #[derive(Clone, Debug, PartialEq)] struct Report {
    count: u16,
    offset: i8,
    big: u64,
    note: Option<String>,
    joints: Vec<Joint>,
    step: Step,
    by_number: BTreeMap<u8, bool>,
});

fn report() -> Report {
    Report {
        count: 7,
        offset: -3,
        big: u64::MAX,
        note: None,
        joints: vec![Joint { name: "knee".to_owned(), limits: (-0.1, 1.5) }],
        step: Step::Turn { degrees: 12.5, mark: 'ä' },
        by_number: BTreeMap::from([(3, true)]),
    }
}

fn schema() -> Schema {
    let found = schema_of::<Report>().expect("the table of types has room");
    found.expect("it has a structure").schema().clone()
}

fn sent(report: &Report) -> Vec<u8> {
    rmp_serde::to_vec_named(report).expect("it can be written")
}

fn refusal(json: &str) -> String {
    let value = Value::read_json(json.as_bytes()).expect("it is JSON");
    fitted(value, &schema(), Form::Json).expect_err("it does not fit").to_string()
}

#[test]
fn json_becomes_the_bytes_that_a_program_sends() {
    let bytes = sent(&report());
    let json = Value::read(&bytes).expect("a payload").json();
    let value = Value::read_json(json.as_bytes()).expect("JSON");
    assert_eq!(fitted(value, &schema(), Form::Json).expect("it fits").written(), bytes);
}

#[test]
fn numbers_of_other_widths_are_converted() {
    let json = r#"{"count":7.0,"offset":-3,"big":0,"joints":[{"name":"hip","limits":[0,1]}],"step":{"Metres":2},
        "by_number":{}}"#;
    let value = Value::read_json(json.as_bytes()).expect("JSON");
    let bytes = fitted(value, &schema(), Form::Json).expect("it fits").written();
    let read: Report = rmp_serde::from_slice(&bytes).expect("a report");
    assert_eq!((read.count, read.step, read.joints[0].limits), (7, Step::Metres(2.0), (0.0, 1.0)));
}

#[test]
fn value_of_another_structure_is_refused_with_its_field() {
    let good = Value::read(&sent(&report())).expect("a payload").json();
    let faults = [
        (good.replace("\"count\":7", "\"count\":70000"), "field `count`: 70000 is no u16"),
        (good.replace("\"count\":7", "\"count\":7.5"), "field `count`: 7.5 is no u16"),
        (good.replace("\"count\":7,", ""), "field `count`: it is missing"),
        (good.replace("\"count\"", "\"counts\""), "field `counts`: its type has no such field"),
        (good.replace("[-0.1,1.5]", "[-0.1]"), "field `joints.0.limits`: expected 2 elements, found 1"),
        (good.replace("[-0.1,", "[true,"), "field `joints.0.limits.0`: expected f32, found a truth"),
        (good.replace("\"Turn\"", "\"Jump\""), "field `step.Jump`: its type has no such variant"),
        (good.replace("\"3\":true", "\"300\":true"), "field `by_number.300`: 300 is no u8"),
    ];
    for (json, why) in faults {
        assert_eq!(refusal(&json), why, "{json}");
    }
}

#[test]
fn forms_of_json_alone_are_refused_in_messagepack() {
    let schema = |root| Schema { root, types: BTreeMap::new() };
    let not_a_number = Value::Text("NaN".to_owned());
    assert!(fitted(not_a_number.clone(), &schema(Shape::F64), Form::MessagePack).is_err());
    let fits = fitted(not_a_number, &schema(Shape::F64), Form::Json);
    assert!(matches!(fits, Ok(Value::F64(number)) if number.is_nan()));
    let bytes = Value::read_json(br#"{"bytes":"0a0b"}"#).expect("JSON");
    assert_eq!(fitted(bytes.clone(), &schema(Shape::Bytes), Form::Json), Ok(Value::Bytes(vec![10, 11])));
    assert!(fitted(bytes, &schema(Shape::Bytes), Form::MessagePack).is_err());
}

fn reports() -> impl Strategy<Value = Report> {
    let joint = (".{0,8}", -1e9_f32..1e9, -1e9_f32..1e9)
        .prop_map(|(name, low, high)| Joint { name, limits: (low, high) });
    let step = prop_oneof![
        Just(Step::Stand),
        (-1e200_f64..1e200).prop_map(Step::Metres),
        (-1e9_f32..1e9, any::<char>()).prop_map(|(degrees, mark)| Step::Turn { degrees, mark }),
    ];
    let numbers = (any::<u16>(), any::<i8>(), any::<u64>());
    let by_number = proptest::collection::btree_map(any::<u8>(), any::<bool>(), 0..4);
    let joints = proptest::collection::vec(joint, 0..3);
    (numbers, proptest::option::of(".{0,8}"), joints, step, by_number).prop_map(
        |((count, offset, big), note, joints, step, by_number)| Report {
            count,
            offset,
            big,
            note,
            joints,
            step,
            by_number,
        },
    )
}

proptest! {
    #[test]
    fn each_report_passes_json_unchanged(report in reports()) {
        let bytes = sent(&report);
        let json = Value::read(&bytes).expect("a payload").json();
        let value = Value::read_json(json.as_bytes()).expect("JSON");
        let passed = fitted(value, &schema(), Form::Json).expect("it fits").written();
        // JSON has its keys in another order, and so has the map.
        prop_assert_eq!(rmp_serde::from_slice::<Report>(&passed).expect("a report"), report);
        let again = Value::read(&bytes).expect("a payload");
        prop_assert_eq!(fitted(again, &schema(), Form::MessagePack).expect("it fits").written(), bytes);
    }

    #[test]
    fn what_fits_is_read_by_a_program(value in values()) {
        for form in [Form::Json, Form::MessagePack] {
            if let Ok(fits) = fitted(value.clone(), &schema(), form) {
                prop_assert!(rmp_serde::from_slice::<Report>(&fits.written()).is_ok());
            }
        }
    }
}
