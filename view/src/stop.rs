//! The stop of the whole system on the page: its acts, a report as JSON, and the sentences of the log.

use serde::Deserialize;
use serde_json::{Value, json};
use sinew::stop::{StopNode, StopPress, StopReport, StopState};

/// An act on the stop of the whole system.
///
/// # Examples
///
/// ```
/// use sinew_view::{NoSystem, Source, StopAct};
///
/// assert!(NoSystem.stop(StopAct::Press).is_err());
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StopAct {
    /// Asks for the state.
    Ask,
    /// Presses the stop.
    Press,
    /// Releases it. The node decides whether this program may.
    Release,
}

/// An act, as the page sends it.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Order {
    act: String,
}

impl StopAct {
    /// Reads a body.
    pub(crate) fn read(body: &[u8]) -> Result<Self, String> {
        let order: Order = serde_json::from_slice(body).map_err(|why| format!("this is no act: {why}"))?;
        match order.act.as_str() {
            "press" => Ok(Self::Press),
            "release" => Ok(Self::Release),
            _ => Err("the act has to be press or release".to_owned()),
        }
    }

    const fn word(self) -> &'static str {
        match self {
            Self::Ask => "state",
            Self::Press => "press",
            Self::Release => "release",
        }
    }

    /// Returns the sentence of the log, and whether the act has its full effect.
    pub(crate) fn sentence(self, report: &Result<StopReport, String>) -> (String, bool) {
        let word = self.word();
        let report = match report {
            Ok(report) => report,
            Err(why) => return (format!("{word}: {why}"), false),
        };
        if let Some(why) = &report.refused {
            return (format!("{word}: refused: {why}"), false);
        }
        let all = report.nodes.len();
        if self == Self::Release {
            let free = report.nodes.iter().filter(|node| node.state == Some(StopState::Released)).count();
            return (format!("{word}: {free} of {all} nodes are released"), free == all);
        }
        let confirmed = report.nodes.iter().filter(|node| node.confirmed_us.is_some()).count();
        (format!("{word}: {confirmed} of {all} nodes have confirmed"), report.is_confirmed())
    }
}

/// Returns a report as JSON.
pub(crate) fn json(report: &StopReport) -> Value {
    json!({
        "state": word(report.state), "refused": report.refused,
        "presses": report.presses.iter().map(press).collect::<Vec<_>>(),
        "nodes": report.nodes.iter().map(node).collect::<Vec<_>>(),
    })
}

/// Returns the word for a state.
pub(crate) const fn word(state: StopState) -> &'static str {
    match state {
        StopState::Released => "released",
        StopState::Held => "held",
        StopState::Stopped => "stopped",
    }
}

fn press(press: &StopPress) -> Value {
    json!({
        "node": press.node.to_string(), "incarnation": press.incarnation.0.to_string(), "number": press.number,
        "by": press.by.to_string(), "reason": press.reason,
    })
}

fn node(node: &StopNode) -> Value {
    let millis = |micros: Option<u64>| micros.map(|micros| micros as f64 / 1e3);
    json!({
        "node": node.node.to_string(), "name": node.name, "state": node.state.map_or("unknown", word),
        "confirmed_ms": millis(node.confirmed_us), "safe_ms": millis(node.safe_us),
        "bound_ms": millis(node.bound_us), "outputs": node.outputs, "note": node.note,
    })
}

#[cfg(test)]
mod tests {
    use sinew::{Tid, address::Incarnation};

    use super::*;

    fn report() -> StopReport {
        let node = |last, confirmed_us| StopNode {
            node: [10, 0, 0, last].into(),
            name: format!("node {last}"),
            state: Some(StopState::Stopped),
            confirmed_us,
            safe_us: confirmed_us,
            outputs: 1,
            bound_us: Some(41_300),
            note: String::new(),
        };
        StopReport {
            state: StopState::Stopped,
            presses: vec![StopPress {
                node: [10, 0, 0, 1].into(),
                incarnation: Incarnation(u64::MAX),
                number: 1,
                by: Tid::new([10, 0, 0, 1].into(), sinew::AppAddress::STOP),
                reason: "a test".to_owned(),
            }],
            nodes: vec![node(1, Some(1_500)), node(2, None)],
            refused: None,
        }
    }

    #[test]
    fn page_presses_and_releases_and_nothing_else() {
        let read = |text: &str| StopAct::read(text.as_bytes());
        assert_eq!(read(r#"{"act":"press"}"#), Ok(StopAct::Press));
        assert_eq!(read(r#"{"act":"release"}"#), Ok(StopAct::Release));
        for body in ["", "[]", "{}", r#"{"act":"ask"}"#, r#"{"act":"release","role":"operator"}"#] {
            assert!(read(body).is_err(), "{body}");
        }
    }

    #[test]
    fn report_names_times_and_bounds_in_milliseconds() {
        let found = json(&report());
        let times = |place: usize| {
            let node = &found["nodes"][place];
            (node["confirmed_ms"].as_f64(), node["bound_ms"].as_f64())
        };
        assert_eq!((times(0), times(1)), ((Some(1.5), Some(41.3)), (None, Some(41.3))));
        // A number of JavaScript would lose its last digits.
        assert_eq!(found["presses"][0]["incarnation"], json!(u64::MAX.to_string()));
    }

    #[test]
    fn act_is_logged_with_its_effect() {
        let mut report = report();
        let sentence = |act: StopAct, report: &StopReport| act.sentence(&Ok(report.clone()));
        assert_eq!(
            sentence(StopAct::Press, &report),
            ("press: 1 of 2 nodes have confirmed".to_owned(), false)
        );
        assert!(!sentence(StopAct::Release, &report).1, "both are stopped");
        report.nodes.iter_mut().for_each(|node| node.state = Some(StopState::Released));
        assert!(sentence(StopAct::Release, &report).1);
        report.refused = Some("no operator".to_owned());
        assert_eq!(sentence(StopAct::Release, &report), ("release: refused: no operator".to_owned(), false));
        assert_eq!(StopAct::Press.sentence(&Err("why".to_owned())), ("press: why".to_owned(), false));
    }
}
