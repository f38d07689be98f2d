//! `sinew tree`: the supervision tree of each node, with restarts.

use serde_json::{Value, json};
use sinew::inspect::{AskTree, TreeLine, TreeReport};

use crate::{
    Report,
    system::{Answer, System, SystemError, chosen},
    table::{clean, paragraph, time},
    unknown::Target,
};

/// Asks every node, or the node with this name.
pub(crate) fn show(system: &mut System, wanted: Option<&str>, is_wide: bool) -> Result<Report, SystemError> {
    let here = system.here()?;
    let Some(nodes) = chosen(&here, wanted) else {
        return Err(system.unknown(wanted.unwrap_or_default(), Target::Node));
    };
    let answers = system.ask_these::<AskTree, TreeReport>(nodes);
    let is_fine =
        answers.iter().all(|answer| answer.result.as_ref().is_ok_and(|report| report.left_out == 0));
    let text = answers.iter().map(|answer| text(answer, is_wide)).collect::<Vec<_>>().join("\n");
    Ok(Report { text, json: json!({ "nodes": answers.iter().map(node_json).collect::<Vec<_>>() }), is_fine })
}

fn text(answer: &Answer<TreeReport>, is_wide: bool) -> String {
    let report = match &answer.result {
        Ok(report) => report,
        Err(why) => return format!("{} {}: {}\n", answer.node, clean(&answer.name), clean(why)),
    };
    let mut text = format!("{} {}\n", answer.node, clean(&report.name));
    for line in &report.lines {
        // Bounded: an invented depth of another node cannot move the text out of the window.
        let indent = 3 * (line.depth.min(16) as usize + 1);
        text += &paragraph(indent, &clean(&in_words(line)), is_wide);
    }
    if report.left_out > 0 {
        text += &format!("   {} further ones had no room in its answer\n", report.left_out);
    }
    text
}

fn in_words(line: &TreeLine) -> String {
    let mut words = format!("{}: {} for {}", line.name, line.state, time(line.since_us));
    let life = format!("life {}, {} restarts", line.life, line.restarts);
    let parts = [
        line.strategy.clone(),
        Some(life).filter(|_| line.restarts > 0 || line.life > 1),
        line.last_reason.as_ref().map(|reason| format!("the last one {reason}")),
        line.tid.map(|tid| tid.to_string()),
        line.place.as_ref().map(|place| format!("on {place}")),
        line.waiting.zip(line.waiting_most).map(|(now, most)| format!("mailbox {now} (at most {most})")),
    ];
    for part in parts.into_iter().flatten() {
        words += ", ";
        words += &part;
    }
    words
}

fn node_json(answer: &Answer<TreeReport>) -> Value {
    let result = answer.result.as_ref();
    json!({
        "node": answer.node.to_string(),
        "name": result.map_or(&answer.name, |report| &report.name),
        "fault": result.err(),
        "left_out": result.map_or(0, |report| report.left_out),
        "tree": result.map_or_else(|_| Vec::new(), |report| report.lines.iter().map(line_json).collect()),
    })
}

fn line_json(line: &TreeLine) -> Value {
    json!({
        "depth": line.depth,
        "name": line.name,
        "tid": line.tid.map(|tid| tid.to_string()),
        "state": line.state,
        "since_us": line.since_us,
        "life": line.life,
        "restarts": line.restarts,
        "last_reason": line.last_reason,
        "place": line.place,
        "waiting": line.waiting,
        "waiting_most": line.waiting_most,
        "oldest_us": line.oldest_us,
        "strategy": line.strategy,
    })
}

#[cfg(test)]
mod tests {
    use sinew::{AppAddress, NodeAddress, Tid};

    use super::*;
    use crate::table::{
        WIDTH,
        tests::{long_name, widest},
    };

    #[test]
    fn tree_fits_a_terminal_and_keeps_its_branches() {
        let name = long_name();
        let line = |depth| TreeLine {
            depth,
            name: name.clone(),
            tid: Some(Tid::new(NodeAddress::from([192, 168, 100, 200]), AppAddress::new(0x8000_0001))),
            state: "ready".to_owned(),
            since_us: 90_000_000_000,
            life: 7,
            restarts: 6,
            last_reason: Some(format!("panicked: {name}")),
            place: Some(format!("thread {name}, SCHED_FIFO 40, CPU 3")),
            waiting: Some(12),
            waiting_most: Some(512),
            oldest_us: None,
            ages: None,
            strategy: Some("one for one".to_owned()),
        };
        let report = TreeReport { name: name.clone(), lines: [0, 1, 9].map(line).to_vec(), left_out: 0 };
        let answer = Answer { node: NodeAddress::new(2), name: name.clone(), result: Ok(report) };
        let shown = text(&answer, false);
        assert!(widest(&shown) <= WIDTH, "{shown}");
        assert!(shown.contains(&format!("\n      {name}: ")), "{shown}");
        assert_eq!(text(&answer, true).lines().count(), 4);
    }
}
