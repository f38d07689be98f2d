//! `sinew apps` and `sinew barriers`: every application, and which ones wait for which, at the start and at run time.

use std::collections::{BTreeMap, BTreeSet};

use serde_json::{Value, json};
use sinew::{
    NodeAddress,
    inspect::{AppReport, AppsReport, AskApps, BarrierReport, KindReport, Missing},
};

use crate::{
    Report,
    system::{Answer, System, SystemError},
    table::{Table, clean, or_dash, time},
};

/// Maximum number of payload types of one application in the table.
const KINDS_SHOWN: usize = 2;
/// Maximum characters of the name of each.
const KIND_WIDTH: usize = 32;

/// Asks every node for its applications.
pub(crate) fn show(system: &mut System, is_wide: bool) -> Result<Report, SystemError> {
    Ok(listed(&ask(system)?, is_wide))
}

fn listed(answers: &[Answer<AppsReport>], is_wide: bool) -> Report {
    let heading = ["TID", "NAME", "NODE", "STATE", "HANDLES", "DETAIL"];
    let mut table = Table::new(heading).whole(&["TID", "STATE"]).wide(is_wide);
    let mut rows = Vec::new();
    for (node, app) in all(answers) {
        table.row([
            app.tid.to_string(),
            or_dash(app.name.clone()),
            node.to_owned(),
            state(app).to_owned(),
            or_dash(handles(app)),
            why(app),
        ]);
        rows.push(app_json(node, app));
    }
    let shown = Shown::Apps;
    let is_ready = all(answers).all(|(_, app)| app.ready && app.missing.is_empty());
    let is_fine = is_ready && shown.is_complete(answers);
    let text = table.text() + &shown.silent(answers);
    let (left_out, silent) = (shown.left_out_json(answers), silent_json(answers));
    Report { text, json: json!({ "apps": rows, "left_out": left_out, "silent": silent }), is_fine }
}

/// Asks every node for its waiting applications and their missing requirements.
pub(crate) fn barriers(system: &mut System, is_wide: bool) -> Result<Report, SystemError> {
    Ok(waiting(&ask(system)?, is_wide))
}

fn waiting(answers: &[Answer<AppsReport>], is_wide: bool) -> Report {
    let shown = Shown::Barriers;
    let waiting: Vec<_> = all(answers).filter(|(_, app)| !app.missing.is_empty()).collect();
    let mut blocked: BTreeMap<&str, BTreeSet<&str>> = BTreeMap::new();
    let mut reasons: BTreeMap<&str, BTreeSet<&str>> = BTreeMap::new();
    let mut since: BTreeMap<&str, Option<u64>> = BTreeMap::new();
    for (_, app) in &waiting {
        for missing in &app.missing {
            let name = app.name.as_deref().unwrap_or("without a name");
            blocked.entry(&missing.name).or_default().insert(name);
            reasons.entry(&missing.name).or_default().insert(&missing.why);
            let longest = since.entry(&missing.name).or_default();
            *longest = missing.since_us.max(*longest);
        }
    }
    let meetings = meetings(answers);
    let is_any_shown = !waiting.is_empty() || !meetings.is_empty();
    let is_fine = !is_any_shown && shown.is_complete(answers);
    let waiters = waiting.iter().map(|(node, app)| app_json(node, app)).collect::<Vec<_>>();
    let blockers = blocked
        .iter()
        .map(|(name, apps)| json!({ "name": name, "since_us": since[name], "why": reasons[name], "blocks": apps }))
        .collect::<Vec<_>>();
    let json = json!({
        "waiting": waiters, "missing": blockers, "barriers": meetings.iter().map(|(node, one)| meeting_json(node, one)).collect::<Vec<_>>(),
        "left_out": shown.left_out_json(answers), "silent": silent_json(answers),
    });
    let mut text = if waiting.is_empty() {
        // If an answer was cut, an application may wait nevertheless.
        let is_known = !is_any_shown && shown.left_out(answers).is_empty();
        if is_known { "no application waits\n".to_owned() } else { String::new() }
    } else {
        let mut table = Table::new(["WAITS", "NODE", "SINCE", "FOR"]).whole(&["SINCE"]).wide(is_wide);
        for (node, app) in &waiting {
            let since = app.waits_us.map_or_else(|| "lost it".to_owned(), time);
            table.row([or_dash(app.name.clone()), (*node).to_owned(), since, lacks(app)]);
        }
        let mut missing = Table::new(["MISSING", "SINCE", "WHY", "BLOCKS"]).whole(&["SINCE"]).wide(is_wide);
        for (name, apps) in &blocked {
            missing.row([
                (*name).to_owned(),
                or_dash(since[name].map(time)),
                joined(&reasons[name]),
                joined(apps),
            ]);
        }
        format!("{}\n{}", table.text(), missing.text())
    };
    if !meetings.is_empty() {
        let heading = ["BARRIER", "NODE", "OPENED", "WAITS", "MISSING"];
        let mut table = Table::new(heading).whole(&["OPENED"]).wide(is_wide);
        meetings.iter().for_each(|(node, one)| table.row(meeting_cells(node, one)));
        text += &(if text.is_empty() { table.text() } else { format!("\n{}", table.text()) });
    }
    Report { text: text + &shown.silent(answers), json, is_fine }
}

/// Returns the run-time barriers with waiting applications, each as reported by every node with one.
fn meetings(answers: &[Answer<AppsReport>]) -> Vec<(&str, &BarrierReport)> {
    let reports = answers.iter().filter_map(|answer| answer.result.as_ref().ok());
    reports.flat_map(|report| report.barriers.iter().map(|one| (report.name.as_str(), one))).collect()
}

fn meeting_cells(node: &str, one: &BarrierReport) -> [String; 5] {
    let waits = one.waiting.iter().map(|one| format!("{} {}", one.name, time(one.waits_us)));
    let waits: Vec<_> = waits.chain(more(one.waiting_left_out)).collect();
    let missing: Vec<_> = one.missing.iter().map(meeting_lacks).chain(more(one.missing_left_out)).collect();
    let opened = if one.is_phase { "phase".to_owned() } else { one.generation.to_string() };
    [one.name.clone(), node.to_owned(), opened, waits.join(", "), missing.join(", ")]
}

fn meeting_lacks(missing: &Missing) -> String {
    let since = missing.since_us.map_or_else(String::new, |since| format!("; {}", time(since)));
    format!("{} ({}{since})", missing.name, missing.why)
}

fn meeting_json(node: &str, one: &BarrierReport) -> Value {
    let waiting =
        one.waiting.iter().map(|waiter| json!({ "name": waiter.name, "waits_us": waiter.waits_us }));
    let missing = one.missing.iter().map(missing_json);
    json!({
        "name": one.name, "node_name": node, "parties": one.parties, "is_phase": one.is_phase, "generation": one.generation,
        "waiting": waiting.collect::<Vec<_>>(), "waiting_left_out": one.waiting_left_out,
        "missing": missing.collect::<Vec<_>>(), "missing_left_out": one.missing_left_out,
    })
}

fn missing_json(of: &Missing) -> Value {
    let Missing { name, why, since_us } = of;
    json!({ "name": name, "why": why, "since_us": since_us })
}

fn ask(system: &mut System) -> Result<Vec<Answer<AppsReport>>, SystemError> {
    let here = system.here()?;
    let mut answers = system.ask_all::<AskApps, AppsReport>(&here);
    // Applications that only ask are not part of the shown system.
    for answer in &mut answers {
        if let Ok(report) = &mut answer.result {
            report.apps.retain(|app| !system.own.contains(&app.tid));
        }
    }
    Ok(answers)
}

/// Returns each application with the name of its node.
fn all(answers: &[Answer<AppsReport>]) -> impl Iterator<Item = (&str, &AppReport)> {
    let reports = answers.iter().filter_map(|answer| answer.result.as_ref().ok());
    reports.flat_map(|report| report.apps.iter().map(|app| (report.name.as_str(), app)))
}

const fn state(app: &AppReport) -> &'static str {
    match (app.ready, app.waits_us) {
        (true, _) if !app.missing.is_empty() => "ready, lacks",
        (true, _) => "ready",
        (false, Some(_)) => "waits",
        (false, None) => "not ready",
    }
}

/// Returns the types that it handles, as many as fit into a table.
fn handles(app: &AppReport) -> Option<String> {
    let shown = app.kinds.iter().take(KINDS_SHOWN).map(|kind| {
        let name = kind_name(kind);
        let cut = name
            .char_indices()
            .nth(KIND_WIDTH)
            .map(|_| name.chars().take(KIND_WIDTH - 3).collect::<String>());
        cut.map_or(name, |cut| cut + "...")
    });
    let mut words: Vec<_> = shown.collect();
    words.extend(more(app.kinds.len().saturating_sub(KINDS_SHOWN) as u64 + app.kinds_left_out));
    (!words.is_empty()).then(|| words.join(", "))
}

/// Returns the number of further ones, if any.
fn more(count: u64) -> Option<String> {
    (count > 0).then(|| format!("{count} more"))
}

fn kind_name(of: &KindReport) -> String {
    of.name.clone().unwrap_or_else(|| of.kind.to_string())
}

/// Returns why it is not ready, as text.
pub(crate) fn why(app: &AppReport) -> String {
    let mut parts = Vec::new();
    match app.waits_us {
        Some(waits) if !app.missing.is_empty() => {
            parts.push(format!("has waited {} for {}", time(waits), lacks(app)));
        }
        Some(waits) => parts.push(format!("has waited {}", time(waits))),
        None if !app.missing.is_empty() => parts.push(lacks(app)),
        None if !app.ready && app.ended.is_none() => parts.push("it starts".to_owned()),
        None => {}
    }
    parts.extend(app.ended.clone().filter(|_| !app.ready));
    parts.join("; ")
}

pub(crate) fn lacks(app: &AppReport) -> String {
    let one = |missing: &Missing| format!("{} ({})", missing.name, missing.why);
    app.missing.iter().map(one).chain(more(app.missing_left_out)).collect::<Vec<_>>().join(", ")
}

fn joined(words: &BTreeSet<&str>) -> String {
    words.iter().copied().collect::<Vec<_>>().join(", ")
}

fn app_json(node: &str, app: &AppReport) -> Value {
    let missing = app.missing.iter().map(missing_json);
    json!({
        "tid": app.tid.to_string(),
        "name": app.name,
        "node": app.tid.node.to_string(),
        "node_name": node,
        "ready": app.ready,
        "state": state(app),
        "waits_us": app.waits_us,
        "missing": missing.collect::<Vec<_>>(),
        "missing_left_out": app.missing_left_out,
        "ended": app.ended,
        "kinds": app.kinds.iter().map(|of| json!({ "kind": kind_name(of), "kind_id": of.kind.to_string() })).collect::<Vec<_>>(),
        "kinds_left_out": app.kinds_left_out,
    })
}

/// The part of the answers that a command shows.
#[derive(Clone, Copy)]
enum Shown {
    /// Applications alone.
    Apps,
    /// Applications that wait, and run-time barriers.
    Barriers,
}

/// Number of entries that did not fit into the answer of a node.
struct LeftOut {
    node: NodeAddress,
    apps: u64,
    barriers: u64,
}

impl Shown {
    /// Returns the numbers of left-out entries of the shown kind, for each node with any.
    fn left_out(self, answers: &[Answer<AppsReport>]) -> Vec<LeftOut> {
        let of = |answer: &Answer<AppsReport>| {
            let report = answer.result.as_ref().ok()?;
            let barriers = match self {
                Self::Apps => 0,
                Self::Barriers => report.barriers_left_out,
            };
            let left_out = LeftOut { node: answer.node, apps: report.left_out, barriers };
            (left_out.apps > 0 || left_out.barriers > 0).then_some(left_out)
        };
        answers.iter().filter_map(of).collect()
    }

    fn is_complete(self, answers: &[Answer<AppsReport>]) -> bool {
        answers.iter().all(|answer| answer.result.is_ok()) && self.left_out(answers).is_empty()
    }

    /// Returns the nodes that have not answered, or not completely.
    fn silent(self, answers: &[Answer<AppsReport>]) -> String {
        let mut lines = String::new();
        for LeftOut { node, apps, barriers } in self.left_out(answers) {
            for (count, what) in [(apps, "applications"), (barriers, "barriers")] {
                if count > 0 {
                    lines += &format!("{node}: {count} further {what} had no room in its answer\n");
                }
            }
        }
        let silent = answers.iter().filter_map(|answer| Some((answer, answer.result.as_ref().err()?)));
        lines.extend(
            silent.map(|(answer, why)| format!("{} {}: {}\n", answer.node, clean(&answer.name), clean(why))),
        );
        lines
    }

    fn left_out_json(self, answers: &[Answer<AppsReport>]) -> Value {
        let line = |LeftOut { node, apps, barriers }: LeftOut| match self {
            Self::Apps => json!({ "node": node.to_string(), "apps": apps }),
            Self::Barriers => json!({ "node": node.to_string(), "apps": apps, "barriers": barriers }),
        };
        self.left_out(answers).into_iter().map(line).collect()
    }
}

fn silent_json(answers: &[Answer<AppsReport>]) -> Value {
    let line = |answer: &Answer<AppsReport>| {
        Some(json!({ "node": answer.node.to_string(), "why": answer.result.as_ref().err()? }))
    };
    answers.iter().filter_map(line).collect()
}

#[cfg(test)]
mod tests {
    use sinew::{AppAddress, Tid, inspect::WaitReport, message::Kind};

    use super::*;
    use crate::table::{
        WIDTH,
        tests::{long_name, widest},
    };

    /// The answer of a node with these barriers and no application.
    fn answer(barriers: Vec<BarrierReport>, [left_out, barriers_left_out]: [u64; 2]) -> Answer<AppsReport> {
        let name = "knee".to_owned();
        let report = AppsReport {
            name: name.clone(),
            apps: Vec::new(),
            left_out,
            barriers,
            barriers_left_out,
            groups: Vec::new(),
            groups_left_out: 0,
        };
        Answer { node: NodeAddress::new(2), name, result: Ok(report) }
    }

    fn barrier() -> BarrierReport {
        BarrierReport {
            name: "calibrated".to_owned(),
            parties: vec!["hip".to_owned(), "knee".to_owned()],
            is_phase: false,
            generation: 0,
            waiting: vec![WaitReport { name: "knee".to_owned(), waits_us: 1 }],
            waiting_left_out: 0,
            missing: vec![Missing { name: "hip".to_owned(), why: "not there".to_owned(), since_us: None }],
            missing_left_out: 0,
        }
    }

    fn waited(answers: &[Answer<AppsReport>]) -> Report {
        waiting(answers, false)
    }

    #[test]
    fn tables_fit_a_terminal_for_any_names() {
        let name = long_name();
        let missing = Missing {
            name: name.clone(),
            why: format!("not there; nearest: {name}"),
            since_us: Some(90_000_000_000),
        };
        let kinds = [&*name, &name, &name];
        let app = AppReport {
            tid: Tid::new(NodeAddress::from([192, 168, 100, 200]), AppAddress::new(0x8000_0001)),
            name: Some(name.clone()),
            ready: false,
            waits_us: Some(90_000_000_000),
            missing: vec![missing.clone(), missing.clone()],
            ended: Some("it panicked: no encoder at /dev/ttyUSB0".to_owned()),
            ..app(&kinds, 7)
        };
        let waits = WaitReport { name: name.clone(), waits_us: 90_000_000_000 };
        let barrier =
            BarrierReport { name: name.clone(), waiting: vec![waits], missing: vec![missing], ..barrier() };
        let report = AppsReport {
            name: name.clone(),
            apps: vec![app],
            left_out: 0,
            barriers: vec![barrier],
            barriers_left_out: 0,
            groups: Vec::new(),
            groups_left_out: 0,
        };
        let answers = [Answer { node: NodeAddress::new(2), name, result: Ok(report) }];
        for show in [listed, waiting] {
            let text = show(&answers, false).text;
            assert!(widest(&text) <= WIDTH, "{text}");
            assert!(widest(&show(&answers, true).text) > WIDTH);
        }
        assert!(listed(&answers, false).text.contains("192.168.100.200/80000001  "));
    }

    #[test]
    fn left_out_barriers_are_counted() {
        let line = "0.0.0.2: 6 further barriers had no room in its answer\n";
        let report = waited(&[answer(vec![barrier()], [0, 6])]);
        assert!(!report.is_fine && report.text.ends_with(line), "{}", report.text);
        assert_eq!(report.json["left_out"], json!([{ "node": "0.0.0.2", "apps": 0, "barriers": 6 }]));
        let report = waited(&[answer(Vec::new(), [0, 6])]);
        assert_eq!((report.is_fine, report.text.as_str()), (false, line));
        let report = waited(&[answer(Vec::new(), [2, 0])]);
        let line = "0.0.0.2: 2 further applications had no room in its answer\n";
        assert_eq!((report.is_fine, report.text.as_str()), (false, line));
        let report = waited(&[answer(Vec::new(), [0, 0])]);
        assert_eq!((report.is_fine, report.text.as_str()), (true, "no application waits\n"));
        assert_eq!(report.json["left_out"], json!([]));
    }

    #[test]
    fn left_out_parties_of_a_barrier_are_counted() {
        let one = BarrierReport { waiting_left_out: 3, missing_left_out: 5, ..barrier() };
        let [.., waits, missing] = meeting_cells("knee", &one);
        assert!(waits.ends_with(", 3 more") && missing.ends_with(", 5 more"), "{waits}; {missing}");
        let json = meeting_json("knee", &one);
        assert_eq!((&json["waiting_left_out"], &json["missing_left_out"]), (&3.into(), &5.into()));
    }

    #[test]
    fn complete_applications_are_shown_despite_left_out_barriers() {
        let answers = [answer(Vec::new(), [0, 6])];
        assert!(Shown::Apps.is_complete(&answers) && Shown::Apps.silent(&answers).is_empty());
        assert_eq!(Shown::Apps.left_out_json(&answers), json!([]));
        let answers = [answer(Vec::new(), [3, 6])];
        assert!(!Shown::Apps.is_complete(&answers));
        assert_eq!(Shown::Apps.left_out_json(&answers), json!([{ "node": "0.0.0.2", "apps": 3 }]));
    }

    fn app(names: &[&str], kinds_left_out: u64) -> AppReport {
        let kind = |name: &&str| KindReport {
            kind: Kind::named(name),
            name: (!name.is_empty()).then(|| (*name).to_owned()),
        };
        AppReport {
            tid: Tid::new(NodeAddress::new(2), AppAddress::new(0x1001)),
            name: None,
            ready: true,
            waits_us: None,
            missing: Vec::new(),
            missing_left_out: 0,
            ended: None,
            kinds: names.iter().map(kind).collect(),
            kinds_left_out,
        }
    }

    #[test]
    fn handled_types_are_bounded_in_the_table_only() {
        assert_eq!(handles(&app(&[], 0)), None);
        assert_eq!(handles(&app(&[], 7)).as_deref(), Some("7 more"));
        assert_eq!(handles(&app(&["gait.step"], 0)).as_deref(), Some("gait.step"));
        let unnamed = Kind::named("").to_string();
        assert_eq!(handles(&app(&[""], 0)), Some(unnamed));
        let many = app(&["gait.step", "gait.a_name_that_is_longer_than_a_cell", "c", "d"], 1);
        let expected = "gait.step, gait.a_name_that_is_longer_th..., 3 more";
        assert_eq!(handles(&many).as_deref(), Some(expected));
        let json = app_json("knee", &many);
        assert_eq!(json["kinds"].as_array().map(Vec::len), Some(4));
        assert_eq!((&json["kinds"][3]["kind"], &json["kinds_left_out"]), (&"d".into(), &1.into()));
    }
}
