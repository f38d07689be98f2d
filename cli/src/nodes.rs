//! `sinew nodes`: every node, its life, what connects it, its clock.

use std::fmt::Display;

use serde_json::{Value, json};
use sinew::inspect::{
    AskNode, IdleReport, LinkReport, LostReport, NodeReport, PeerReport, RouteReport, SourceReport,
    StallReport, TroubleReport,
};

use crate::{
    Report, security,
    system::{Answer, Fault, System},
    table::{Table, clean, or_dash, time},
    why::lost_in_words,
};

/// Columns of the table.
const COLUMNS: usize = 14;
/// Those that are shown unless all are asked for: node, name, up, state, keys, found by, links, round trip.
const SHORT: [usize; 8] = [0, 1, 3, 4, 5, 6, 7, 11];

/// Asks every node.
pub(crate) fn show(system: &mut System, is_wide: bool) -> Result<Report, Fault> {
    let here = system.here()?;
    let answers = system.ask_all::<AskNode, NodeReport>(&here);
    let rows: Vec<_> = answers.iter().map(|answer| Row::of(&here, answer)).collect();
    let lost: Vec<_> =
        here.lost.iter().filter(|lost| rows.iter().all(|row| row.answer.node != lost.node)).collect();
    // Who has left in order is missed by nobody.
    let none_is_missed = here.lost.iter().all(|lost| lost.why == "left");
    let are_all_told = here.left_out == 0 && here.lost_left_out == 0;
    let is_fine = rows.iter().all(Row::is_fine) && are_all_told && none_is_missed;
    let json = json!({
        "through": system.path,
        "here": here.node.to_string(),
        "nodes": rows.iter().map(Row::json).collect::<Vec<_>>(),
        "sources": here.sources.iter().map(source_json).collect::<Vec<_>>(),
        "lost": here.lost.iter().map(lost_json).collect::<Vec<_>>(),
        "left_out": here.left_out,
        "lost_left_out": here.lost_left_out,
    });
    Ok(Report { text: text(&here, &rows, &lost, is_wide), json, is_fine })
}

/// A node: what it says, and what the node says through which we came.
struct Row<'a> {
    answer: &'a Answer<NodeReport>,
    seen: Option<&'a PeerReport>,
}

impl<'a> Row<'a> {
    fn of(here: &'a NodeReport, answer: &'a Answer<NodeReport>) -> Self {
        Self { answer, seen: here.peers.iter().find(|peer| peer.node == answer.node) }
    }

    fn name(&self) -> &str {
        self.answer.said.as_ref().map_or(&self.answer.name, |said| &said.name)
    }

    fn life(&self) -> Option<u64> {
        let said = self.answer.said.as_ref().ok().map(|said| said.incarnation.0);
        said.or_else(|| self.seen.map(|seen| seen.incarnation.0))
    }

    fn state(&self) -> &'static str {
        match (&self.answer.said, self.seen) {
            (Ok(said), _) if said.stopping => "stops",
            (Ok(_), None) => "here",
            (Ok(_), Some(_)) => "ready",
            (Err(_), Some(seen)) if !seen.is_there => "lost",
            (Err(_), _) => "does not answer",
        }
    }

    fn is_fine(&self) -> bool {
        let is_linked = self.seen.is_none_or(|seen| seen.links.iter().all(|link| link.is_up));
        let gets_on = self.troubles().is_none_or(|(count, _)| count == 0);
        self.answer.said.as_ref().is_ok_and(|said| !said.stopping) && is_linked && gets_on
    }

    fn links(&self) -> String {
        let Some(seen) = self.seen else { return "-".to_owned() };
        let link = |link: &LinkReport| format!("{} {}", link.class, if link.is_up { "up" } else { "DOWN" });
        if seen.links.is_empty() {
            return "none".to_owned();
        }
        if seen.links.iter().all(|link| link.is_up) && seen.links.len() > 1 {
            return format!("{} up", seen.links.len());
        }
        seen.links.iter().map(link).collect::<Vec<_>>().join(", ")
    }

    fn clock(&self) -> String {
        let Some((offset, bound)) = self.seen.and_then(|seen| seen.offset_ns.zip(seen.offset_bound_ns))
        else {
            return "-".to_owned();
        };
        format!("{:+.1} us +- {:.1} us", offset as f64 / 1e3, bound as f64 / 1e3)
    }

    /// How fast its clock leaves that of the node through which we came.
    fn drift(&self) -> String {
        let drift = self.seen.and_then(|seen| seen.drift_ppb.zip(seen.drift_bound_ppb));
        or_dash(
            drift
                .map(|(ppb, bound)| format!("{:+.1} ppm +- {:.1} ppm", ppb as f64 / 1e3, bound as f64 / 1e3)),
        )
    }

    fn found_by(&self) -> String {
        or_dash(self.seen.map(|seen| seen.found_by.join(", ")).filter(|words| !words.is_empty()))
    }

    /// How many of its layers and applications do not get on, and the first of them: as the node knows through which we came, and of that one
    /// as it says.
    fn troubles(&self) -> Option<(u32, &[TroubleReport])> {
        let seen = self.seen.map(|seen| (seen.troubled, &seen.troubles[..]));
        seen.or_else(|| self.answer.said.as_ref().ok().map(|said| (said.troubled, &said.troubles[..])))
    }

    /// How many of its clients take nothing, and the first of them: as the node knows through which we came, and of that one as it says.
    fn idle(&self) -> Option<(u32, &[IdleReport])> {
        let seen = self.seen.map(|seen| (seen.idle_clients, &seen.idle[..]));
        seen.or_else(|| self.answer.said.as_ref().ok().map(|said| (said.idle_clients, &said.idle[..])))
    }

    fn cells(&self) -> [String; COLUMNS] {
        let said = self.answer.said.as_ref().ok();
        [
            self.answer.node.to_string(),
            self.name().to_owned(),
            or_dash(self.life().map(|life| life.to_string())),
            or_dash(said.map(|said| time(said.up_us))),
            self.state().to_owned(),
            or_dash(said.map(security::cell)),
            self.found_by(),
            self.links(),
            or_dash(self.seen.filter(|seen| seen.is_there).map(routes)),
            or_dash(self.seen.and_then(|seen| seen.asked_every_us).map(time)),
            or_dash(self.seen.and_then(|seen| seen.bound_us).map(time)),
            or_dash(self.seen.and_then(|seen| seen.round_trip_ns).map(|ns| time(ns / 1_000))),
            self.clock(),
            self.drift(),
        ]
    }

    fn json(&self) -> Value {
        let said = self.answer.said.as_ref();
        let seen = self.seen;
        json!({
            "node": self.answer.node.to_string(),
            "name": self.name(),
            "incarnation": self.life(),
            "state": self.state(),
            "fault": said.err(),
            "up_us": said.ok().map(|said| said.up_us),
            "pid": said.ok().map(|said| said.pid),
            "security": said.ok().map(security::json),
            "version": said.ok().map(|said| &said.version),
            "refused": said.ok().map(|said| said.refused),
            "own_stalls": said.ok().and_then(|said| said.own_stalls).map(|stalls| stalls_json(&stalls)),
            "found_us": seen.and_then(|seen| seen.found_us),
            "found_by": seen.map(|seen| &seen.found_by),
            "silent_us": seen.and_then(|seen| seen.silent_us),
            "missed": seen.map(|seen| seen.missed),
            "asked_every_us": seen.and_then(|seen| seen.asked_every_us),
            "bound_us": seen.and_then(|seen| seen.bound_us),
            "troubled": self.troubles().map(|(count, _)| count),
            "troubles": self.troubles().map(|(_, named)| named.iter().map(trouble_json).collect::<Vec<_>>()),
            "idle_clients": self.idle().map(|(count, _)| count),
            "idle": self.idle().map(|(_, named)| named.iter().map(idle_json).collect::<Vec<_>>()),
            "routes": seen.map(|seen| seen.routes.iter().map(route_json).collect::<Vec<_>>()),
            "round_trip_ns": seen.and_then(|seen| seen.round_trip_ns),
            "clock_offset_ns": seen.and_then(|seen| seen.offset_ns),
            "clock_offset_bound_ns": seen.and_then(|seen| seen.offset_bound_ns),
            "clock_drift_ppb": seen.and_then(|seen| seen.drift_ppb),
            "clock_drift_bound_ppb": seen.and_then(|seen| seen.drift_bound_ppb),
            "links": seen.map(|seen| seen.links.iter().map(link_json).collect::<Vec<_>>()),
        })
    }
}

fn link_json(link: &LinkReport) -> Value {
    let LinkReport { class, is_up, waiting, unconfirmed } = link;
    json!({ "class": class, "up": is_up, "waiting": waiting, "unconfirmed": unconfirmed })
}

/// On how many ways NDL asks it, and how many of them answer, if not all do.
fn routes(seen: &PeerReport) -> String {
    let (all, answer) = (seen.routes.len(), seen.routes.iter().filter(|route| route.missed == 0).count());
    if all == answer { all.to_string() } else { format!("{answer} of {all}") }
}

fn route_json(of: &RouteReport) -> Value {
    let RouteReport { here, there, missed, round_trip_ns } = of;
    json!({ "here": here, "there": there, "missed": missed, "round_trip_ns": round_trip_ns })
}

fn trouble_json(of: &TroubleReport) -> Value {
    let TroubleReport { app, name, trouble, since_us } = of;
    json!({ "app": app.to_string(), "name": name, "trouble": trouble, "since_us": since_us })
}

fn idle_json(of: &IdleReport) -> Value {
    let IdleReport { app, name, since_us } = of;
    json!({ "app": app.to_string(), "name": name, "since_us": since_us })
}

fn lost_cells(lost: &LostReport) -> [String; COLUMNS] {
    let dash = || "-".to_owned();
    let found_by = or_dash(Some(lost.found_by.join(", ")).filter(|words| !words.is_empty()));
    let life = lost.incarnation.to_string();
    [
        lost.node.to_string(),
        lost.name.clone(),
        life,
        dash(),
        "lost".to_owned(),
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

/// Who tells the node through which we came where to ask, and what came of that.
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

fn stalls_json(of: &StallReport) -> Value {
    let StallReport { count, longest_us, last_us } = of;
    json!({ "count": count, "longest_us": longest_us, "last_us": last_us })
}

/// That a node was starved itself, if it was.
fn own_stalls(said: &NodeReport) -> Option<String> {
    stalls_in_words(said.own_stalls, &format_args!("{} {}", said.node, clean(&said.name)))
}

fn stalls_in_words(stalls: Option<StallReport>, node: &dyn Display) -> Option<String> {
    let StallReport { count, longest_us, last_us } = stalls?;
    let times = if count == 1 { "once".to_owned() } else { format!("{count} times") };
    let (longest, last) = (time(longest_us), time(last_us?));
    Some(format!(
        "{node}: it got no processor {times}, for {longest} at most, last {last} ago; it told of losses later by that. `sinew doctor` on its host \
         looks for the cause\n"
    ))
}

/// What of a node does not get on, a line each.
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

/// Which clients of a node take nothing, a line each.
fn idle(row: &Row<'_>) -> String {
    let Some((count, named)) = row.idle() else { return String::new() };
    let (node, name) = (row.answer.node, clean(row.name()));
    let mut lines = String::new();
    for IdleReport { app, name: who, since_us } in named {
        let (who, since) = (clean(who), time(*since_us));
        lines +=
            &format!("{node} {name}: client {who} ({app}) takes nothing of what waits for it, for {since}\n");
    }
    let unnamed = (count as usize).saturating_sub(named.len());
    if unnamed > 0 {
        lines += &format!("{node} {name}: {unnamed} further clients take nothing of what waits for them\n");
    }
    lines
}

fn text(here: &NodeReport, rows: &[Row<'_>], lost: &[&LostReport], is_wide: bool) -> String {
    let heading: [_; COLUMNS] = [
        "NODE",
        "NAME",
        "INCARNATION",
        "UP",
        "STATE",
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
    let cells = rows.iter().map(Row::cells).chain(lost.iter().map(|lost| lost_cells(lost)));
    let mut text = if is_wide {
        let mut table = Table::new(heading).wide(true);
        cells.for_each(|cells| table.row(cells));
        table.text()
    } else {
        let mut table = Table::new(SHORT.map(|column| heading[column]));
        cells.for_each(|cells| table.row(SHORT.map(|column| cells[column].clone())));
        table.text()
    };
    text.extend(sources(here));
    for lost in &here.lost {
        let (seen, mend) = lost_in_words(lost);
        text += &format!("{} {}: {seen}; {mend}\n", lost.node, clean(&lost.name));
    }
    for row in rows {
        if let Err(why) = &row.answer.said {
            text += &format!("{} {}: {}\n", row.answer.node, clean(row.name()), clean(why));
        }
    }
    for row in rows {
        text += &troubles(row);
        text += &idle(row);
    }
    let said = rows.iter().filter_map(|row| row.answer.said.as_ref().ok());
    text.extend(said.filter_map(own_stalls));
    for (count, what) in [(here.left_out, "nodes"), (here.lost_left_out, "lost nodes")] {
        if count > 0 {
            text += &format!("{count} further {what} had no room in the answer of {}\n", here.node);
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use sinew::{AppAddress, NodeAddress, Tid, address::Incarnation};

    use super::*;

    fn answer(said: NodeReport) -> Answer<NodeReport> {
        Answer { node: said.node, name: "as others call it".to_owned(), said: Ok(said) }
    }

    #[test]
    fn what_of_a_node_does_not_get_on_is_a_finding_with_a_line_each_also_of_the_one_through_which_we_came() {
        let node = NodeAddress::from([192, 168, 0, 7]);
        let app = Tid::new(node, AppAddress::new(0x1000));
        let (name, trouble) = ("drive".to_owned(), "stalled".to_owned());
        let (troubled, named) = (3, vec![TroubleReport { app, name, trouble, since_us: 2_500_000 }]);
        let lines = [
            format!("192.168.0.7 knee: drive ({app}) does not get on: stalled for 2.5 s\n"),
            "192.168.0.7 knee: 2 further ones do not get on\n".to_owned(),
        ];
        // As another node knows it, and as it says itself.
        let plain = answer(security::tests::said("knee", 7, None));
        let seen = PeerReport { troubled, troubles: named.clone(), ..PeerReport::lost(node, Incarnation(1)) };
        let of_peer = Row { answer: &plain, seen: Some(&seen) };
        let own = answer(NodeReport { troubled, troubles: named, ..security::tests::said("knee", 7, None) });
        for row in [of_peer, Row { answer: &own, seen: None }] {
            assert_eq!((troubles(&row), row.is_fine()), (lines.concat(), false));
            let json = row.json();
            assert_eq!((&json["troubled"], &json["troubles"][0]["name"]), (&json!(3), &json!("drive")));
        }
        let row = Row { answer: &plain, seen: None };
        assert_eq!((troubles(&row), row.is_fine()), (String::new(), true));
    }

    #[test]
    fn nodes_that_had_no_room_in_the_answer_are_told_with_their_number() {
        let here = NodeReport { left_out: 2, lost_left_out: 3, ..security::tests::said("knee", 7, None) };
        let said = text(&here, &[], &[], false);
        let lines = "2 further nodes had no room in the answer of 192.168.0.7\n\
                     3 further lost nodes had no room in the answer of 192.168.0.7\n";
        assert!(said.ends_with(lines), "{said}");
    }

    #[test]
    fn clients_that_take_nothing_have_a_line_each_those_of_the_node_through_which_we_came_too() {
        let node = NodeAddress::from([192, 168, 0, 7]);
        let app = Tid::new(node, AppAddress::new(0x1000));
        let (idle_clients, named) =
            (4, vec![IdleReport { app, name: "hand".to_owned(), since_us: 2_900_000 }]);
        let lines = [
            format!("192.168.0.7 knee: client hand ({app}) takes nothing of what waits for it, for 2.9 s\n"),
            "192.168.0.7 knee: 3 further clients take nothing of what waits for them\n".to_owned(),
        ];
        // As another node knows it, and as it says itself.
        let plain = answer(security::tests::said("knee", 7, None));
        let seen = PeerReport { idle_clients, idle: named.clone(), ..PeerReport::lost(node, Incarnation(1)) };
        let of_peer = Row { answer: &plain, seen: Some(&seen) };
        let own = answer(NodeReport { idle_clients, idle: named, ..security::tests::said("knee", 7, None) });
        for row in [of_peer, Row { answer: &own, seen: None }] {
            assert_eq!(idle(&row), lines.concat());
            assert_eq!(
                (&row.json()["idle_clients"], &row.json()["idle"][0]["name"]),
                (&json!(4), &json!("hand"))
            );
        }
        assert_eq!(idle(&Row { answer: &plain, seen: None }), "");
        let silent = Answer { node, name: "knee".to_owned(), said: Err("no answer".to_owned()) };
        let row = Row { answer: &silent, seen: None };
        assert_eq!((idle(&row), &row.json()["idle_clients"]), (String::new(), &Value::Null));
    }

    #[test]
    fn each_source_says_what_came_of_it_and_what_is_off_is_told_from_what_has_found_nobody() {
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
        let here = NodeReport { sources, ..security::tests::said("knee", 7, None) };
        let words =
            "192.168.0.7 knee finds others by: seed off, multicast 3, mdns 0, remembered 0 (asks at 2)\n";
        assert_eq!(super::sources(&here).as_deref(), Some(words));
        assert_eq!(super::sources(&security::tests::said("old", 7, None)), None);
    }

    #[test]
    fn a_node_that_was_starved_itself_says_so_and_another_one_does_not() {
        let said = |stalls: Option<(u64, u64)>| {
            let report = |(count, longest_us)| StallReport { count, longest_us, last_us: Some(5_000_000) };
            stalls_in_words(stalls.map(report), &"10.0.0.7 knee")
        };
        assert_eq!((said(None), stalls_in_words(Some(StallReport::default()), &"it")), (None, None));
        let words = said(Some((3, 1_200_000))).expect("it was starved");
        assert!(
            words
                .starts_with("10.0.0.7 knee: it got no processor 3 times, for 1.2 s at most, last 5.0 s ago"),
            "{words}"
        );
        assert!(said(Some((1, 1_200_000))).expect("it was starved").contains("no processor once, for"));
    }

    #[test]
    fn routes_are_counted_and_those_that_answer_where_not_all_do() {
        let route = |missed| RouteReport {
            here: "10.0.0.1:1".to_owned(),
            there: "10.0.0.7:1".to_owned(),
            missed,
            round_trip_ns: None,
        };
        let of = |missed: &[u32]| {
            let routes = missed.iter().map(|missed| route(*missed)).collect();
            routes_of(routes)
        };
        assert_eq!([of(&[]), of(&[0]), of(&[0, 0]), of(&[0, 3])], ["0", "1", "2", "1 of 2"]);
    }

    fn routes_of(routes: Vec<RouteReport>) -> String {
        super::routes(&PeerReport {
            routes,
            ..PeerReport::lost(NodeAddress::from([10, 0, 0, 7]), Incarnation(1))
        })
    }
}
