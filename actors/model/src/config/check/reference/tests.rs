//! Whether the reference is that of the code.

use sinew_testkit::reference::{GeneratedFile, check_cells};

use super::*;
use crate::config::file::{COMMAND_KEYS, KEYS};

const TO_UPDATE: &str = "UPDATE=1 cargo test --workspace --lib -- config::check::reference";

fn file(name: &str) -> GeneratedFile {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/book/src/reference");
    GeneratedFile::new(folder.join(name), TO_UPDATE)
}

/// A file with `value` for `key`, and with neighbours that allow every legal value.
fn file_with(key: &str, value: &Value) -> String {
    let (section, leaf) = key.split_once('.').unwrap();
    if section == COMMAND {
        let others =
            [("name", "'knee'"), ("run", "['knee']"), ("backoff_max_ms", "600000"), ("backoff_min_ms", "1")];
        let others = others.iter().filter(|(other, _)| *other != leaf);
        let others: String = others.map(|(other, value)| format!("{other} = {value}\n")).collect();
        return format!("[node]\nname = 'k'\n[lncl]\nsocket = '/k'\n[[command]]\n{others}{leaf} = {value}\n");
    }
    let name = if key == "node.name" { "" } else { "name = 'knee'\n" };
    let neighbour = match key {
        "gncl.redial_min_ms" => "redial_max_ms = 60000\n",
        "gncl.redial_max_ms" => "redial_min_ms = 1\n",
        "record.keep_ms" => "after_ms = 1000\n",
        "record.after_ms" => "keep_ms = 600000\n",
        _ => "",
    };
    let section = if section == "node" { String::new() } else { format!("[{section}]\n") };
    format!("[node]\n{name}{section}{leaf} = {value}\n{neighbour}")
}

/// Values of a key that are legal, and none that is so by chance.
fn legal(kind: &Kind) -> Vec<Value> {
    match kind {
        Kind::Number(range) => vec![range.low.into(), range.high.into()],
        Kind::NumberOrFalse(range) => vec![range.low.into(), range.high.into(), false.into()],
        Kind::Truth => vec![true.into(), false.into()],
        Kind::OneOf(texts) => texts.iter().map(|text| json!(text)).collect(),
        Kind::PathOrFalse(bytes) => vec![json!("k".repeat(*bytes)), false.into()],
        Kind::Name => vec![json!("n".repeat(NAME_BYTES_MAX))],
        Kind::NodeAddress => vec![json!("10.0.0.7")],
        Kind::EndpointOrFalse { pattern, .. } if *pattern == IPV6_PORT => {
            vec![json!("[ff02::77]:7"), false.into()]
        }
        Kind::EndpointOrFalse { .. } => vec![false.into()],
        Kind::Interfaces => vec![json!("10.0.0.7"), json!(["10.0.0.7", "eth0/ipv6"])],
        Kind::Addresses(_) => vec![json!(["10.0.0.7", "10.0.0.8"])],
        Kind::Seeds(_) => vec![json!(["10.0.0.7:7", "[fe80::7%eth0]:7"])],
        // TOML encodes tables differently than JSON.
        Kind::Names(_) => vec![json!([]), json!(["leg.*", "knee"])],
        Kind::Watch => vec![json!([])],
        Kind::Words(_) => vec![json!(["python3"]), json!(["python3", "knee.py", ""])],
    }
}

#[test]
fn every_key_that_the_reader_accepts_has_a_row() {
    assert_eq!(
        ROWS.iter().map(|row| row.key).collect::<Vec<_>>(),
        KEYS,
        "rows of check/reference/rows.rs, and keys"
    );
    assert_eq!(COMMAND_ROWS.iter().map(|row| row.key).collect::<Vec<_>>(), COMMAND_KEYS);
    let sections: Vec<_> = SECTIONS.iter().map(|(section, _)| *section).collect();
    assert!(ROWS.iter().all(|row| sections.contains(&row.section())));
}

#[test]
fn every_row_is_about_the_setting_of_its_key() {
    for row in ROWS.iter().chain(COMMAND_ROWS) {
        for value in legal(&row.kind) {
            let text = file_with(row.key, &value);
            let config = NodeConfig::from_toml(&text).unwrap_or_else(|faults| panic!("{faults}\n{text}"));
            assert_eq!((row.value)(&config), value, "{}", row.key);
        }
        if let Kind::Number(range) | Kind::NumberOrFalse(range) = &row.kind {
            assert_eq!(range.key, row.key);
        }
    }
}

#[test]
fn choices_match_the_reader() {
    for row in ROWS.iter().chain(COMMAND_ROWS) {
        let Kind::OneOf(texts) = &row.kind else { continue };
        let faults = NodeConfig::from_toml(&file_with(row.key, &json!("none of them"))).unwrap_err();
        let named: Vec<_> = faults.faults()[0].legal.split('"').skip(1).step_by(2).collect();
        assert_eq!(named, *texts, "{}", row.key);
    }
}

#[test]
fn every_cell_is_a_short_sentence() {
    for row in ROWS.iter().chain(COMMAND_ROWS) {
        check_cells(row.key, row.effect, row.note);
    }
}

#[test]
fn the_page_has_the_tables_of_the_code() {
    file("configuration.md").check_part(&tables());
}

#[test]
fn the_complete_file_has_the_keys_of_the_code() {
    file("node.toml").check(&complete_file());
}

#[test]
fn the_schema_has_the_keys_of_the_code() {
    let expected = schema();
    // The order of keys is that of serde_json, which a feature of it changes.
    let is_equal = |written: &str| serde_json::from_str::<Value>(written).expect("it is JSON") == expected;
    file("node.schema.json").check_by(&format!("{expected:#}\n"), is_equal);
}
