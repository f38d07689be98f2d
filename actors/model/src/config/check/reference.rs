//! The reference of all keys, generated from the ranges that the checks use and from the defaults of
//! [`NodeConfig::new`].
//!
//! `UPDATE=1 cargo test --workspace --lib -- config::check::reference` writes the table of
//! `docs/book/src/reference/configuration.md`, the complete file `node.toml` and the JSON Schema
//! `node.schema.json` beside it. Without `UPDATE` the test compares them.

mod commands;
mod rows;
mod tests;

use std::fmt::Write as _;

use commands::COMMAND_ROWS;
use rows::ROWS;
use serde_json::{Map, Value, json};

use super::*;
use crate::config::command::COMMANDS_MAX;

/// One key of a node's file.
struct Row {
    /// Its name: `section.key`.
    key: &'static str,
    /// Its type and its legal values.
    kind: Kind,
    /// Its value in a configuration, as JSON; `null` if there is none.
    value: fn(&NodeConfig) -> Value,
    /// Its effect, in one sentence.
    effect: &'static str,
    /// Its cost, or a note, in one more sentence; empty if there is none.
    note: &'static str,
}

/// The type of a key, with its legal values.
enum Kind {
    Number(Range),
    NumberOrFalse(Range),
    Truth,
    /// One of these texts.
    OneOf(&'static [&'static str]),
    /// The path of a file or a directory of at most this many bytes, or `false`.
    PathOrFalse(usize),
    /// A name of a node or a project.
    Name,
    /// An address of a node.
    NodeAddress,
    /// An address and a port, as in the example, or `false`.
    EndpointOrFalse {
        legal: &'static str,
        pattern: &'static str,
    },
    /// Interfaces, one or several.
    Interfaces,
    /// At most this many IPv4 addresses.
    Addresses(usize),
    /// At most this many addresses with ports.
    Seeds(usize),
    /// At most this many names, in which `*` matches any text.
    Names(usize),
    /// Groups of nodes.
    Watch,
    /// A program and its arguments, at most this many texts.
    Words(usize),
}

/// Sections, in the order of the file, with a heading.
const SECTIONS: [(&str, &str); 13] = [
    ("node", "The node"),
    ("lncl", "Applications of this host"),
    ("gncl", "Connections between nodes"),
    ("ndl", "Discovery and liveness"),
    ("sync", "Start-up"),
    ("supervision", "Restarts"),
    ("security", "Keys and the access list"),
    ("log", "The default log"),
    ("record", "The recording"),
    ("rt", "The proof of real time"),
    ("stop", "The stop of the whole system"),
    ("contracts", "Contracts of applications"),
    (COMMAND, "A program that the node supervises"),
];

/// The section that a file may have several times.
const COMMAND: &str = "command";
/// Longest line of the complete file.
const LINE_MAX: usize = 100;
/// Four numbers with dots between them.
const IPV4: &str = r"^[0-9]{1,3}(\.[0-9]{1,3}){3}$";
const IPV4_PORT: &str = r"^[0-9]{1,3}(\.[0-9]{1,3}){3}:[0-9]{1,5}$";
const IPV6_PORT: &str = r"^\[[0-9A-Fa-f:.]+(%[0-9]+)?\]:[0-9]{1,5}$";
const SEED: &str = r"^([0-9.]+|\[[0-9A-Fa-f:.]+(%[^%/]+)?\]):[0-9]{1,5}$";

impl Row {
    fn section(&self) -> &'static str {
        self.key.split_once('.').expect("a section and a key").0
    }

    fn leaf(&self) -> &'static str {
        self.key.split_once('.').expect("a section and a key").1
    }

    /// Returns its default, or `None` for the two without a value of their own.
    fn default(&self) -> Option<Value> {
        let value = (self.value)(&NodeConfig::new(""));
        (!value.is_null() && value != "").then_some(value)
    }

    /// Returns its default as text.
    fn default_shown(&self) -> String {
        match (self.default(), self.key) {
            (Some(value), _) => format!("`{value}`"),
            (None, "node.address") => "the first address in `ndl.interface`".to_owned(),
            (None, _) => "none: required".to_owned(),
        }
    }
}

impl Kind {
    fn name(&self) -> &'static str {
        match self {
            Self::Number(range) if range.unit == "ms" => "integer, ms",
            Self::Number(_) => "integer",
            Self::NumberOrFalse(_) => "integer, or `false`",
            Self::Truth => "boolean",
            Self::OneOf(_) | Self::Name | Self::NodeAddress => "text",
            Self::PathOrFalse(_) | Self::EndpointOrFalse { .. } => "text, or `false`",
            Self::Interfaces => "text, or list of texts",
            Self::Addresses(_) | Self::Seeds(_) | Self::Names(_) | Self::Words(_) => "list of texts",
            Self::Watch => "list of tables",
        }
    }

    fn range(&self) -> String {
        match self {
            Self::Number(Range { low, high, unit, .. }) => format!("{low} to {high} {unit}"),
            Self::NumberOrFalse(Range { low, high, .. }) => format!("{low} to {high}, or `false`"),
            Self::Truth => "`true` or `false`".to_owned(),
            Self::OneOf(texts) => {
                texts.iter().map(|text| format!("`\"{text}\"`")).collect::<Vec<_>>().join(", ")
            }
            Self::PathOrFalse(bytes) => format!("a path of 1 to {bytes} bytes, or `false`"),
            Self::Name => format!("1 to {NAME_BYTES_MAX} bytes"),
            Self::NodeAddress => "an IPv4 address of one node".to_owned(),
            Self::EndpointOrFalse { legal, .. } => format!("{legal}, or `false`"),
            Self::Interfaces => format!("1 to {PATHS_MAX}, each once"),
            Self::Addresses(max) => format!("at most {max} IPv4 addresses"),
            Self::Seeds(max) => format!("at most {max}, each `address:port`"),
            Self::Names(max) => format!("at most {max} names of 1 to {RECORDED_BYTES_MAX} bytes"),
            Self::Watch => format!("at most {WATCH_MAX} groups of 1 to {WATCHED_NAMES_MAX} names"),
            Self::Words(max) => format!("1 to {max} texts"),
        }
    }

    fn schema(&self) -> Value {
        let number =
            |range: &Range| json!({ "type": "integer", "minimum": range.low, "maximum": range.high });
        let texts = |max: usize, item: Value| json!({ "type": "array", "maxItems": max, "items": item });
        match self {
            Self::Number(range) => number(range),
            Self::NumberOrFalse(range) => or_false(&number(range)),
            Self::Truth => json!({ "type": "boolean" }),
            Self::OneOf(texts) => json!({ "enum": texts }),
            Self::PathOrFalse(bytes) => or_false(&text(*bytes)),
            Self::Name => text(NAME_BYTES_MAX),
            Self::NodeAddress => json!({ "type": "string", "pattern": IPV4 }),
            Self::EndpointOrFalse { pattern, .. } => {
                or_false(&json!({ "type": "string", "pattern": pattern }))
            }
            Self::Interfaces => {
                let one = json!({ "type": "string", "minLength": 1 });
                let mut several = texts(PATHS_MAX, one.clone());
                several["minItems"] = 1.into();
                several["uniqueItems"] = true.into();
                json!({ "anyOf": [one, several] })
            }
            Self::Addresses(max) => {
                let mut addresses = texts(*max, json!({ "type": "string", "pattern": IPV4 }));
                addresses["uniqueItems"] = true.into();
                addresses
            }
            Self::Seeds(max) => texts(*max, json!({ "type": "string", "pattern": SEED })),
            Self::Names(max) => texts(*max, text(RECORDED_BYTES_MAX)),
            Self::Words(max) => {
                let mut words = texts(*max, json!({ "type": "string" }));
                words["minItems"] = 1.into();
                words
            }
            Self::Watch => {
                let mut names = texts(WATCHED_NAMES_MAX, text(NAME_BYTES_MAX));
                names["minItems"] = 1.into();
                let group = json!({
                    "type": "object",
                    "properties": { "nodes": names, "period_ms": number(&PERIOD), "missed_max": number(&MISSED_MAX) },
                    "required": ["nodes", "period_ms", "missed_max"],
                    "additionalProperties": false,
                });
                texts(WATCH_MAX, group)
            }
        }
    }
}

/// Returns the schema of a text of at least one byte. The schema counts characters, of which there are no
/// more than bytes.
fn text(bytes_max: usize) -> Value {
    json!({ "type": "string", "minLength": 1, "maxLength": bytes_max })
}

fn or_false(schema: &Value) -> Value {
    json!({ "anyOf": [schema, { "const": false }] })
}

/// Returns the rows of a section.
fn rows_of(section: &str) -> impl Iterator<Item = &'static Row> {
    ROWS.iter().chain(COMMAND_ROWS).filter(move |row| row.section() == section)
}

/// Returns the heading of a section in a file.
fn header(section: &str) -> String {
    if section == COMMAND { format!("[[{section}]]") } else { format!("[{section}]") }
}

/// Returns the tables, one per section.
fn tables() -> String {
    let mut page = String::new();
    for (section, heading) in SECTIONS {
        let _ = write!(
            page,
            "\n### `{}`: {heading}\n\n| key | type | default | range | effect | cost, or note |\n\
             | --- | --- | --- | --- | --- | --- |\n",
            header(section)
        );
        for row in rows_of(section) {
            let Row { kind, effect, note, .. } = row;
            let (leaf, default) = (row.leaf(), row.default_shown());
            let _ = writeln!(
                page,
                "| `{leaf}` | {} | {default} | {} | {effect} | {note} |",
                kind.name(),
                kind.range()
            );
        }
    }
    page.push('\n');
    page
}

/// Returns the complete file, each key with its default.
fn complete_file() -> String {
    let mut file =
        "# Every key of a node's file, with its default. Only node.name has to be set.\n".to_owned();
    for (section, _) in SECTIONS {
        // A file has no command by default, so that its keys are comments.
        let off = if section == COMMAND { "# " } else { "" };
        let _ = write!(file, "\n{off}{}\n", header(section));
        for row in rows_of(section) {
            for line in [row.effect, &format!("Legal: {}.", row.kind.range())].into_iter().flat_map(wrapped) {
                let _ = writeln!(file, "# {line}");
            }
            let _ = match (row.default(), row.key) {
                (Some(value), _) => writeln!(file, "{off}{} = {value}", row.leaf()),
                (None, "command.name") => writeln!(file, "# name = \"knee.drive\""),
                (None, "command.run") => writeln!(file, "# run = [\"python3\", \"knee.py\"]"),
                (None, "node.address") => writeln!(file, "# address = \"127.0.0.2\""),
                (None, _) => writeln!(file, "{} = \"knee\"", row.leaf()),
            };
        }
    }
    file
}

/// Returns `text` in lines that fit a comment of the complete file.
fn wrapped(text: &str) -> Vec<String> {
    let mut lines = vec![String::new()];
    for word in text.replace('`', "").split_whitespace() {
        let line = lines.last_mut().expect("there is one");
        if line.is_empty() {
            line.push_str(word);
        } else if line.len() + 1 + word.len() <= LINE_MAX - 2 {
            line.push(' ');
            line.push_str(word);
        } else {
            lines.push(word.to_owned());
        }
    }
    lines
}

/// Returns the JSON Schema of a node's file.
fn schema() -> Value {
    let mut sections = Map::new();
    for (section, heading) in SECTIONS {
        let mut keys = Map::new();
        for row in rows_of(section) {
            let mut schema = row.kind.schema();
            let description = [row.effect, row.note].join(" ").replace('`', "");
            schema["description"] = description.trim_end().into();
            if let Some(default) = row.default() {
                schema["default"] = default;
            }
            keys.insert(row.leaf().to_owned(), schema);
        }
        let mut table = json!({ "type": "object", "description": heading, "properties": keys, "additionalProperties": false });
        if section == "node" {
            table["required"] = json!(["name"]);
        }
        if section == COMMAND {
            table["required"] = json!(["name", "run"]);
            table = json!({ "type": "array", "maxItems": COMMANDS_MAX, "items": table });
        }
        sections.insert(section.to_owned(), table);
    }
    let settings = json!({
        "type": "object",
        "description": "Settings of applications, one table for each: the application's own type says which keys there are.",
        "additionalProperties": { "type": "object" },
    });
    sections.insert("app".to_owned(), settings);
    json!({
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "Configuration of a Sinew node",
        "description": "Every legal file fits this schema. The node checks more than a schema can say, and names every fault at its start.",
        "type": "object",
        "properties": sections,
        "required": ["node"],
        "additionalProperties": false,
    })
}
