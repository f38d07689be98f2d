//! The report of a recording that was played.

use std::fmt::Write as _;

use serde_json::json;

use super::session::{End, Played, Row};
use crate::{
    Report,
    table::{Table, clean, paragraph},
};

/// Maximum number of reasons and of names that are shown.
const SHOWN_MAX: usize = 16;

/// Returns the report.
pub(crate) fn of(played: &Played, is_wide: bool) -> Report {
    let mut text = channels(&played.rows, is_wide);
    let mut line = |line: &str| text += &paragraph(0, &clean(line), is_wide);
    for (why, count) in &played.left_out {
        line(&format!("left out: {count} {}", why.words()));
    }
    if !played.absent.is_empty() {
        let names: Vec<_> = played.absent.iter().take(SHOWN_MAX).map(String::as_str).collect();
        let project = &played.project;
        line(&format!(
            "not there: {}; start them in the project {project} on this host, or give them more time: --wait",
            names.join(", ")
        ));
    }
    if !played.own.is_empty() {
        let names: Vec<_> = played.own.iter().take(SHOWN_MAX).map(String::as_str).collect();
        line(&format!(
            "not there: {}; this command plays these sources itself. Where a program of that name is to receive, choose \
             the other sources: --source",
            names.join(", ")
        ));
    }
    if !played.lost.is_empty() {
        let nodes: Vec<_> = played.lost.iter().take(SHOWN_MAX).map(ToString::to_string).collect();
        let nodes = nodes.join(", ");
        line(&format!(
            "lost nodes: {nodes}; their applications are not known, and may have the names of sources"
        ));
    }
    for (why, count) in played.reasons.iter().take(SHOWN_MAX) {
        line(&format!("rejected: {count}: {why}"));
    }
    played.damage.iter().chain(&played.missing_ends).take(SHOWN_MAX).for_each(|damage| line(damage));
    if let End::Lost(why) = &played.end {
        line(&format!("ended early: the node is lost: {why}"));
    }
    let total = sum(&played.rows);
    let place = if played.is_own { "of its own" } else { "that runs" };
    let (project, sources) = (clean(&played.project), played.sources);
    let _ = writeln!(
        text,
        "{} messages of {sources} sources sent, {} rejected, {} late, {} without a receiver; in the project {project}, \
         by a node {place}",
        total.sent, total.rejected, total.late, total.absent
    );
    let is_lost = matches!(played.end, End::Lost(_));
    let is_fine = total.rejected == 0 && !is_lost && played.damage.is_empty();
    Report { text, json: json_of(played, &total), is_fine }
}

fn channels(rows: &[Row], is_wide: bool) -> String {
    let mut table = Table::new(["CHANNEL", "SENT", "REJECTED", "LATE", "NOT THERE"]).wide(is_wide);
    for row in rows.iter().filter(|row| row.sent + row.rejected + row.absent > 0) {
        let [sent, rejected, late, absent] =
            [row.sent, row.rejected, row.late, row.absent].map(|count| count.to_string());
        table.row([row.topic.clone(), sent, rejected, late, absent]);
    }
    table.text()
}

fn sum(rows: &[Row]) -> Row {
    rows.iter().fold(Row::default(), |sum, row| Row {
        topic: String::new(),
        sent: sum.sent + row.sent,
        rejected: sum.rejected + row.rejected,
        late: sum.late + row.late,
        absent: sum.absent + row.absent,
    })
}

fn json_of(played: &Played, total: &Row) -> serde_json::Value {
    let channels = played.rows.iter().map(|row| {
        let Row { topic, sent, rejected, late, absent } = row;
        json!({ "channel": topic, "sent": sent, "rejected": rejected, "late": late, "absent": absent })
    });
    let left_out: serde_json::Map<_, _> =
        played.left_out.iter().map(|(why, count)| (why.word().to_owned(), json!(count))).collect();
    let end = match &played.end {
        End::Complete => "complete",
        End::Asked => "asked",
        End::Lost(_) => "node_lost",
    };
    json!({
        "project": played.project, "own_node": played.is_own, "end": end, "passes": played.passes,
        "sources": played.sources, "sent": total.sent, "rejected": total.rejected, "late": total.late,
        "absent": total.absent, "not_there": played.absent, "played_itself": played.own, "left_out": left_out,
        "reasons": played.reasons,
        "channels": channels.collect::<Vec<_>>(), "damage": played.damage,
        "missing_ends": played.missing_ends,
        "lost_nodes": played.lost.iter().map(ToString::to_string).collect::<Vec<_>>(),
    })
}

#[cfg(test)]
mod tests {
    use std::collections::{BTreeMap, BTreeSet};

    use sinew::NodeAddress;

    use super::{super::route::LeftOut, *};

    fn played() -> Played {
        let row = Row { topic: "/hip/demo.angle".to_owned(), sent: 9, late: 2, ..Row::default() };
        let silent = Row { topic: "/hip/demo.never".to_owned(), ..Row::default() };
        Played {
            project: "walker".to_owned(),
            is_own: false,
            end: End::Complete,
            passes: 1,
            sources: 1,
            rows: vec![row, silent],
            left_out: BTreeMap::from([(LeftOut::Protected, 3)]),
            absent: BTreeSet::from(["knee".to_owned()]),
            own: BTreeSet::from(["hip".to_owned()]),
            reasons: BTreeMap::new(),
            damage: Vec::new(),
            missing_ends: Vec::new(),
            lost: BTreeSet::new(),
        }
    }

    #[test]
    fn left_out_commands_are_reported_with_their_count() {
        let report = of(&played(), false);
        assert!(report.is_fine, "{}", report.text);
        for words in [
            "left out: 3 protected commands",
            "not there: knee",
            "not there: hip; this command plays",
            "9 messages of 1 sources sent",
        ] {
            assert!(report.text.contains(words), "{words}: {}", report.text);
        }
        assert!(!report.text.contains("demo.never"), "{}", report.text);
        assert_eq!((&report.json["left_out"]["protected"], &report.json["late"]), (&json!(3), &json!(2)));
    }

    #[test]
    fn lost_nodes_are_named() {
        let lost = BTreeSet::from([NodeAddress::from([10, 0, 0, 2])]);
        let report = of(&Played { lost, ..played() }, false);
        assert!(report.is_fine && report.text.contains("lost nodes: 10.0.0.2"), "{}", report.text);
        assert_eq!(report.json["lost_nodes"], json!(["10.0.0.2"]));
    }

    #[test]
    fn rejected_messages_and_a_lost_node_are_findings() {
        let mut rejected = played();
        rejected.rows[0].rejected = 1;
        assert!(!of(&rejected, false).is_fine);
        let lost = Played { end: End::Lost("it was stopped".to_owned()), ..played() };
        let report = of(&lost, false);
        assert!(!report.is_fine && report.text.contains("it was stopped"), "{}", report.text);
    }
}
