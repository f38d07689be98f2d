//! `sinew nodes`: every node, its incarnation, its connections, its clock.

mod real_time;
mod row;
mod stop;

use std::{collections::BTreeSet, fmt::Display};

use serde_json::{Value, json};
use sinew::inspect::{AskNode, IdleReport, LostReport, NodeReport, SourceReport, StallReport, TroubleReport};

use self::{row::Row, stop::Stop};
use crate::{
    Report, output,
    system::{System, SystemError},
    table::{Table, clean, or_dash, time},
    why::lost_in_words,
};

/// Columns of the table.
const COLUMNS: usize = 15;
/// The default columns: node, name, up, state, keys, found by, links, round trip.
const SHORT: &[usize] = &[0, 1, 3, 4, 6, 7, 8, 12];
/// The default columns while the stop of the system is in force: the same, and its confirmations.
const SHORT_STOPPED: &[usize] = &[0, 1, 3, 4, 5, 6, 7, 8, 12];

/// Asks every node. If the socket `is_searched`, nodes of other projects may be meant: they are noted.
pub(crate) fn show(system: &mut System, is_wide: bool, is_searched: bool) -> Result<Report, SystemError> {
    let here = system.here()?;
    if is_searched
        && let Some(note) = others_note(&system.path, &here.project, &system.other_projects(&here.project))
    {
        output::note(note);
    }
    let answers = system.ask_all::<AskNode, NodeReport>(&here);
    let stop = Stop::ask(system, &answers);
    let rows: Vec<_> = answers.iter().map(|answer| Row::of(&here, answer)).collect();
    let lost: Vec<_> =
        here.lost.iter().filter(|lost| rows.iter().all(|row| row.answer.node != lost.node)).collect();
    // A node that has left in order is not missing.
    let none_is_missed = here.lost.iter().all(|lost| lost.why == "left");
    let are_all_told = here.left_out == 0 && here.lost_left_out == 0;
    let is_fine = rows.iter().all(Row::is_fine) && are_all_told && none_is_missed && stop.is_none();
    let json = json!({
        "through": system.path,
        "here": here.node.to_string(),
        "stop": stop.as_ref().map(Stop::json),
        "nodes": rows.iter().map(Row::json).collect::<Vec<_>>(),
        "sources": here.sources.iter().map(source_json).collect::<Vec<_>>(),
        "lost": here.lost.iter().map(lost_json).collect::<Vec<_>>(),
        "left_out": here.left_out,
        "lost_left_out": here.lost_left_out,
    });
    Ok(Report { text: text(&here, &rows, &lost, (stop.as_ref(), is_wide)), json, is_fine })
}

/// Returns which of several projects of this host is shown.
fn others_note(path: &str, project: &str, others: &BTreeSet<String>) -> Option<String> {
    let names: Vec<_> = others.iter().map(|name| clean(name)).collect();
    let (path, project) = (clean(path), clean(project));
    (!names.is_empty()).then(|| {
        format!(
            "sinew: at {path}, project {project}; {} other project(s) here: {}; choose with --socket",
            names.len(),
            names.join(", ")
        )
    })
}

fn lost_cells(lost: &LostReport, stop: String) -> [String; COLUMNS] {
    let dash = || "-".to_owned();
    let found_by = or_dash(Some(lost.found_by.join(", ")).filter(|words| !words.is_empty()));
    let incarnation = lost.incarnation.to_string();
    [
        lost.node.to_string(),
        lost.name.clone(),
        incarnation,
        dash(),
        "lost".to_owned(),
        stop,
        dash(),
        found_by,
        dash(),
        dash(),
        dash(),
        or_dash(lost.bound_us.map(time)),
        dash(),
        dash(),
        dash(),
    ]
}

fn lost_json(lost: &LostReport) -> Value {
    json!({
        "node": lost.node.to_string(), "name": lost.name, "incarnation": lost.incarnation.0, "lost_us": lost.lost_us,
        "why": lost.why, "silent_us": lost.silent_us, "bound_us": lost.bound_us, "found_by": lost.found_by,
    })
}

fn source_json(of: &SourceReport) -> Value {
    let SourceReport { source, is_on, places, found } = of;
    json!({ "source": source, "on": is_on, "places": places, "found": found })
}

/// Returns the discovery sources of the entry node, and the number of nodes found by each.
fn sources(here: &NodeReport) -> Option<String> {
    let source = |of: &SourceReport| {
        let SourceReport { source, is_on, places, found } = of;
        let source = clean(source);
        match (is_on, places, found) {
            (false, 0, 0) => format!("{source} off"),
            (true, 1.., 0) => format!("{source} 0 (asks at {places})"),
            _ => format!("{source} {found}"),
        }
    };
    let all: Vec<_> = here.sources.iter().map(source).collect();
    (!all.is_empty())
        .then(|| format!("{} {} finds others by: {}\n", here.node, clean(&here.name), all.join(", ")))
}

/// Returns how often the node itself got no CPU, if it did.
fn own_stalls(report: &NodeReport) -> Option<String> {
    stalls_in_words(report.own_stalls, &format_args!("{} {}", report.node, clean(&report.name)))
}

fn stalls_in_words(stalls: Option<StallReport>, node: &dyn Display) -> Option<String> {
    let StallReport { count, longest_us, last_us } = stalls?;
    let times = if count == 1 { "once".to_owned() } else { format!("{count} times") };
    let (longest, last) = (time(longest_us), time(last_us?));
    Some(format!(
        "{node}: it got no processor {times}, for {longest} at most, last {last} ago; it reported losses later by that. `sinew doctor` on its host \
         looks for the cause\n"
    ))
}

/// Returns the layers and applications of a node in trouble, one per line.
fn troubles(row: &Row<'_>) -> String {
    let Some((count, named)) = row.troubles() else { return String::new() };
    let (node, name) = (row.answer.node, clean(row.name()));
    let mut lines = String::new();
    for TroubleReport { app, name: what, trouble, since_us } in named {
        let (what, trouble, since) = (clean(what), clean(trouble), time(*since_us));
        lines += &format!("{node} {name}: {what} ({app}) does not get on: {trouble} for {since}\n");
    }
    let unnamed = (count as usize).saturating_sub(named.len());
    if unnamed > 0 {
        lines += &format!("{node} {name}: {unnamed} further ones do not get on\n");
    }
    lines
}

/// Returns the clients of a node that do not read, one per line.
fn idle(row: &Row<'_>) -> String {
    let Some((count, named)) = row.idle() else { return String::new() };
    let (node, name) = (row.answer.node, clean(row.name()));
    let mut lines = String::new();
    for IdleReport { app, name: client, since_us } in named {
        let (client, since) = (clean(client), time(*since_us));
        lines += &format!(
            "{node} {name}: client {client} ({app}) reads none of its waiting messages, for {since}\n"
        );
    }
    let unnamed = (count as usize).saturating_sub(named.len());
    if unnamed > 0 {
        lines += &format!("{node} {name}: {unnamed} further clients take nothing of what waits for them\n");
    }
    lines
}

fn text(
    here: &NodeReport,
    rows: &[Row<'_>],
    lost: &[&LostReport],
    (stop, is_wide): (Option<&Stop>, bool),
) -> String {
    let heading: [_; COLUMNS] = [
        "NODE",
        "NAME",
        "INCARNATION",
        "UP",
        "STATE",
        "STOP",
        "KEYS",
        "FOUND BY",
        "LINKS",
        "ROUTES",
        "ASKED EVERY",
        "LOST WITHIN",
        "ROUND TRIP",
        "CLOCK",
        "DRIFT",
    ];
    let lost_row = |lost: &&LostReport| lost_cells(lost, stop::cell(stop, lost.node, None));
    let cells = rows.iter().map(|row| row.cells(stop)).chain(lost.iter().map(lost_row));
    let mut text = stop.map(Stop::lines).unwrap_or_default();
    text += &if is_wide {
        let mut table = Table::new(heading).wide(true);
        cells.for_each(|cells| table.row(cells));
        table.text()
    } else {
        let columns = if stop.is_some() { SHORT_STOPPED } else { SHORT };
        let headings: Vec<_> = columns.iter().map(|&column| heading[column]).collect();
        let mut table = Table::of(&headings).whole(&["NODE", "UP", "ROUND TRIP"]);
        for cells in cells {
            table.add(&columns.iter().map(|&column| cells[column].clone()).collect::<Vec<_>>());
        }
        table.text()
    };
    text.extend(sources(here));
    for lost in &here.lost {
        let (seen, remedy) = lost_in_words(lost);
        text += &format!("{} {}: {seen}; {remedy}\n", lost.node, clean(&lost.name));
    }
    for row in rows {
        if let Err(why) = &row.answer.result {
            text += &format!("{} {}: {}\n", row.answer.node, clean(row.name()), clean(why));
        }
    }
    for row in rows {
        text += &troubles(row);
        text += &idle(row);
    }
    let reports = rows.iter().filter_map(|row| row.answer.result.as_ref().ok());
    text.extend(reports.clone().filter_map(own_stalls));
    text.extend(reports.filter_map(real_time::line));
    for (count, what) in [(here.left_out, "nodes"), (here.lost_left_out, "lost nodes")] {
        if count > 0 {
            text += &format!("{count} further {what} had no room in the answer of {}\n", here.node);
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use sinew::{
        AppAddress, NodeAddress, Tid,
        address::Incarnation,
        inspect::{LinkReport, PeerReport},
    };

    use super::*;
    use crate::{
        security,
        system::Answer,
        table::{
            WIDTH,
            tests::{long_name, widest},
        },
    };

    fn answer(report: NodeReport) -> Answer<NodeReport> {
        Answer { node: report.node, name: "as others call it".to_owned(), result: Ok(report) }
    }

    #[test]
    fn troubled_applications_have_a_line_each() {
        let node = NodeAddress::from([192, 168, 0, 7]);
        let app = Tid::new(node, AppAddress::new(0x1000));
        let (name, trouble) = ("drive".to_owned(), "stalled".to_owned());
        let (troubled, named) = (3, vec![TroubleReport { app, name, trouble, since_us: 2_500_000 }]);
        let lines = [
            format!("192.168.0.7 knee: drive ({app}) does not get on: stalled for 2.5 s\n"),
            "192.168.0.7 knee: 2 further ones do not get on\n".to_owned(),
        ];
        // As another node reports it, and as it reports itself.
        let plain = answer(security::tests::node_report("knee", 7, None));
        let seen = PeerReport { troubled, troubles: named.clone(), ..PeerReport::lost(node, Incarnation(1)) };
        let of_peer = Row { answer: &plain, seen: Some(&seen) };
        let own =
            answer(NodeReport { troubled, troubles: named, ..security::tests::node_report("knee", 7, None) });
        for row in [of_peer, Row { answer: &own, seen: None }] {
            assert_eq!((troubles(&row), row.is_fine()), (lines.concat(), false));
            let json = row.json();
            assert_eq!((&json["troubled"], &json["troubles"][0]["name"]), (&json!(3), &json!("drive")));
        }
        let row = Row { answer: &plain, seen: None };
        assert_eq!((troubles(&row), row.is_fine()), (String::new(), true));
    }

    #[test]
    fn table_fits_a_terminal_for_any_names_and_states() {
        let name = long_name();
        let up_us = 90_000_000_000;
        let here =
            NodeReport { up_us, ..security::tests::node_report(&name, 7, security::tests::open(false)) };
        let links = ["Control", "Stream", "Bulk"].map(|class| LinkReport {
            class: class.to_owned(),
            is_up: false,
            waiting: 1,
            unconfirmed: 1,
        });
        let found_by = ["seed", "multicast", "mdns", "remembered"].map(str::to_owned).to_vec();
        let seen = PeerReport {
            links: links.to_vec(),
            found_by,
            round_trip_ns: Some(1_234_567_890),
            ..PeerReport::lost(here.node, Incarnation(u64::MAX))
        };
        let answer = answer(here.clone());
        let rows = [Row { answer: &answer, seen: Some(&seen) }];
        let shown = text(&here, &rows, &[], (None, false));
        assert!(widest(&shown) <= WIDTH && shown.contains("192.168.0.7  "), "{shown}");
        assert!(widest(&text(&here, &rows, &[], (None, true))) > WIDTH);
    }

    #[test]
    fn other_projects_are_noted_only_if_present() {
        let note = |names: &[&str]| {
            let others = names.iter().map(|name| (*name).to_owned()).collect();
            others_note("/tmp/sinew-knee.sock", "leg", &others)
        };
        assert_eq!(note(&[]), None);
        let words = "sinew: at /tmp/sinew-knee.sock, project leg; 2 other project(s) here: arm, hand; choose with --socket";
        assert_eq!(note(&["arm", "hand"]).as_deref(), Some(words));
    }

    #[test]
    fn left_out_nodes_are_counted() {
        let here =
            NodeReport { left_out: 2, lost_left_out: 3, ..security::tests::node_report("knee", 7, None) };
        let shown = text(&here, &[], &[], (None, false));
        let lines = "2 further nodes had no room in the answer of 192.168.0.7\n\
                     3 further lost nodes had no room in the answer of 192.168.0.7\n";
        assert!(shown.ends_with(lines), "{shown}");
    }

    #[test]
    fn idle_clients_have_a_line_each() {
        let node = NodeAddress::from([192, 168, 0, 7]);
        let app = Tid::new(node, AppAddress::new(0x1000));
        let (idle_clients, named) =
            (4, vec![IdleReport { app, name: "hand".to_owned(), since_us: 2_900_000 }]);
        let lines = [
            format!("192.168.0.7 knee: client hand ({app}) reads none of its waiting messages, for 2.9 s\n"),
            "192.168.0.7 knee: 3 further clients take nothing of what waits for them\n".to_owned(),
        ];
        // As another node reports it, and as it reports itself.
        let plain = answer(security::tests::node_report("knee", 7, None));
        let seen = PeerReport { idle_clients, idle: named.clone(), ..PeerReport::lost(node, Incarnation(1)) };
        let of_peer = Row { answer: &plain, seen: Some(&seen) };
        let own =
            answer(NodeReport { idle_clients, idle: named, ..security::tests::node_report("knee", 7, None) });
        for row in [of_peer, Row { answer: &own, seen: None }] {
            assert_eq!(idle(&row), lines.concat());
            assert_eq!(
                (&row.json()["idle_clients"], &row.json()["idle"][0]["name"]),
                (&json!(4), &json!("hand"))
            );
        }
        assert_eq!(idle(&Row { answer: &plain, seen: None }), "");
        let silent = Answer { node, name: "knee".to_owned(), result: Err("no answer".to_owned()) };
        let row = Row { answer: &silent, seen: None };
        assert_eq!((idle(&row), &row.json()["idle_clients"]), (String::new(), &Value::Null));
    }

    #[test]
    fn sources_show_results_and_distinguish_off_from_none() {
        let source = |source: &str, is_on, places, found| SourceReport {
            source: source.to_owned(),
            is_on,
            places,
            found,
        };
        let sources = vec![
            source("seed", false, 0, 0),
            source("multicast", true, 3, 3),
            source("mdns", true, 0, 0),
            source("remembered", true, 2, 0),
        ];
        let here = NodeReport { sources, ..security::tests::node_report("knee", 7, None) };
        let words =
            "192.168.0.7 knee finds others by: seed off, multicast 3, mdns 0, remembered 0 (asks at 2)\n";
        assert_eq!(super::sources(&here).as_deref(), Some(words));
        assert_eq!(super::sources(&security::tests::node_report("old", 7, None)), None);
    }

    #[test]
    fn starved_node_is_reported() {
        let described = |stalls: Option<(u64, u64)>| {
            let report = |(count, longest_us)| StallReport { count, longest_us, last_us: Some(5_000_000) };
            stalls_in_words(stalls.map(report), &"10.0.0.7 knee")
        };
        assert_eq!((described(None), stalls_in_words(Some(StallReport::default()), &"it")), (None, None));
        let words = described(Some((3, 1_200_000))).expect("it was starved");
        assert!(
            words
                .starts_with("10.0.0.7 knee: it got no processor 3 times, for 1.2 s at most, last 5.0 s ago"),
            "{words}"
        );
        assert!(described(Some((1, 1_200_000))).expect("it was starved").contains("no processor once, for"));
    }
}
