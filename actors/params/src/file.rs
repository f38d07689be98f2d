//! Values of parameters as TOML: a table for each application.

use std::collections::BTreeMap;

use toml::{Table, Value as Toml};

use crate::{NamedValue, Value};

/// Maximum size of a file of values in bytes. The parameters of a hundred applications have a tenth of it.
pub const FILE_BYTES_MAX: u64 = 1 << 20;

/// The values of applications, by their names.
pub type ValuesOfApps = BTreeMap<String, Vec<NamedValue>>;

/// Returns the values as TOML.
///
/// # Examples
///
/// ```
/// use sinew_params::{NamedValue, Value, file};
///
/// let gain = NamedValue { name: "gain".to_owned(), value: Value::Number(0.5) };
/// let values = file::ValuesOfApps::from([("knee.drive".to_owned(), vec![gain])]);
/// assert_eq!(file::text(&values), "[\"knee.drive\"]\ngain = 0.5\n");
/// assert_eq!(file::parse(&file::text(&values)), Ok(values));
/// ```
#[must_use]
pub fn text(values: &ValuesOfApps) -> String {
    let toml = |value| match value {
        Value::Number(number) => Toml::Float(number),
        Value::Integer(integer) => Toml::Integer(integer),
        Value::Flag(flag) => Toml::Boolean(flag),
    };
    let table = |values: &[NamedValue]| -> Table {
        values.iter().map(|one| (one.name.clone(), toml(one.value))).collect()
    };
    let all: Table = values.iter().map(|(app, values)| (app.clone(), Toml::Table(table(values)))).collect();
    all.to_string()
}

/// Reads values from TOML. The text may be of any origin.
///
/// # Errors
/// Returns why it is not a table of values for each application.
pub fn parse(text: &str) -> Result<ValuesOfApps, String> {
    let file: Table = text.parse().map_err(|error: toml::de::Error| error.to_string())?;
    let mut all = ValuesOfApps::new();
    for (app, table) in file {
        let Toml::Table(table) = table else {
            return Err(format!("'{app}' stands outside of a table: write [\"APPLICATION\"] above it"));
        };
        let mut values = Vec::new();
        for (name, value) in table {
            let value = match value {
                Toml::Float(number) => Value::Number(number),
                Toml::Integer(integer) => Value::Integer(integer),
                Toml::Boolean(flag) => Value::Flag(flag),
                Toml::String(_) | Toml::Datetime(_) | Toml::Array(_) | Toml::Table(_) => {
                    return Err(format!(
                        "{name} of {app} is no value: write a number, true or false, and the name of an application in quotes"
                    ));
                }
            };
            values.push(NamedValue { name, value });
        }
        all.insert(app, values);
    }
    Ok(all)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn written_values_are_read_as_the_same(
            app in "\\PC{1,20}", number in any::<f64>(), integer in any::<i64>(), flag in any::<bool>(),
        ) {
            prop_assume!(!number.is_nan());
            let value = |name: &str, value| NamedValue { name: name.to_owned(), value };
            let values = vec![
                value("damped", Value::Flag(flag)),
                value("gain", Value::Number(number)),
                value("steps", Value::Integer(integer)),
            ];
            let all = ValuesOfApps::from([(app, values)]);
            prop_assert_eq!(parse(&text(&all)), Ok(all));
        }

        #[test]
        fn any_text_is_values_or_an_error(text in "\\PC{0,200}") {
            let _ = parse(&text);
        }
    }

    #[test]
    fn name_without_quotes_is_explained() {
        let why = parse("[knee.drive]\ngain = 1.0\n").expect_err("drive is a table within knee");
        assert!(why.contains("drive of knee") && why.contains("in quotes"), "{why}");
        assert!(parse("gain = 1").expect_err("there is no table").contains("outside of a table"));
        assert!(parse("gain").is_err());
    }
}
