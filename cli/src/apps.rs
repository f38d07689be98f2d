//! `sinew apps` and `sinew barriers`: every application, and who waits for whom, at the start and at run time.

use std::collections::{BTreeMap, BTreeSet};

use serde_json::{Value, json};
use sinew::{
    NodeAddress,
    inspect::{AppReport, AppsReport, AskApps, BarrierReport, KindReport, Missing},
};

use crate::{
    Report,
    system::{Answer, Fault, System},
    table::{Table, clean, or_dash, time},
};

/// Payloads of one application that stand in the table.
const KINDS_SHOWN: usize = 2;
/// Characters of the name of each.
const KIND_WIDTH: usize = 32;

/// Asks every node for its applications.
pub(crate) fn show(system: &mut System, is_wide: bool) -> Result<Report, Fault> {
    let answers = ask(system)?;
    let mut table = Table::new(["TID", "NAME", "NODE", "STATE", "HANDLES", "DETAIL"]).wide(is_wide);
    let mut rows = Vec::new();
    for (node, app) in all(&answers) {
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
    let is_ready = all(&answers).all(|(_, app)| app.ready && app.missing.is_empty());
    let is_fine = is_ready && shown.is_complete(&answers);
    let text = table.text() + &shown.silent(&answers);
    let (left_out, silent) = (shown.left_out_json(&answers), silent_json(&answers));
    Ok(Report { text, json: json!({ "apps": rows, "left_out": left_out, "silent": silent }), is_fine })
}

/// Asks every node who waits there, and says who is waited for.
pub(crate) fn barriers(system: &mut System) -> Result<Report, Fault> {
    Ok(who_waits(&ask(system)?))
}

fn who_waits(answers: &[Answer<AppsReport>]) -> Report {
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
    let is_anybody_told = !waiting.is_empty() || !meetings.is_empty();
    let is_fine = !is_anybody_told && shown.is_complete(answers);
    let waiters = waiting.iter().map(|(node, app)| app_json(node, app)).collect::<Vec<_>>();
    let blockers = blocked
        .iter()
        .map(|(name, who)| json!({ "name": name, "since_us": since[name], "why": reasons[name], "blocks": who }))
        .collect::<Vec<_>>();
    let json = json!({
        "waiting": waiters, "missing": blockers, "barriers": meetings.iter().map(|(node, one)| meeting_json(node, one)).collect::<Vec<_>>(),
        "left_out": shown.left_out_json(answers), "silent": silent_json(answers),
    });
    let mut text = if waiting.is_empty() {
        // Where somebody had no room, nobody knows.
        let is_known = !is_anybody_told && shown.left_out(answers).is_empty();
        if is_known { "nobody waits\n".to_owned() } else { String::new() }
    } else {
        let mut table = Table::new(["WAITS", "NODE", "SINCE", "FOR"]);
        for (node, app) in &waiting {
            let since = app.waits_us.map_or_else(|| "lost it".to_owned(), time);
            table.row([or_dash(app.name.clone()), (*node).to_owned(), since, lacks(app)]);
        }
        let mut missing = Table::new(["MISSING", "SINCE", "WHY", "BLOCKS"]);
        for (name, who) in &blocked {
            missing.row([
                (*name).to_owned(),
                or_dash(since[name].map(time)),
                joined(&reasons[name]),
                joined(who),
            ]);
        }
        format!("{}\n{}", table.text(), missing.text())
    };
    if !meetings.is_empty() {
        let mut table = Table::new(["BARRIER", "NODE", "OPENED", "WAITS", "MISSING"]);
        meetings.iter().for_each(|(node, one)| table.row(meeting_cells(node, one)));
        text += &(if text.is_empty() { table.text() } else { format!("\n{}", table.text()) });
    }
    Report { text: text + &shown.silent(answers), json, is_fine }
}

/// The run-time barriers at which somebody waits, each as every node sees it that has somebody there.
fn meetings(answers: &[Answer<AppsReport>]) -> Vec<(&str, &BarrierReport)> {
    let said = answers.iter().filter_map(|answer| answer.said.as_ref().ok());
    said.flat_map(|said| said.barriers.iter().map(|one| (said.name.as_str(), one))).collect()
}

fn meeting_cells(node: &str, one: &BarrierReport) -> [String; 5] {
    let waits = one.waiting.iter().map(|who| format!("{} {}", who.name, time(who.waits_us)));
    let waits: Vec<_> = waits.chain(more(one.waiting_left_out)).collect();
    let missing: Vec<_> = one.missing.iter().map(meeting_lacks).chain(more(one.missing_left_out)).collect();
    let opened = if one.is_phase { "phase".to_owned() } else { one.generation.to_string() };
    [one.name.clone(), node.to_owned(), opened, waits.join(", "), missing.join(", ")]
}

fn meeting_lacks(who: &Missing) -> String {
    let since = who.since_us.map_or_else(String::new, |since| format!("; {}", time(since)));
    format!("{} ({}{since})", who.name, who.why)
}

fn meeting_json(node: &str, one: &BarrierReport) -> Value {
    let waiting = one.waiting.iter().map(|who| json!({ "name": who.name, "waits_us": who.waits_us }));
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

fn ask(system: &mut System) -> Result<Vec<Answer<AppsReport>>, Fault> {
    let here = system.here()?;
    let mut answers = system.ask_all::<AskApps, AppsReport>(&here);
    // Those that only ask are no part of the system that is shown.
    for answer in &mut answers {
        if let Ok(said) = &mut answer.said {
            said.apps.retain(|app| !system.own.contains(&app.tid));
        }
    }
    Ok(answers)
}

/// Each with the name of its node.
fn all(answers: &[Answer<AppsReport>]) -> impl Iterator<Item = (&str, &AppReport)> {
    let said = answers.iter().filter_map(|answer| answer.said.as_ref().ok());
    said.flat_map(|said| said.apps.iter().map(|app| (said.name.as_str(), app)))
}

const fn state(app: &AppReport) -> &'static str {
    match (app.ready, app.waits_us) {
        (true, _) if !app.missing.is_empty() => "ready, lacks",
        (true, _) => "ready",
        (false, Some(_)) => "waits",
        (false, None) => "not ready",
    }
}

/// What it handles, as much of it as a table has room for.
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

/// Of how many there are more than are shown.
fn more(count: u64) -> Option<String> {
    (count > 0).then(|| format!("{count} more"))
}

fn kind_name(of: &KindReport) -> String {
    of.name.clone().unwrap_or_else(|| of.kind.to_string())
}

/// Why it is not ready, in words.
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

/// What a command shows of the answers.
#[derive(Clone, Copy)]
enum Shown {
    /// Applications alone.
    Apps,
    /// Applications that wait, and run-time barriers.
    Barriers,
}

/// What had no room in the answer of a node.
struct LeftOut {
    node: NodeAddress,
    apps: u64,
    barriers: u64,
}

impl Shown {
    /// Of what is shown, for each node that has left anything of it out.
    fn left_out(self, answers: &[Answer<AppsReport>]) -> Vec<LeftOut> {
        let of = |answer: &Answer<AppsReport>| {
            let said = answer.said.as_ref().ok()?;
            let barriers = match self {
                Self::Apps => 0,
                Self::Barriers => said.barriers_left_out,
            };
            let left_out = LeftOut { node: answer.node, apps: said.left_out, barriers };
            (left_out.apps > 0 || left_out.barriers > 0).then_some(left_out)
        };
        answers.iter().filter_map(of).collect()
    }

    fn is_complete(self, answers: &[Answer<AppsReport>]) -> bool {
        answers.iter().all(|answer| answer.said.is_ok()) && self.left_out(answers).is_empty()
    }

    /// The nodes that have not answered, or not all.
    fn silent(self, answers: &[Answer<AppsReport>]) -> String {
        let mut lines = String::new();
        for LeftOut { node, apps, barriers } in self.left_out(answers) {
            for (count, what) in [(apps, "applications"), (barriers, "barriers")] {
                if count > 0 {
                    lines += &format!("{node}: {count} further {what} had no room in its answer\n");
                }
            }
        }
        let silent = answers.iter().filter_map(|answer| Some((answer, answer.said.as_ref().err()?)));
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
        Some(json!({ "node": answer.node.to_string(), "why": answer.said.as_ref().err()? }))
    };
    answers.iter().filter_map(line).collect()
}

#[cfg(test)]
mod tests {
    use sinew::{AppAddress, Tid, inspect::WaitReport, message::Kind};

    use super::*;

    /// A node that says this of its barriers, and has no application.
    fn answer(barriers: Vec<BarrierReport>, [left_out, barriers_left_out]: [u64; 2]) -> Answer<AppsReport> {
        let name = "knee".to_owned();
        let said = AppsReport { name: name.clone(), apps: Vec::new(), left_out, barriers, barriers_left_out };
        Answer { node: NodeAddress::new(2), name, said: Ok(said) }
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

    #[test]
    fn barriers_that_had_no_room_in_an_answer_are_told_with_their_number() {
        let line = "0.0.0.2: 6 further barriers had no room in its answer\n";
        let said = who_waits(&[answer(vec![barrier()], [0, 6])]);
        assert!(!said.is_fine && said.text.ends_with(line), "{}", said.text);
        assert_eq!(said.json["left_out"], json!([{ "node": "0.0.0.2", "apps": 0, "barriers": 6 }]));
        // Who waits at one that is not shown is not nobody.
        let said = who_waits(&[answer(Vec::new(), [0, 6])]);
        assert_eq!((said.is_fine, said.text.as_str()), (false, line));
        let said = who_waits(&[answer(Vec::new(), [2, 0])]);
        let line = "0.0.0.2: 2 further applications had no room in its answer\n";
        assert_eq!((said.is_fine, said.text.as_str()), (false, line));
        let said = who_waits(&[answer(Vec::new(), [0, 0])]);
        assert_eq!((said.is_fine, said.text.as_str()), (true, "nobody waits\n"));
        assert_eq!(said.json["left_out"], json!([]));
    }

    #[test]
    fn those_of_a_barrier_that_had_no_room_are_told_with_their_number() {
        let one = BarrierReport { waiting_left_out: 3, missing_left_out: 5, ..barrier() };
        let [.., waits, missing] = meeting_cells("knee", &one);
        assert!(waits.ends_with(", 3 more") && missing.ends_with(", 5 more"), "{waits}; {missing}");
        let said = meeting_json("knee", &one);
        assert_eq!((&said["waiting_left_out"], &said["missing_left_out"]), (&3.into(), &5.into()));
    }

    #[test]
    fn applications_are_all_told_though_barriers_had_no_room_beside_them() {
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
    fn what_an_application_handles_has_a_bounded_place_in_the_table_and_all_of_it_in_json() {
        assert_eq!(handles(&app(&[], 0)), None);
        assert_eq!(handles(&app(&[], 7)).as_deref(), Some("7 more"));
        assert_eq!(handles(&app(&["gait.step"], 0)).as_deref(), Some("gait.step"));
        let unnamed = Kind::named("").to_string();
        assert_eq!(handles(&app(&[""], 0)), Some(unnamed));
        let many = app(&["gait.step", "gait.a_name_that_is_longer_than_a_cell", "c", "d"], 1);
        let expected = "gait.step, gait.a_name_that_is_longer_th..., 3 more";
        assert_eq!(handles(&many).as_deref(), Some(expected));
        let said = app_json("knee", &many);
        assert_eq!(said["kinds"].as_array().map(Vec::len), Some(4));
        assert_eq!((&said["kinds"][3]["kind"], &said["kinds_left_out"]), (&"d".into(), &1.into()));
    }
}
