//! The words `APP.NAME` and `APP.NAME=VALUE` of a command line.

use std::str::FromStr;

use sinew::parameters::{NamedValue, Value};

/// A parameter of an application. The last dot separates them, since names of applications may have dots.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct ParameterName {
    pub(super) app: String,
    pub(super) name: String,
}

/// A parameter and its new value.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Assignment {
    parameter: ParameterName,
    value: Value,
}

impl FromStr for ParameterName {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let parts = text.rsplit_once('.').filter(|(app, name)| !app.is_empty() && !name.is_empty());
        let (app, name) =
            parts.ok_or("write the application and the parameter, as in knee.drive.assistance")?;
        Ok(Self { app: app.to_owned(), name: name.to_owned() })
    }
}

impl FromStr for Assignment {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        // The value of a parameter has a dot, and its name has no `=`.
        let parts = text.rsplit_once('=');
        let (parameter, value) = parts.ok_or("write a value, too, as in knee.drive.assistance=0.5")?;
        Ok(Self {
            parameter: parameter.parse()?,
            value: value.trim().parse().map_err(|why: sinew::parameters::ValueError| why.to_string())?,
        })
    }
}

/// Returns the set of each application of these assignments, in the order in which the applications come first.
pub(super) fn sets(assignments: &[Assignment]) -> Vec<(String, Vec<NamedValue>)> {
    let mut sets: Vec<(String, Vec<NamedValue>)> = Vec::new();
    for Assignment { parameter, value } in assignments {
        let value = NamedValue { name: parameter.name.clone(), value: *value };
        match sets.iter_mut().find(|(app, _)| *app == parameter.app) {
            Some((_, values)) => values.push(value),
            None => sets.push((parameter.app.clone(), vec![value])),
        }
    }
    sets
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn last_dot_of_the_name_separates_application_and_parameter() {
        let one: Assignment = "leg=2.knee.drive.gain=0.5".parse().expect("it is legal");
        assert_eq!((one.parameter.app.as_str(), one.parameter.name.as_str()), ("leg=2.knee.drive", "gain"));
        assert_eq!(one.value, Value::Number(0.5));
    }

    #[test]
    fn incomplete_words_are_refused_with_an_example() {
        for text in ["gain=1", "knee.gain", ".gain=1", "knee.=1"] {
            let why = text.parse::<Assignment>().expect_err("it is incomplete");
            assert!(why.contains("as in knee.drive.assistance"), "{text}: {why}");
        }
        let why = "knee.gain=fast".parse::<Assignment>().expect_err("it is a word");
        assert!(why.contains("'fast' is no value"), "{why}");
    }

    #[test]
    fn values_are_grouped_by_application() {
        let words: Vec<Assignment> = ["hip.gain=1", "knee.gain=2", "hip.damped=true"]
            .map(|text| text.parse().expect("it is legal"))
            .to_vec();
        let value = |name: &str, value| NamedValue { name: name.to_owned(), value };
        let hip = vec![value("gain", Value::Integer(1)), value("damped", Value::Flag(true))];
        let knee = vec![value("gain", Value::Integer(2))];
        assert_eq!(sets(&words), [("hip".to_owned(), hip), ("knee".to_owned(), knee)]);
    }
}
