//! `sinew tree`: who supervises whom, with restarts.

use serde_json::{Value, json};
use sinew::inspect::{AskTree, TreeLine, TreeReport};

use crate::{
    Report,
    system::{Answer, Fault, System, chosen},
    table::{clean, time},
};

/// Asks every node, or the one called so.
pub(crate) fn show(system: &mut System, wanted: Option<&str>) -> Result<Report, Fault> {
    let here = system.here()?;
    let nodes = chosen(&here, wanted)?;
    let answers = system.ask_these::<AskTree, TreeReport>(nodes);
    let is_fine = answers.iter().all(|answer| answer.said.as_ref().is_ok_and(|said| said.left_out == 0));
    let text = answers.iter().map(text).collect::<Vec<_>>().join("\n");
    Ok(Report { text, json: json!({ "nodes": answers.iter().map(node_json).collect::<Vec<_>>() }), is_fine })
}

fn text(answer: &Answer<TreeReport>) -> String {
    let said = match &answer.said {
        Ok(said) => said,
        Err(why) => return format!("{} {}: {}\n", answer.node, clean(&answer.name), clean(why)),
    };
    let mut text = format!("{} {}\n", answer.node, clean(&said.name));
    for line in &said.lines {
        // As many as came; a depth that another node made up moves nothing out of the window.
        text += &format!("{}{}\n", "   ".repeat(line.depth.min(16) as usize + 1), clean(&in_words(line)));
    }
    if said.left_out > 0 {
        text += &format!("   {} further ones had no room in its answer\n", said.left_out);
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
    let said = answer.said.as_ref();
    json!({
        "node": answer.node.to_string(),
        "name": said.map_or(&answer.name, |said| &said.name),
        "fault": said.err(),
        "left_out": said.map_or(0, |said| said.left_out),
        "tree": said.map_or_else(|_| Vec::new(), |said| said.lines.iter().map(line_json).collect()),
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
        "strategy": line.strategy,
    })
}
