//! The JSON Schema of robot files accepts the same files as the reader, key by key.

use serde_json::{Value, json};

use super::{
    reference::schema,
    rows::{Kind, ROWS, Row, TEXT_BYTES_MAX, Table},
    *,
};

/// Returns whether a value fits a schema, by the keywords that ours have. Another keyword is a fault of this test.
fn fits(schema: &Value, value: &Value) -> bool {
    let keywords = schema.as_object().expect("a schema is an object");
    keywords.iter().all(|(keyword, limit)| {
        let most = |count: Option<usize>| count.is_none_or(|count| Some(count as u64) <= limit.as_u64());
        let least = |count: Option<usize>| count.is_none_or(|count| Some(count as u64) >= limit.as_u64());
        let length = || value.as_str().map(|text| text.chars().count());
        let size = || value.as_object().map(serde_json::Map::len);
        match keyword.as_str() {
            "$schema" | "title" | "description" => true,
            "type" => is_of(limit.as_str().expect("the name of a type"), value),
            "minimum" => value.as_i64() >= limit.as_i64(),
            "maximum" => value.as_i64() <= limit.as_i64(),
            "minLength" => least(length()),
            "maxLength" => most(length()),
            "maxItems" => most(value.as_array().map(Vec::len)),
            "minProperties" => least(size()),
            "maxProperties" => most(size()),
            "items" => value.as_array().is_none_or(|items| items.iter().all(|item| fits(limit, item))),
            "required" => limit
                .as_array()
                .expect("a list")
                .iter()
                .all(|key| value.get(key.as_str().expect("the name of a key")).is_some()),
            "oneOf" => limit.as_array().expect("a list").iter().filter(|one| fits(one, value)).count() == 1,
            "properties" => {
                members(value).all(|(key, inner)| limit.get(key).is_none_or(|one| fits(one, inner)))
            }
            "additionalProperties" => {
                let others = members(value).filter(|(key, _)| schema["properties"].get(key).is_none());
                let mut others =
                    others.map(|(_, inner)| limit.as_bool().unwrap_or_else(|| fits(limit, inner)));
                others.all(|is_fine| is_fine)
            }
            other => panic!("the schema has the keyword {other}, which this test does not know"),
        }
    })
}

fn members(value: &Value) -> impl Iterator<Item = (&String, &Value)> {
    value.as_object().into_iter().flatten()
}

fn is_of(name: &str, value: &Value) -> bool {
    match name {
        "object" => value.is_object(),
        "array" => value.is_array(),
        "string" => value.is_string(),
        "integer" => value.is_i64(),
        "boolean" => value.is_boolean(),
        other => panic!("the schema has the type {other}, which this test does not know"),
    }
}

/// Returns values at both ends of what a kind allows, and one beyond each, with whether they are legal.
fn samples(kind: Kind) -> Vec<(Value, bool)> {
    let text = |bytes: usize| json!("a".repeat(bytes));
    let list = |count: usize, item: Value| Value::from(vec![item; count]);
    match kind {
        Kind::Name => vec![(text(1), true), (text(63), true), (text(64), false), (json!(7), false)],
        Kind::Text(max) => {
            vec![
                (text(1), true),
                (text(max), true),
                (text(max + 1), false),
                (text(0), false),
                (json!(true), false),
            ]
        }
        Kind::Truth => vec![(json!(true), true), (json!(false), true), (json!("true"), false)],
        Kind::Number(low, high, _) => vec![
            (json!(low), true),
            (json!(high), true),
            (json!(low - 1), false),
            (json!(high + 1), false),
            (json!("1"), false),
        ],
        Kind::Texts(max) => vec![
            (list(max, json!("a")), true),
            (list(max + 1, json!("a")), false),
            (list(1, text(TEXT_BYTES_MAX + 1)), false),
            (list(1, json!("")), false),
            (json!("a"), false),
        ],
        Kind::Names(max) => vec![
            (list(max, json!("knee")), true),
            (list(max + 1, json!("knee")), false),
            (list(1, text(64)), false),
            (json!("knee"), false),
        ],
        Kind::Numbers(max, low, high) => vec![
            (list(1, json!(low)), true),
            (list(max, json!(high)), true),
            (list(max + 1, json!(high)), false),
            (list(1, json!(high + 1)), false),
            (list(1, json!(low - 1)), false),
        ],
        Kind::Variables(max) => {
            let variables =
                |count: usize| (0..count).map(|number| (format!("V{number}"), json!("a"))).collect();
            vec![
                (Value::Object(variables(max)), true),
                (Value::Object(variables(max + 1)), false),
                (json!({ "V": 1 }), false),
                (json!("V=1"), false),
            ]
        }
    }
}

/// Returns the smallest robot, with one more key.
fn file_with(row: &Row, value: Value) -> Value {
    let mut file = json!({
        "robot": { "name": "leg" }, "host": { "hip": { "ssh": "hip" } }, "node": { "knee": { "installed": "/knee" } },
    });
    let table = match row.table {
        Table::Robot => &mut file["robot"],
        Table::Host => &mut file["host"]["hip"],
        Table::Node => &mut file["node"]["knee"],
    };
    if row.key == "program" {
        // A node has one program.
        *table = json!({});
    }
    table[row.key] = value;
    file
}

fn read(file: &Value) -> Result<Robot, ConfigError> {
    let text = toml::to_string(file).expect("it has no null");
    Robot::from_toml(&text, Path::new("/robot"))
}

#[test]
fn schema_and_reader_agree_on_each_key() {
    let schema = schema();
    for row in ROWS {
        for (value, is_legal) in samples(row.kind) {
            let file = file_with(row, value);
            assert_eq!(fits(&schema, &file), is_legal, "the schema, {}: {file}", row.key);
            // Another fault may be about names that no other table has, or about a relative path.
            let legal = row.kind.legal();
            let is_refused = read(&file).is_err_and(|faults| {
                let mut all = faults.faults().iter();
                all.any(|fault| fault.key.ends_with(&format!(".{}", row.key)) && fault.legal == legal)
            });
            assert_eq!(is_refused, !is_legal, "the reader, {}: {file}", row.key);
        }
    }
}

#[test]
fn schema_and_reader_refuse_the_same_tables() {
    let schema = schema();
    let (robot, node) = (json!({ "name": "leg" }), json!({ "knee": { "installed": "/knee" } }));
    for (file, is_legal) in [
        (json!({ "robot": robot, "node": node }), true),
        (json!({ "node": node }), false),
        (json!({ "robot": robot }), false),
        (json!({ "robot": robot, "node": {} }), false),
        (json!({ "robot": {}, "node": node }), false),
        (json!({ "robot": robot, "node": node, "nodes": node }), false),
        (json!({ "robot": robot, "node": { "knee": {} } }), false),
        (json!({ "robot": robot, "node": { "knee": { "installed": "/knee", "program": "knee" } } }), false),
        (json!({ "robot": robot, "node": { "knee": { "installed": "/knee", "instaled": "/knee" } } }), false),
        (json!({ "robot": robot, "node": node, "host": { "hip": { "ssh": "hip", "shh": "hip" } } }), false),
    ] {
        assert_eq!(fits(&schema, &file), is_legal, "the schema: {file}");
        assert_eq!(read(&file).is_ok(), is_legal, "the reader: {file}");
    }
}

#[test]
fn file_of_the_example_robot_fits_the_schema() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/exoskeleton/robot.toml");
    let text = std::fs::read_to_string(path).expect("the file is there");
    let file: Value = toml::from_str(&text).expect("it is TOML");
    assert!(fits(&schema(), &file), "{file}");
}
