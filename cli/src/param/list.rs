//! `sinew param list`: the parameters of applications as a table.

use serde_json::{Value as Json, json};
use sinew::{
    Payload, Tid,
    inspect::{AppsReport, AskApps},
    parameters::{AskParameters, ParameterList, ParameterReport, Value},
};

use super::{ask, value_json};
use crate::{
    Report,
    system::{Answer, System, SystemError},
    table::{Table, clean},
};

/// The parameters of an application, or why they are not known.
pub(super) struct Listed {
    pub(super) app: String,
    tid: Tid,
    pub(super) result: Result<ParameterList, String>,
}

/// Asks an application, or all, and shows their parameters.
pub(super) fn show(system: &mut System, app: Option<&str>, is_wide: bool) -> Result<Report, SystemError> {
    let (listed, silent) = match app {
        Some(app) => (vec![one(system, app)?], Vec::new()),
        None => all(system)?,
    };
    Ok(report(&listed, &silent, is_wide))
}

/// Asks one application.
pub(super) fn one(system: &mut System, app: &str) -> Result<Listed, SystemError> {
    let tid = system.find(app)?;
    Ok(Listed { app: app.to_owned(), tid, result: ask(system, app, tid) })
}

/// Asks each application that has parameters. Also returns the nodes that did not list their applications.
pub(super) fn all(system: &mut System) -> Result<(Vec<Listed>, Vec<String>), SystemError> {
    let here = system.here()?;
    let (mut found, mut silent) = (Vec::new(), Vec::new());
    for Answer { node, name, result } in system.ask_all::<AskApps, AppsReport>(&here) {
        match result {
            Ok(report) => {
                let has = |kinds: &[sinew::inspect::KindReport]| {
                    kinds.iter().any(|kind| kind.kind == AskParameters::KIND)
                };
                let apps = report.apps.into_iter().filter(|app| has(&app.kinds));
                found.extend(apps.map(|app| (app.name.unwrap_or_else(|| app.tid.to_string()), app.tid)));
            }
            Err(why) => silent.push(format!("{node} {}: {}", clean(&name), clean(&why))),
        }
    }
    let listed = found.into_iter().map(|(app, tid)| {
        let result = ask(system, &app, tid);
        Listed { app, tid, result }
    });
    Ok((listed.collect(), silent))
}

fn report(listed: &[Listed], silent: &[String], is_wide: bool) -> Report {
    let heading = ["NAME", "VALUE", "TARGET", "UNIT", "RANGE", "DEFAULT", "DESCRIPTION"];
    let mut table = Table::new(heading).whole(&["NAME", "VALUE"]).wide(is_wide);
    let (mut apps, mut faults, mut is_any) = (Vec::new(), String::new(), false);
    for Listed { app, tid, result } in listed {
        match result {
            Ok(list) => {
                list.parameters.iter().for_each(|one| table.row(cells(app, one)));
                is_any |= !list.parameters.is_empty();
            }
            Err(why) => faults += &format!("{}: {}\n", clean(app), clean(why)),
        }
        let list = result.as_ref().ok();
        let parameters = list.map(|list| list.parameters.iter().map(parameter_json).collect::<Vec<_>>());
        apps.push(json!({
            "app": app, "tid": tid.to_string(), "parameters": parameters.unwrap_or_default(),
            "has_ticks": list.map(|list| list.has_ticks), "undoable": list.map(|list| list.undoable),
            "fault": result.as_ref().err(),
        }));
    }
    let silent_lines: String = silent.iter().map(|line| format!("{line}\n")).collect();
    let is_fine = faults.is_empty() && silent.is_empty();
    let text = match (is_any, is_fine) {
        (true, _) => table.text(),
        (false, true) => "no application has parameters\n".to_owned(),
        (false, false) => String::new(),
    };
    Report { text: text + &faults + &silent_lines, json: json!({ "apps": apps, "silent": silent }), is_fine }
}

fn cells(app: &str, one: &ParameterReport) -> [String; 7] {
    let range = one.min.zip(one.max).map_or_else(|| "-".to_owned(), |(min, max)| format!("{min} to {max}"));
    let target = if one.target == one.value { "-".to_owned() } else { one.target.to_string() };
    let unit = if one.unit.is_empty() { "-".to_owned() } else { one.unit.clone() };
    [
        format!("{app}.{}", one.name),
        short(one.value),
        target,
        unit,
        range,
        one.default.to_string(),
        one.description.clone(),
    ]
}

/// Returns a value with at most 6 decimal places: one that moves has many.
fn short(value: Value) -> String {
    match value {
        Value::Number(number) if number.abs() >= 1e-3 && number.abs() < 1e9 => {
            Value::Number((number * 1e6).round() / 1e6).to_string()
        }
        Value::Number(_) | Value::Integer(_) | Value::Flag(_) => value.to_string(),
    }
}

/// Returns a parameter for programs.
pub(super) fn parameter_json(one: &ParameterReport) -> Json {
    json!({
        "name": one.name, "value": value_json(one.value), "target": value_json(one.target), "unit": one.unit,
        "min": one.min.map(value_json), "max": one.max.map(value_json), "default": value_json(one.default),
        "slope_per_s": one.slope_per_s, "keep": one.keep, "description": one.description,
    })
}

#[cfg(test)]
mod tests {
    use sinew::{AppAddress, NodeAddress};

    use super::*;
    use crate::table::{
        WIDTH,
        tests::{long_name, widest},
    };

    fn listed(app: &str, value: f64) -> Listed {
        let one = ParameterReport {
            name: "assistance".to_owned(),
            description: "Assistance, as a share of the model's torque.".to_owned(),
            unit: "1".to_owned(),
            value: Value::Number(value),
            target: Value::Number(0.5),
            default: Value::Number(0.3),
            min: Some(Value::Number(0.0)),
            max: Some(Value::Number(1.0)),
            slope_per_s: Some(0.5),
            keep: true,
        };
        let list = ParameterList { parameters: vec![one], has_ticks: true, undoable: 0 };
        let tid = Tid::new(NodeAddress::new(2), AppAddress::new(0x1001));
        Listed { app: app.to_owned(), tid, result: Ok(list) }
    }

    #[test]
    fn moving_value_is_shown_with_its_target() {
        let text = report(&[listed("knee", 0.350_000_000_1)], &[], false).text;
        let words: Vec<_> = text.lines().nth(1).unwrap_or_default().split_whitespace().take(8).collect();
        assert_eq!(words, ["knee.assistance", "0.35", "0.5", "1", "0.0", "to", "1.0", "0.3"]);
        let text = report(&[listed("knee", 0.5)], &[], false).text;
        assert!(text.contains("  0.5    -  "), "{text}");
    }

    #[test]
    fn table_fits_a_terminal_for_any_name() {
        let text = report(&[listed(&long_name(), 0.1)], &[], false).text;
        assert!(widest(&text) <= WIDTH, "{text}");
    }

    #[test]
    fn missing_answers_are_findings() {
        let refused = Listed { result: Err("it is stopped".to_owned()), ..listed("hip", 0.1) };
        let found = report(&[refused], &["10.0.0.3 hip: no answer".to_owned()], false);
        assert_eq!(
            (found.is_fine, found.text.as_str()),
            (false, "hip: it is stopped\n10.0.0.3 hip: no answer\n")
        );
        let none = report(&[], &[], false);
        assert_eq!((none.is_fine, none.text.as_str()), (true, "no application has parameters\n"));
    }
}
