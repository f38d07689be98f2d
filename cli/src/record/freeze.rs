//! `sinew record freeze`: has all nodes that record freeze the messages around this moment.

use std::{fmt::Write as _, time::Duration};

use clap::Args;
use serde_json::json;
use sinew::{
    AppAddress, NodeAddress, Tid, Time,
    inspect::{AskFreeze, FreezeReport, FrozenReport, NodeReport},
};

use super::fetch::ask_spans;
use crate::{
    Report,
    system::{Answer, System, SystemError, in_words, present},
    table::{Table, clean},
};

/// Pause between two questions to all nodes.
const PAUSE: Duration = Duration::from_millis(250);
/// Time for the copies, after the end of the span.
const FROZEN_WITHIN: Duration = Duration::from_secs(5);

/// The arguments of `sinew record freeze`.
#[derive(Debug, Args)]
pub(crate) struct Order {
    /// The reason, for those that look at the recording later; the first 200 bytes are kept
    #[arg(long, value_name = "TEXT")]
    reason: Option<String>,
}

/// The state of a node.
#[derive(Clone, Debug, PartialEq, Eq)]
enum State {
    Frozen,
    /// It has no such span.
    Missing,
    /// It keeps no recording, or does not hand it out.
    Refused(String),
    Silent(String),
}

/// Freezes, and waits until the nodes have the span.
pub(super) fn show(system: &mut System, order: &Order) -> Result<Report, SystemError> {
    let question = AskFreeze { reason: order.reason.clone().unwrap_or_default() };
    let to = Tid::new(system.endpoint.tid().node, AppAddress::INSPECT);
    let within = system.within;
    let answer: Result<FreezeReport, _> = system.endpoint.message(to, &question).ask(within);
    let report = answer.map_err(|error| SystemError::NoAnswer(system.path.clone(), in_words(&error)))?;
    let Some(id) = report.id else {
        let why = report.refused.unwrap_or_else(|| "it names no trigger; update it".to_owned());
        return Err(SystemError::Bag(format!("the node at {}: {}", system.path, clean(&why))));
    };
    let here = system.here()?;
    std::thread::sleep(Duration::from_millis(report.after_ms.min(60_000)));
    let until = Time::now() + FROZEN_WITHIN;
    loop {
        let states = states(system, &here, &id);
        let is_over = states.iter().all(|(_, _, state)| *state != State::Missing) || Time::now() >= until;
        if is_over {
            return Ok(shown(&id, &states));
        }
        std::thread::sleep(PAUSE);
    }
}

fn states(system: &mut System, here: &NodeReport, id: &str) -> Vec<(NodeAddress, String, State)> {
    let state = |Answer { node, name, result }: Answer<FrozenReport>| {
        let state = match result {
            Err(why) => State::Silent(why),
            Ok(FrozenReport { refused: Some(why), .. }) => State::Refused(why),
            Ok(report) if report.spans.iter().any(|span| span.id == id) => State::Frozen,
            Ok(_) => State::Missing,
        };
        (node, name, state)
    };
    ask_spans(system, present(here)).into_iter().map(state).collect()
}

fn shown(id: &str, states: &[(NodeAddress, String, State)]) -> Report {
    let mut table = Table::new(["NODE", "NAME", "STATE"]);
    let mut nodes = Vec::new();
    for (node, name, state) in states {
        let (word, detail) = state.words();
        table.row([
            node.to_string(),
            name.clone(),
            detail.map_or_else(|| word.to_owned(), |why| format!("{word}: {why}")),
        ]);
        nodes.push(json!({ "node": node.to_string(), "name": name, "state": word, "why": detail }));
    }
    let mut text = format!("{id}\n{}", table.text());
    let is_fine = states.iter().all(|(_, _, state)| matches!(state, State::Frozen | State::Refused(_)));
    let _ = writeln!(text, "Fetch the files with: sinew record fetch {id}");
    Report { text, json: json!({ "id": id, "nodes": nodes }), is_fine }
}

impl State {
    fn words(&self) -> (&'static str, Option<&str>) {
        match self {
            Self::Frozen => ("frozen", None),
            Self::Missing => (
                "missing",
                Some("another trigger has its span, or there is no room: see `sinew record fetch`"),
            ),
            Self::Refused(why) => ("refused", Some(why)),
            Self::Silent(why) => ("silent", Some(why)),
        }
    }
}
