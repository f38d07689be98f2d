//! The stop of the whole system in `sinew nodes`: its lines above the table, and the cell of each node.

use serde_json::{Value, json};
use sinew::{
    NodeAddress,
    inspect::NodeReport,
    stop::{StopNode, StopReport, StopState},
};

use crate::{
    stop,
    system::{Answer, System},
    table::clean,
};

/// Maximum number of presses, and of names, above the table.
const NAMED_MAX: usize = 8;

/// A stop that is in force at one node at least.
pub(super) struct Stop {
    /// The names of the nodes that report it.
    stopped_at: Vec<String>,
    /// The report of the entry node, or why there is none.
    report: Result<StopReport, String>,
}

impl Stop {
    /// Asks the entry node for its report, if a node is stopped.
    pub(super) fn ask(system: &mut System, answers: &[Answer<NodeReport>]) -> Option<Self> {
        let reports = answers.iter().filter_map(|answer| answer.result.as_ref().ok());
        let stopped = reports.filter(|report| report.stop == Some(StopState::Stopped));
        let stopped_at: Vec<_> = stopped.map(|report| report.name.clone()).collect();
        if stopped_at.is_empty() {
            return None;
        }
        let report = stop::status(system).map_err(|why| why.to_string());
        Some(Self { stopped_at, report })
    }

    /// Returns the report, if the entry node knows the press.
    fn known(&self) -> Option<&StopReport> {
        self.report.as_ref().ok().filter(|report| report.state == StopState::Stopped)
    }

    /// Returns the lines above the table.
    pub(super) fn lines(&self) -> String {
        let Some(report) = self.known() else {
            let why = self
                .report
                .as_ref()
                .err()
                .map_or_else(|| "the entry node does not know the press".to_owned(), |why| clean(why));
            let at = named(self.stopped_at.iter().map(String::as_str));
            return format!("STOPPED at {at}; no confirmations are known: {why}\n");
        };
        let mut lines = String::new();
        for press in report.presses.iter().take(NAMED_MAX) {
            lines += &format!("STOPPED: {}\n", stop::press_line(press));
        }
        let further = report.presses.len().saturating_sub(NAMED_MAX);
        if further > 0 {
            lines += &format!("STOPPED: {further} further presses\n");
        }
        let open: Vec<_> = report.nodes.iter().filter(|node| node.confirmed_us.is_none()).map(name).collect();
        let (all, confirmed) = (report.nodes.len(), report.nodes.len() - open.len());
        lines += &format!("{confirmed} of {all} nodes have confirmed");
        if !open.is_empty() {
            lines += &format!("; NOT CONFIRMED: {}", named(open.iter().map(String::as_str)));
        }
        lines + "; `sinew stop status` shows more, an operator ends it with `sinew stop release`\n"
    }

    fn cell(&self, node: NodeAddress) -> Option<String> {
        let part = self.known()?.nodes.iter().find(|part| part.node == node)?;
        Some(match part.confirmed_us {
            Some(micros) => format!("confirmed {}", stop::millis(micros)),
            None => "NOT CONFIRMED".to_owned(),
        })
    }

    pub(super) fn json(&self) -> Value {
        match &self.report {
            Ok(report) => stop::in_json(report),
            Err(why) => json!({ "state": "stopped", "fault": why }),
        }
    }
}

/// Returns the cell of a node with this state: its confirmation, if the stop is in force.
pub(super) fn cell(stop: Option<&Stop>, node: NodeAddress, own: Option<StopState>) -> String {
    let confirmation = stop.and_then(|stop| stop.cell(node));
    confirmation.unwrap_or_else(|| own.map_or("-", |own| stop::state(Some(own))).to_owned())
}

/// Returns the name of a node, or its address where no name is known.
fn name(node: &StopNode) -> String {
    if node.name.is_empty() { node.node.to_string() } else { node.name.clone() }
}

/// Returns the names in one line, and the number of those that have no room.
fn named<'n>(names: impl ExactSizeIterator<Item = &'n str>) -> String {
    let further = names.len().saturating_sub(NAMED_MAX);
    let mut shown: Vec<_> = names.take(NAMED_MAX).map(clean).collect();
    if further > 0 {
        shown.push(format!("{further} further ones"));
    }
    shown.join(", ")
}

#[cfg(test)]
mod tests {
    use sinew::{AppAddress, Tid, address::Incarnation, stop::StopPress};

    use super::*;

    const HIP: NodeAddress = NodeAddress::new(0x0a00_0002);
    const KNEE: NodeAddress = NodeAddress::new(0x0a00_0003);

    fn part(node: NodeAddress, name: &str, confirmed_us: Option<u64>) -> StopNode {
        StopNode {
            node,
            name: name.to_owned(),
            state: confirmed_us.map(|_| StopState::Stopped),
            confirmed_us,
            safe_us: confirmed_us,
            outputs: 1,
            bound_us: None,
            note: String::new(),
        }
    }

    fn stop(state: StopState, presses: usize) -> Stop {
        let by = Tid::new(HIP, AppAddress::new(0x8000_0003));
        let (reason, incarnation) = ("it stum\u{1b}bles".to_owned(), Incarnation(1));
        let press = StopPress { node: HIP, incarnation, number: 1, by, reason };
        let nodes = vec![part(HIP, "hip", Some(900)), part(KNEE, "", None)];
        let report = StopReport { state, presses: vec![press; presses], nodes, refused: None };
        Stop { stopped_at: vec!["hip".to_owned()], report: Ok(report) }
    }

    #[test]
    fn press_and_missing_confirmations_stand_above_the_table() {
        let shown = stop(StopState::Stopped, 1).lines();
        let lines: Vec<_> = shown.lines().collect();
        let pressed = "STOPPED: pressed at node 10.0.0.2 by 10.0.0.2/80000003: it stum\\u{1b}bles";
        assert_eq!((lines.len(), lines[0]), (2, pressed));
        assert!(lines[1].starts_with("1 of 2 nodes have confirmed; NOT CONFIRMED: 10.0.0.3; "), "{shown}");
        // And: many presses are counted
        let shown = stop(StopState::Stopped, NAMED_MAX + 3).lines();
        assert!(shown.contains("STOPPED: 3 further presses\n"), "{shown}");
    }

    #[test]
    fn each_node_has_its_confirmation_or_its_state() {
        let stop = stop(StopState::Stopped, 1);
        let of = |node, own| cell(Some(&stop), node, own);
        assert_eq!(of(HIP, Some(StopState::Stopped)), "confirmed 0.9 ms");
        assert_eq!(of(KNEE, Some(StopState::Stopped)), "NOT CONFIRMED");
        // The entry node does not list it.
        let ankle = NodeAddress::new(9);
        assert_eq!(of(ankle, Some(StopState::Held)), "held");
        assert_eq!(cell(None, HIP, Some(StopState::Released)), "released");
        assert_eq!(cell(None, HIP, None), "-");
    }

    #[test]
    fn stopped_node_is_named_without_a_known_press() {
        let unknown = stop(StopState::Released, 0);
        let line = "STOPPED at hip; no confirmations are known: the entry node does not know the press\n";
        assert_eq!((unknown.lines().as_str(), unknown.cell(HIP)), (line, None));
        let silent = Stop { report: Err("no answer".to_owned()), ..unknown };
        assert_eq!(silent.lines(), "STOPPED at hip; no confirmations are known: no answer\n");
        assert_eq!(
            (&silent.json()["state"], &silent.json()["fault"]),
            (&"stopped".into(), &"no answer".into())
        );
    }
}
