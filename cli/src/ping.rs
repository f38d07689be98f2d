//! `sinew ping`: how long a message to an application or a node and its confirmation take.

use std::time::Duration;

use serde_json::json;
use sinew::{
    Outcome, Tid, Time,
    inspect::{AppReport, AppsReport, AskApps, Ping},
    message::Rejection,
};

use crate::{
    Report, apps,
    system::{Fault, System},
    table::clean,
};

/// So many without an answer, one after the other, are enough.
const IN_VAIN_MAX: u32 = 3;

/// What came of the pings.
#[derive(Default)]
struct Tally {
    /// In nanoseconds, sorted in the end.
    round_trips: Vec<u64>,
    sent: u32,
    /// What became of the last one.
    outcome: Option<Outcome>,
    /// Why the last one that failed did.
    fault: Option<String>,
}

/// Sends `count` pings to a TID, a name or a node, each when the one before was answered.
pub(crate) fn show(system: &mut System, whom: &str, count: u32) -> Result<Report, Fault> {
    let to = system.find(whom)?;
    let mut tally = Tally::default();
    let mut in_vain = 0;
    while tally.sent < count && in_vain < IN_VAIN_MAX {
        let began = Time::now();
        let outcome = system.endpoint.message(to, &Ping {}).confirmed(system.within);
        tally.sent += 1;
        tally.outcome = outcome.as_ref().ok().copied();
        match outcome.map_err(|error| error.to_string()).and_then(|outcome| judged(outcome, system.within)) {
            Ok(()) => {
                in_vain = 0;
                tally.round_trips.push(nanos(Time::now().since(began)));
            }
            Err(why) => {
                in_vain += 1;
                tally.fault = Some(why);
            }
        }
    }
    if let (Some(fault), Some(why)) = (&mut tally.fault, not_ready(system, to)) {
        *fault = why;
    }
    tally.round_trips.sort_unstable();
    Ok(tally.said(whom, to))
}

/// Whether whoever it was for has come to it.
pub(crate) fn judged(outcome: Outcome, within: Duration) -> Result<(), String> {
    match outcome {
        // Who does not know the kind has come to it all the same.
        Outcome::Delivered | Outcome::Rejected(Rejection::UnknownKind | Rejection::ByHandler) => Ok(()),
        Outcome::Rejected(why) => Err(why.to_string()),
        Outcome::Unknown => Err(format!(
            "no answer within {within:?}: its thread is busy or hangs, or its node is cut off; look at `sinew tree` and `sinew nodes`"
        )),
        Outcome::Expired => Err(format!(
            "it did not come to it within {within:?}: it is busy or hangs; look at `sinew tree`, or give more time: --deadline-ms"
        )),
        Outcome::Failed => Err("it failed or ended with it in hand; look at `sinew tree`".to_owned()),
        Outcome::PeerLost => Err("its node was lost; look at `sinew nodes`".to_owned()),
    }
}

/// Why the application at `to` is not ready, if it is not: better known than that it does not answer.
pub(crate) fn not_ready(system: &mut System, to: Tid) -> Option<String> {
    let answers = system.ask_these::<AskApps, AppsReport>(vec![(to.node, String::new())]);
    let said = answers.into_iter().find_map(|answer| answer.said.ok())?;
    said.apps.iter().find(|app| app.tid == to).and_then(unready)
}

/// Why this application is not ready, if it is not.
pub(crate) fn unready(app: &AppReport) -> Option<String> {
    let why = apps::why(app);
    match (app.ready, why.is_empty()) {
        (true, _) => None,
        (false, true) => Some("it is not ready".to_owned()),
        (false, false) => Some(format!("it is not ready: {why}")),
    }
}

impl Tally {
    /// The round trip that this share of all did not exceed, in nanoseconds.
    fn quantile(&self, share: f64) -> Option<u64> {
        let rank = (share * self.round_trips.len() as f64).ceil() as usize;
        self.round_trips.get(rank.saturating_sub(1)).copied()
    }

    fn said(&self, whom: &str, to: Tid) -> Report {
        let answered = self.round_trips.len();
        let quantiles = [self.quantile(0.0), self.quantile(0.5), self.quantile(0.99), self.quantile(1.0)];
        let [min, p50, p99, max] = quantiles;
        let mut text = format!("{} ({to}): {answered} of {} answered\n", clean(whom), self.sent);
        if let (Some(min), Some(p50), Some(p99), Some(max)) = (min, p50, p99, max) {
            let us = |ns: u64| format!("{:.1} us", ns as f64 / 1e3);
            text +=
                &format!("round trip min {}, p50 {}, p99 {}, max {}\n", us(min), us(p50), us(p99), us(max));
        }
        if let Some(why) = &self.fault {
            text += &format!("{}\n", clean(why));
        }
        let json = json!({
            "tid": to.to_string(), "sent": self.sent, "answered": answered, "fault": self.fault,
            "outcome": self.outcome.map(|outcome| format!("{outcome:?}")),
            "min_ns": min, "p50_ns": p50, "p99_ns": p99, "max_ns": max,
        });
        Report { text, json, is_fine: self.fault.is_none() }
    }
}

fn nanos(time: Duration) -> u64 {
    u64::try_from(time.as_nanos()).unwrap_or(u64::MAX)
}

#[cfg(test)]
mod tests {
    use sinew::{AppAddress, NodeAddress, inspect::Missing};

    use super::*;

    #[test]
    fn an_application_is_not_ready_for_a_reason_that_is_said_and_one_that_is_ready_has_none() {
        let missing = Missing { name: "ankle".to_owned(), why: "not there".to_owned(), since_us: None };
        let mut app = AppReport {
            tid: Tid::new(NodeAddress::from([10, 0, 0, 2]), AppAddress::new(0x1001)),
            name: Some("knee".to_owned()),
            ready: false,
            waits_us: Some(2_000_000),
            missing: vec![missing],
            missing_left_out: 0,
            ended: None,
            kinds: Vec::new(),
            kinds_left_out: 0,
        };
        let why = "it is not ready: has waited 2.0 s for ankle (not there)";
        assert_eq!(unready(&app).as_deref(), Some(why));
        // It lost what it needs, and goes on.
        (app.ready, app.waits_us) = (true, None);
        assert_eq!(unready(&app), None);
        // Its last life ended, and said nothing.
        (app.ready, app.ended) = (false, Some(String::new()));
        app.missing.clear();
        assert_eq!(unready(&app).as_deref(), Some("it is not ready"));
    }

    #[test]
    fn a_quantile_is_the_round_trip_that_so_many_did_not_exceed() {
        let tally = Tally { round_trips: (1..=200).collect(), ..Tally::default() };
        let [min, p50, p99, max] = [0.0, 0.5, 0.99, 1.0].map(|share| tally.quantile(share));
        assert_eq!([min, p50, p99, max], [Some(1), Some(100), Some(198), Some(200)]);
        assert_eq!(Tally::default().quantile(0.5), None);
    }
}
