//! The parameters of all applications, as those of one server: `knee.drive.assistance` is the parameter `assistance` of
//! `knee.drive`, as on the command line.

use std::{collections::BTreeMap, sync::Arc};

use serde::Deserialize;
use serde_json::{Value as Json, json};
use sinew::parameters::{NamedValue, ParameterList, ParameterOutcome, SetParameters, Value};

use super::protocol::GivenParameter;
use crate::answer::{self, Shared};

/// The values of a set of one application, at most.
const VALUES_MAX: usize = 64;

/// A parameter of an application.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Known {
    app: String,
    name: String,
    value: Value,
}

/// The parameters of all applications, by their names here.
pub(super) type AllKnown = BTreeMap<String, Known>;

/// The list that the page gets, too.
#[derive(Debug, Deserialize)]
struct Listed {
    apps: Vec<ListedApp>,
}

#[derive(Debug, Deserialize)]
struct ListedApp {
    app: String,
    /// `None`: it is not known.
    list: Option<ParameterList>,
}

/// The names that a client wants; without any, all.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Wanted(Vec<String>);

impl Wanted {
    pub(super) const fn of(names: Vec<String>) -> Self {
        Self(names)
    }

    /// Returns the values of the wanted parameters. One that is no finite number has none in JSON, and is left out.
    pub(super) fn values(&self, known: &AllKnown) -> BTreeMap<String, Json> {
        let is_wanted = |name: &String| self.0.is_empty() || self.0.contains(name);
        let wanted = known.iter().filter(|(name, _)| is_wanted(name));
        wanted.filter_map(|(name, known)| Some((name.clone(), to_json(known.value)?))).collect()
    }
}

/// Returns the parameters of all applications, which the nodes are asked for three times a second at most.
///
/// # Errors
/// Why the system cannot be asked, with the remedy.
pub(super) async fn known(shared: &Arc<Shared>) -> Result<AllKnown, String> {
    read(answer::listed(shared).await?)
}

fn read(list: Json) -> Result<AllKnown, String> {
    let listed: Listed = serde_json::from_value(list)
        .map_err(|why| format!("sinew view cannot read its own list of parameters: {why}; report this"))?;
    let mut all = AllKnown::new();
    for ListedApp { app, list } in listed.apps {
        for one in list.map(|list| list.parameters).unwrap_or_default() {
            let known = Known { app: app.clone(), name: one.name.clone(), value: one.value };
            all.insert(format!("{app}.{}", one.name), known);
        }
    }
    Ok(all)
}

/// Sets parameters: those of one application as a whole, or not at all. The application's node decides. Returns why
/// parameters were not set.
pub(super) async fn set(shared: &Arc<Shared>, given: &[GivenParameter], known: &AllKnown) -> Vec<String> {
    let (sets, mut faults) = sets(given, known);
    for (app, values) in sets {
        match answer::apply(shared, app.clone(), SetParameters::Values(values)).await {
            Ok(ParameterOutcome::Applied { .. }) => {}
            Ok(ParameterOutcome::Refused { why }) => faults.push(format!("{app}: refused: {why}")),
            // Only the values of a transaction are held.
            Ok(ParameterOutcome::Held { .. }) => {
                faults.push(format!("{app}: it answered with a state of a transaction; update it"));
            }
            Err(why) => faults.push(format!("{app}: {why}")),
        }
    }
    faults
}

/// Returns the values of each application, and why some are none.
fn sets(given: &[GivenParameter], known: &AllKnown) -> (BTreeMap<String, Vec<NamedValue>>, Vec<String>) {
    let (mut sets, mut faults) = (BTreeMap::<_, Vec<_>>::new(), Vec::new());
    for GivenParameter { name, value } in given {
        let Some(known) = known.get(name) else {
            faults.push(format!("no application has a parameter '{name}'; `sinew param list` shows all"));
            continue;
        };
        match from_json(value, known.value) {
            Some(value) => {
                sets.entry(known.app.clone())
                    .or_default()
                    .push(NamedValue { name: known.name.clone(), value });
            }
            None => faults.push(format!("{name}: {value} is no value like {}", known.value)),
        }
    }
    sets.retain(|app, values| {
        let fits = values.len() <= VALUES_MAX;
        if !fits {
            faults.push(format!("{app}: a set has at most {VALUES_MAX} values; set fewer"));
        }
        fits
    });
    (sets, faults)
}

fn to_json(value: Value) -> Option<Json> {
    match value {
        Value::Number(number) => number.is_finite().then(|| json!(number)),
        Value::Integer(integer) => Some(json!(integer)),
        Value::Flag(flag) => Some(json!(flag)),
    }
}

/// Returns a value of the same kind as `like`; `None` if it is another one. Clients of JavaScript send whole numbers
/// without a fraction.
fn from_json(value: &Json, like: Value) -> Option<Value> {
    match like {
        Value::Number(_) => value.as_f64().map(Value::Number),
        Value::Integer(_) => value.as_i64().map(Value::Integer),
        Value::Flag(_) => value.as_bool().map(Value::Flag),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn all() -> AllKnown {
        let one = |name: &str, value: Value| {
            json!({
                "name": name, "description": "", "unit": "1", "value": value, "target": value, "default": value,
                "min": null, "max": null, "slope_per_s": null, "keep": false,
            })
        };
        let list =
            |parameters: Vec<Json>| json!({ "parameters": parameters, "has_ticks": true, "undoable": 0 });
        let knee = list(vec![one("gain", Value::Number(1.0)), one("steps", Value::Integer(2))]);
        let list = json!({ "apps": [
            { "app": "knee.drive", "list": knee },
            { "app": "hip", "list": list(vec![one("on", Value::Flag(true))]) },
            { "app": "ankle", "fault": "no answer" },
        ] });
        read(list).expect("it is the list of the page")
    }

    fn given(name: &str, value: Json) -> GivenParameter {
        GivenParameter { name: name.to_owned(), value }
    }

    #[test]
    fn names_are_those_of_the_command_line() {
        let values = Wanted::default().values(&all());
        let expected =
            [("hip.on", json!(true)), ("knee.drive.gain", json!(1.0)), ("knee.drive.steps", json!(2))];
        assert_eq!(values, expected.map(|(name, value)| (name.to_owned(), value)).into());
        let one = Wanted::of(vec!["hip.on".to_owned(), "gone".to_owned()]).values(&all());
        assert_eq!(one.keys().collect::<Vec<_>>(), ["hip.on"]);
    }

    #[test]
    fn values_of_one_application_are_one_set() {
        let order = [
            given("knee.drive.gain", json!(2)),
            given("hip.on", json!(false)),
            given("knee.drive.steps", json!(3)),
        ];
        let (sets, faults) = sets(&order, &all());
        let value = |name: &str, value| NamedValue { name: name.to_owned(), value };
        let knee = vec![value("gain", Value::Number(2.0)), value("steps", Value::Integer(3))];
        let hip = vec![value("on", Value::Flag(false))];
        assert_eq!(sets, BTreeMap::from([("hip".to_owned(), hip), ("knee.drive".to_owned(), knee)]));
        assert!(faults.is_empty(), "{faults:?}");
    }

    #[test]
    fn other_kinds_and_unknown_names_are_faults() {
        for (name, value) in [
            ("knee.drive.gain", json!("1")),
            ("knee.drive.steps", json!(1.5)),
            ("hip.on", json!(1)),
            ("hip.on", Json::Null),
            ("hip.off", json!(true)),
        ] {
            let (sets, faults) = sets(&[given(name, value)], &all());
            assert!(sets.is_empty() && faults.len() == 1, "{name}: {faults:?}");
        }
        let many = vec![given("hip.on", json!(true)); VALUES_MAX + 1];
        let (sets, faults) = sets(&many, &all());
        assert!(sets.is_empty() && faults.len() == 1, "{faults:?}");
    }
}
