//! `sinew stop`: presses the stop of the whole system, releases it, and shows which nodes have confirmed.

use std::time::Duration;

use clap::Subcommand;
use serde_json::{Value as Json, json};
use sinew::{
    AppAddress, Outcome, Payload, Tid,
    client::ApiError,
    message::Rejection,
    stop::{AskStop, PressStop, ReleaseStop, StopNode, StopPress, StopReport, StopState},
};
use sinew_view::StopAct;

use crate::{
    Report,
    system::{System, SystemError, in_words},
    table::{Table, clean},
};

/// Time beyond the wait for confirmations in which the node answers.
const ANSWER_MARGIN: Duration = Duration::from_millis(500);
/// How long the page waits for the other nodes.
const PAGE_WITHIN_MS: u32 = 1_000;

/// The commands of `sinew stop`.
#[derive(Debug, Subcommand)]
pub(crate) enum Order {
    /// Presses the stop: every guarded output of every node becomes safe
    ///
    /// The command prints for each node after how many milliseconds its confirmation was there. For a node without one
    /// it prints within which time that node's own watchdogs make its outputs safe, or that no such time is known.
    /// Every program of the node's user, and of root, may press.
    ///
    /// Exit code 0: all nodes have confirmed. 1: a node has not. 3: no node accepts the command.
    #[command(after_help = r#"Examples:
  sinew stop press
  sinew stop press "the person stumbles" --within-ms 500
  sinew stop press --json | jq '.nodes[] | select(.confirmed_us == null)'"#)]
    Press {
        /// The reason, for logs and reports
        #[arg(default_value = "pressed on the command line")]
        reason: String,
        /// How long to wait for the confirmations
        #[arg(long, value_name = "MS", default_value_t = 1_000, value_parser = clap::value_parser!(u32).range(1..=60_000))]
        within_ms: u32,
    },
    /// Releases the stop: outputs may be armed again. Nothing moves by it
    ///
    /// Each application has to acknowledge the stop and to arm its outputs. Only operators may release, as the access
    /// list of every node names them (its table `roles`). Without a list these are the programs of the node's own user
    /// at its socket, if the node is open and on loopback; otherwise no program is. A press that comes at the same time
    /// outlasts the release.
    ///
    /// Exit code 0: no node is stopped any more. 1: refused, or a node is still stopped. 3: no node accepts the
    /// command.
    #[command(after_help = r#"Examples:
  sinew stop release"#)]
    Release {
        /// How long to wait for the other nodes
        #[arg(long, value_name = "MS", default_value_t = 1_000, value_parser = clap::value_parser!(u32).range(1..=60_000))]
        within_ms: u32,
    },
    /// Shows whether the system is stopped, by which application, and which nodes have confirmed
    ///
    /// Exit code 0: no stop is in force. 1: a stop is in force, or a node does not know yet. 3: no node accepts the
    /// command.
    #[command(after_help = r#"Examples:
  sinew stop status
  sinew stop status --json | jq .presses"#)]
    Status,
}

/// Carries out the command.
pub(crate) fn show(system: &mut System, order: &Order, is_wide: bool) -> Result<Report, SystemError> {
    let (report, is_fine) = match order {
        Order::Press { reason, within_ms } => {
            let order = PressStop { reason: reason.clone(), within_ms: *within_ms };
            let report = ask(system, &order, *within_ms)?;
            let is_fine = report.is_confirmed();
            (report, is_fine)
        }
        Order::Release { within_ms } => {
            let report = ask(system, &ReleaseStop { within_ms: *within_ms }, *within_ms)?;
            let is_fine = report.refused.is_none() && is_free(&report);
            (report, is_fine)
        }
        Order::Status => {
            let report = status(system)?;
            let is_fine = is_free(&report) && report.state == StopState::Released;
            (report, is_fine)
        }
    };
    Ok(Report { text: text(&report, is_wide), json: in_json(&report), is_fine })
}

/// Returns the state of the stop, as the entry node knows it.
pub(crate) fn status(system: &mut System) -> Result<StopReport, SystemError> {
    let within = system.within.as_millis().try_into().unwrap_or(u32::MAX);
    ask(system, &AskStop {}, within)
}

/// Carries out an act of the page.
pub(crate) fn act(system: &mut System, act: StopAct) -> Result<StopReport, SystemError> {
    match act {
        StopAct::Ask => status(system),
        StopAct::Press => {
            let reason = "pressed on the page of sinew view".to_owned();
            ask(system, &PressStop { reason, within_ms: PAGE_WITHIN_MS }, PAGE_WITHIN_MS)
        }
        StopAct::Release => ask(system, &ReleaseStop { within_ms: PAGE_WITHIN_MS }, PAGE_WITHIN_MS),
    }
}

/// Returns the result of an act in one line.
pub(crate) fn line(report: &Result<StopReport, SystemError>) -> String {
    match report {
        Ok(StopReport { refused: Some(why), .. }) => format!("refused: {}", clean(why)),
        Ok(report) => format!("the node is {}", state(Some(report.state))),
        Err(why) => clean(&why.to_string()),
    }
}

/// Returns whether no node is stopped, as far as this one knows.
fn is_free(report: &StopReport) -> bool {
    report.presses.is_empty() && report.nodes.iter().all(|node| node.state != Some(StopState::Stopped))
}

fn ask<P: Payload>(system: &mut System, order: &P, within_ms: u32) -> Result<StopReport, SystemError> {
    let stop = Tid::new(system.endpoint.tid().node, AppAddress::STOP);
    let within = Duration::from_millis(within_ms.into()) + ANSWER_MARGIN;
    let asked = system.endpoint.message(stop, order).ask::<StopReport>(within);
    asked.map_err(|error| unanswered(system, &error))
}

/// Returns why there is no report, with the remedy.
fn unanswered(system: &System, error: &ApiError) -> SystemError {
    if let ApiError::Ended(Outcome::Rejected(Rejection::NotAllowed)) = error {
        let why = "the stop belongs to the node's own user: this command runs as another one, which the access list only admits as a guest";
        return SystemError::Unknown(why.to_owned());
    }
    if let ApiError::Ended(Outcome::Rejected(Rejection::NoSuchApplication)) = error {
        let why = "it has no stop: it is of an older version, or is ending; try another node by --socket";
        return SystemError::NoAnswer(system.path.clone(), why.to_owned());
    }
    let why = in_words(error);
    let why = format!("{why}; the stop may be pressed or released: `sinew stop status` shows it");
    SystemError::NoAnswer(system.path.clone(), why)
}

fn text(report: &StopReport, is_wide: bool) -> String {
    let mut text = String::new();
    if let Some(why) = &report.refused {
        text += &format!("refused: {}\n", clean(why));
    }
    for press in &report.presses {
        text += &format!("{}\n", press_line(press));
    }
    let mut table = Table::new(["NODE", "NAME", "STATE", "CONFIRMED", "OUTPUTS", "NOTE"]).wide(is_wide);
    for node in &report.nodes {
        table.row([
            node.node.to_string(),
            node.name.clone(),
            state(node.state).to_owned(),
            node.confirmed_us.map_or_else(|| "-".to_owned(), millis),
            node.outputs.to_string(),
            note(node),
        ]);
    }
    text += &table.text();
    if report.state == StopState::Stopped {
        let confirmed = report.nodes.iter().filter(|node| node.confirmed_us.is_some()).count();
        text += &format!("stopped; {confirmed} of {} nodes have confirmed\n", report.nodes.len());
    }
    text
}

/// Returns a press in one line.
pub(crate) fn press_line(press: &StopPress) -> String {
    format!("pressed at node {} by {}: {}", press.node, press.by, clean(&press.reason))
}

/// Returns the word for a state; `None` is that of a node without an answer.
pub(crate) const fn state(state: Option<StopState>) -> &'static str {
    match state {
        Some(StopState::Released) => "released",
        Some(StopState::Held) => "held",
        Some(StopState::Stopped) => "stopped",
        None => "unknown",
    }
}

fn note(node: &StopNode) -> String {
    match node.bound_us {
        Some(bound) => format!("safe within {} of the press: {}", millis(bound), node.note),
        None => node.note.clone(),
    }
}

pub(crate) fn millis(micros: u64) -> String {
    format!("{}.{} ms", micros / 1_000, micros % 1_000 / 100)
}

pub(crate) fn in_json(report: &StopReport) -> Json {
    let presses = report.presses.iter().map(|press| {
        json!({
            "node": press.node.to_string(), "incarnation": press.incarnation.0, "number": press.number,
            "by": press.by.to_string(), "reason": press.reason,
        })
    });
    let nodes = report.nodes.iter().map(|node| {
        json!({
            "node": node.node.to_string(), "name": node.name, "state": state(node.state),
            "confirmed_us": node.confirmed_us, "safe_us": node.safe_us, "outputs": node.outputs,
            "bound_us": node.bound_us, "note": node.note,
        })
    });
    json!({
        "state": state(Some(report.state)), "presses": presses.collect::<Vec<_>>(),
        "nodes": nodes.collect::<Vec<_>>(), "refused": report.refused,
    })
}
