//! The reference of all keys of a robot file, generated from the rows that the reader uses.
//!
//! `UPDATE=1 cargo test -p sinew-cli --bins -- up::robot::reference` writes the tables of
//! `docs/book/src/reference/robot.md` and the JSON Schema `robot.schema.json` beside it. Without `UPDATE` the tests
//! compare them.

use std::fmt::Write as _;

use serde_json::{Map, Value, json};
use sinew_testkit::reference::{GeneratedFile, check_cells};

use super::{
    rows::{HOSTS_MAX, Kind, NODES_MAX, ROWS, Row, TEXT_BYTES_MAX, Table},
    *,
};

const COMMAND: &str = "UPDATE=1 cargo test -p sinew-cli --bins -- up::robot::reference";

fn heading(table: Table) -> &'static str {
    match table {
        Table::Robot => "`[robot]`: The robot",
        Table::Host => "`[host.NAME]`: A host",
        Table::Node => "`[node.NAME]`: A node",
    }
}

fn rows(table: Table) -> impl Iterator<Item = &'static Row> {
    ROWS.iter().filter(move |row| row.table == table)
}

impl Kind {
    fn name(self) -> &'static str {
        match self {
            Self::Name | Self::Text(_) => "text",
            Self::Truth => "boolean",
            Self::Number(_, _, "ms") => "integer, ms",
            Self::Number(..) => "integer",
            Self::Texts(_) | Self::Names(_) => "list of texts",
            Self::Numbers(..) => "list of integers",
            Self::Variables(_) => "table of texts",
        }
    }

    fn schema(self) -> Value {
        let text = |max: usize| json!({ "type": "string", "minLength": 1, "maxLength": max });
        let list = |max: usize, item: Value| json!({ "type": "array", "maxItems": max, "items": item });
        let number = |low: i64, high: i64| json!({ "type": "integer", "minimum": low, "maximum": high });
        match self {
            Self::Name => text(63),
            Self::Text(max) => text(max),
            Self::Truth => json!({ "type": "boolean" }),
            Self::Number(low, high, _) => number(low, high),
            Self::Texts(max) => list(max, text(TEXT_BYTES_MAX)),
            Self::Names(max) => list(max, text(63)),
            Self::Numbers(max, low, high) => list(max, number(low, high)),
            Self::Variables(max) => json!({
                "type": "object", "maxProperties": max,
                "additionalProperties": { "type": "string", "maxLength": TEXT_BYTES_MAX },
            }),
        }
    }
}

/// Returns the tables, one per table of the file.
fn tables() -> String {
    let mut page = String::new();
    for table in Table::ALL {
        let _ = write!(
            page,
            "\n### {}\n\n| key | type | default | range | effect | cost, or note |\n\
             | --- | --- | --- | --- | --- | --- |\n",
            heading(table)
        );
        for Row { key, kind, default, effect, note, .. } in rows(table) {
            let default = if default.is_empty() { "none: required" } else { default };
            let (name, legal) = (kind.name(), kind.legal());
            let _ = writeln!(page, "| `{key}` | {name} | {default} | {legal} | {effect} | {note} |");
        }
    }
    page.push('\n');
    page
}

/// Returns the JSON Schema of a robot file.
pub(super) fn schema() -> Value {
    let of = |table: Table| {
        let mut keys = Map::new();
        for row in rows(table) {
            let mut schema = row.kind.schema();
            let description = [row.effect, row.note].join(" ").replace('`', "");
            schema["description"] = description.trim_end().into();
            keys.insert(row.key.to_owned(), schema);
        }
        json!({
            "type": "object", "description": heading(table).replace('`', ""), "properties": keys,
            "additionalProperties": false,
        })
    };
    let named = |table: Table, max: usize| json!({ "type": "object", "maxProperties": max, "additionalProperties": of(table) });
    let mut robot = of(Table::Robot);
    robot["required"] = json!(["name"]);
    let mut nodes = named(Table::Node, NODES_MAX);
    nodes["minProperties"] = 1.into();
    nodes["additionalProperties"]["oneOf"] =
        json!([{ "required": ["program"] }, { "required": ["installed"] }]);
    json!({
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "Robot file of sinew up",
        "description": "Every legal file fits this schema. The command checks more than a schema can say, and names every fault before it changes anything.",
        "type": "object",
        "properties": { "robot": robot, "host": named(Table::Host, HOSTS_MAX), "node": nodes },
        "required": ["robot", "node"],
        "additionalProperties": false,
    })
}

fn file(name: &str) -> GeneratedFile {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/book/src/reference");
    GeneratedFile::new(folder.join(name), COMMAND)
}

#[test]
fn page_has_the_tables_of_the_code() {
    file("robot.md").check_part(&tables());
}

#[test]
fn schema_has_the_keys_of_the_code() {
    let expected = schema();
    // The order of keys is that of serde_json, which a feature of it changes.
    let is_equal = |written: &str| serde_json::from_str::<Value>(written).expect("it is JSON") == expected;
    file("robot.schema.json").check_by(&format!("{expected:#}\n"), is_equal);
}

#[test]
fn complete_file_of_the_page_is_legal() {
    let page = file("robot.md").read();
    let (_, rest) = page.split_once("```toml\n").expect("the page has a file");
    let (file, _) = rest.split_once("```").expect("the file ends");
    Robot::from_toml(file, Path::new("/robot")).unwrap_or_else(|faults| panic!("{faults}\n{file}"));
    for row in ROWS {
        let is_shown =
            file.lines().any(|line| line.trim_start_matches("# ").starts_with(&format!("{} =", row.key)));
        assert!(is_shown, "{} is missing in the file", row.key);
    }
}

#[test]
fn file_of_the_example_robot_is_legal() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/exoskeleton/robot.toml");
    let robot = Robot::from_file(&path).unwrap_or_else(|faults| panic!("{faults}"));
    assert_eq!(robot.nodes.len(), 5);
    assert!(robot.nodes["plant"].socket.is_none(), "the plant is no node");
}

#[test]
fn every_cell_is_a_short_sentence() {
    for row in ROWS {
        check_cells(row.key, row.effect, row.note);
    }
}

#[test]
fn every_key_reads_its_own_example() {
    for row in ROWS {
        let (table, example) = (row.table.name(), row.kind.example());
        let name = if row.table == Table::Robot { "[robot]".to_owned() } else { format!("[{table}.knee]") };
        let text = format!("{name}\n{} = {example}\n", row.key);
        let read = Robot::from_toml(&text, Path::new("/robot")).expect_err("a robot needs more than one key");
        let own = format!(".{}", row.key);
        // Its value may have to be an absolute path, or the name of another table.
        let fits_alone = ["folder", "installed", "host", "after", "program"];
        let is_own = read.faults().iter().any(|fault| fault.key.ends_with(&own));
        assert!(!is_own || fits_alone.contains(&row.key), "{read}");
    }
}
