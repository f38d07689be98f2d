//! The real-time rights of a node, and its lateness after its start.

use serde_json::{Value, json};
use sinew::inspect::{NodeReport, RealTimeReport};

use crate::table::{clean, time};

/// Returns the line of a node, if it has measured itself.
pub(super) fn line(report: &NodeReport) -> Option<String> {
    let found = report.real_time.as_ref()?;
    Some(format!("{} {}: rt: {}\n", report.node, clean(&report.name), in_words(found)))
}

fn in_words(found: &RealTimeReport) -> String {
    let reasons = || clean(&found.refusals.join("; "));
    let schedule = match found.granted {
        0 => format!("refused: {}", reasons()),
        granted if granted < found.wanted => format!("fifo {granted} of {}: {}", found.wanted, reasons()),
        granted => format!("fifo {granted}"),
    };
    let memory = clean(&found.memory);
    let [p999, max] = [found.p999_ns, found.max_ns].map(|ns| time(ns / 1_000));
    format!("{schedule}, memory {memory}, p99.9 {p999}, max {max}")
}

pub(super) fn json(found: &RealTimeReport) -> Value {
    json!({
        "wanted": found.wanted,
        "granted": found.granted,
        "refusals": found.refusals,
        "memory": found.memory,
        "preempt_rt": found.is_preempt_rt,
        "period_us": found.period_us,
        "turns": found.turns,
        "p50_ns": found.p50_ns,
        "p99_ns": found.p99_ns,
        "p999_ns": found.p999_ns,
        "max_ns": found.max_ns,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::security::tests::node_report;

    fn found(granted: u8, refusals: &[&str]) -> RealTimeReport {
        RealTimeReport {
            wanted: 90,
            granted,
            refusals: refusals.iter().map(|reason| (*reason).to_owned()).collect(),
            memory: "locked".to_owned(),
            is_preempt_rt: false,
            period_us: 1_000,
            turns: 2_000,
            p50_ns: 5_000,
            p99_ns: 40_000,
            p999_ns: 83_000,
            max_ns: 210_400,
        }
    }

    #[test]
    fn node_that_has_measured_itself_has_a_line() {
        let report = NodeReport { real_time: Some(found(90, &[])), ..node_report("knee", 7, None) };
        let words = "192.168.0.7 knee: rt: fifo 90, memory locked, p99.9 83 us, max 210 us\n";
        assert_eq!(line(&report).as_deref(), Some(words));
        assert_eq!(line(&node_report("knee", 7, None)), None);
    }

    #[test]
    fn refused_priority_has_its_reasons() {
        let reason = "RLIMIT_RTPRIO is 0";
        assert!(
            in_words(&found(0, &[reason, "no budget"]))
                .starts_with("refused: RLIMIT_RTPRIO is 0; no budget, memory")
        );
        assert!(in_words(&found(40, &[reason])).starts_with("fifo 40 of 90: RLIMIT_RTPRIO is 0, memory"));
        assert!(!in_words(&found(0, &["a\u{1b}[2Jb"])).contains('\u{1b}'), "another node sends the text");
    }

    #[test]
    fn json_has_rights_and_percentiles() {
        let json = json(&found(40, &["why"]));
        assert_eq!(
            (&json["granted"], &json["refusals"][0], &json["p999_ns"]),
            (&40.into(), &"why".into(), &83_000.into())
        );
    }
}
