//! `sinew param save` and `load`: a TOML file with a table for each application.

use std::{
    fs,
    io::{Read as _, Write as _},
    path::Path,
};

use serde_json::json;
use sinew::parameters::{NamedValue, SetParameters, Value};
use toml::{Table, Value as Toml};

use super::{SetResult, list, targets};
use crate::{
    Report,
    system::{System, SystemError},
    table::clean,
};

/// Maximum size of a file in bytes. The parameters of a hundred applications have a tenth of it.
const FILE_BYTES_MAX: u64 = 1 << 20;
/// The first line of a file.
const HEAD: &str = "# Values of parameters, a table for each application. `sinew param load` sets them.\n\n";

/// Writes the values of these applications, or of all, to a file. A value that moves is written as its target.
pub(super) fn save(system: &mut System, path: &Path, apps: &[String]) -> Result<Report, SystemError> {
    let (listed, silent) = if apps.is_empty() {
        list::all(system)?
    } else {
        let listed: Result<Vec<_>, _> = apps.iter().map(|app| list::one(system, app)).collect();
        (listed?, Vec::new())
    };
    let mut file = Table::new();
    let mut faults = silent;
    for list::Listed { app, result, .. } in &listed {
        match result {
            Ok(list) => {
                file.insert(app.clone(), Toml::Table(table_of(targets(list))));
            }
            Err(why) => faults.push(format!("{}: {}", clean(app), clean(why))),
        }
    }
    if !faults.is_empty() {
        let faults = faults.join("\n");
        return Err(SystemError::Unknown(format!(
            "nothing was written, as the values are not complete:\n{faults}"
        )));
    }
    let text = format!("{HEAD}{file}");
    let shown = path.display().to_string();
    replace(path, &text).map_err(|error| {
        SystemError::Bag(format!("{shown} cannot be written: {error}; choose a folder that you may write to"))
    })?;
    let count = file.len();
    let text = format!("the parameters of {count} applications are in {}\n", clean(&shown));
    Ok(Report {
        text,
        json: json!({ "file": shown, "apps": file.keys().collect::<Vec<_>>() }),
        is_fine: true,
    })
}

/// Sets the values of a file: one set for each application.
pub(super) fn load(system: &mut System, path: &Path) -> Result<Report, SystemError> {
    let sets = read(path)?;
    // Each is found before the first one is set.
    for (app, _) in &sets {
        system.find(app)?;
    }
    let (mut text, mut results, mut is_fine) = (String::new(), Vec::new(), true);
    for (app, values) in sets {
        let result = SetResult::of(system, &app, &SetParameters::Values(values))?;
        text += &result.text();
        is_fine &= result.fault().is_none();
        results.push(result.json());
    }
    Ok(Report { text, json: json!({ "apps": results }), is_fine })
}

/// Replaces the file by one with this text: readers see the former one or the new one, never a part.
fn replace(path: &Path, text: &str) -> std::io::Result<()> {
    let mut name = path.file_name().unwrap_or_default().to_owned();
    name.push(format!(".{}.new", std::process::id()));
    let new = path.with_file_name(name);
    let written = fs::File::create(&new).and_then(|mut file| {
        file.write_all(text.as_bytes())?;
        file.sync_all()?;
        fs::rename(&new, path)
    });
    if written.is_err() {
        // The cause of the failure is reported; a remainder is a file of a few bytes.
        let _ = fs::remove_file(&new);
    }
    written
}

fn table_of(values: Vec<NamedValue>) -> Table {
    let toml = |value| match value {
        Value::Number(number) => Toml::Float(number),
        Value::Integer(integer) => Toml::Integer(integer),
        Value::Flag(flag) => Toml::Boolean(flag),
    };
    values.into_iter().map(|NamedValue { name, value }| (name, toml(value))).collect()
}

/// Reads the sets of a file.
fn read(path: &Path) -> Result<Vec<(String, Vec<NamedValue>)>, SystemError> {
    let shown = clean(&path.display().to_string());
    let mut text = String::new();
    let file = fs::File::open(path).and_then(|file| file.take(FILE_BYTES_MAX + 1).read_to_string(&mut text));
    file.map_err(|error| SystemError::Bag(format!("{shown} cannot be read: {error}")))?;
    if text.len() as u64 > FILE_BYTES_MAX {
        return Err(SystemError::Bag(format!("{shown} is longer than 1 MiB: split it")));
    }
    parse(&text).map_err(|why| SystemError::Bag(format!("{shown}: {why}")))
}

fn parse(text: &str) -> Result<Vec<(String, Vec<NamedValue>)>, String> {
    let file: Table = text.parse().map_err(|error: toml::de::Error| error.to_string())?;
    let mut sets = Vec::new();
    for (app, table) in file {
        let Toml::Table(table) = table else {
            return Err(format!(
                "'{}' stands outside of a table: write [\"APPLICATION\"] above it",
                clean(&app)
            ));
        };
        let mut values = Vec::new();
        for (name, value) in table {
            let value = match value {
                Toml::Float(number) => Value::Number(number),
                Toml::Integer(integer) => Value::Integer(integer),
                Toml::Boolean(flag) => Value::Flag(flag),
                Toml::String(_) | Toml::Datetime(_) | Toml::Array(_) | Toml::Table(_) => {
                    let (app, name) = (clean(&app), clean(&name));
                    return Err(format!(
                        "{name} of {app} is no value: write a number, true or false, and the name of an application in quotes"
                    ));
                }
            };
            values.push(NamedValue { name, value });
        }
        sets.push((app, values));
    }
    Ok(sets)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn written_values_are_read_as_the_same_set() {
        let value = |name: &str, value| NamedValue { name: name.to_owned(), value };
        let values = vec![
            value("assistance", Value::Number(1.0)),
            value("damped", Value::Flag(true)),
            value("steps", Value::Integer(4)),
        ];
        let mut file = Table::new();
        file.insert("knee.drive".to_owned(), Toml::Table(table_of(values.clone())));
        let text = format!("{HEAD}{file}");
        assert_eq!(parse(&text), Ok(vec![("knee.drive".to_owned(), values)]), "{text}");
    }

    #[test]
    fn name_without_quotes_is_explained() {
        let why = parse("[knee.drive]\ngain = 1.0\n").expect_err("drive is a table within knee");
        assert!(why.contains("drive of knee") && why.contains("in quotes"), "{why}");
        assert!(parse("gain = 1").expect_err("there is no table").contains("outside of a table"));
        assert!(parse("gain").is_err());
    }
}
