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
    system::{System, SystemError},
    table::clean,
};

/// Maximum number of consecutive pings without an answer.
const UNANSWERED_MAX: u32 = 3;

/// The results of the pings.
#[derive(Default)]
struct Tally {
    /// In nanoseconds, sorted at the end.
    round_trips: Vec<u64>,
    sent: u32,
    /// The outcome of the last one.
    outcome: Option<Outcome>,
    /// Why the last failed one failed.
    fault: Option<String>,
}

/// Sends `count` pings to a TID, a name or a node, each after the answer to the previous one.
pub(crate) fn show(system: &mut System, target: &str, count: u32) -> Result<Report, SystemError> {
    let to = system.find(target)?;
    let mut tally = Tally::default();
    let mut unanswered = 0;
    while tally.sent < count && unanswered < UNANSWERED_MAX {
        let began = Time::now();
        let outcome = system.endpoint.message(to, &Ping {}).confirmed(system.within);
        tally.sent += 1;
        tally.outcome = outcome.as_ref().ok().copied();
        match outcome.map_err(|error| error.to_string()).and_then(|outcome| judged(outcome, system.within)) {
            Ok(()) => {
                unanswered = 0;
                tally.round_trips.push(nanos(Time::now().since(began)));
            }
            Err(why) => {
                unanswered += 1;
                tally.fault = Some(why);
            }
        }
    }
    if let (Some(fault), Some(why)) = (&mut tally.fault, not_ready(system, to)) {
        *fault = why;
    }
    tally.round_trips.sort_unstable();
    Ok(tally.report(target, to))
}

/// Returns whether the receiver has handled the ping.
pub(crate) fn judged(outcome: Outcome, within: Duration) -> Result<(), String> {
    match outcome {
        // A receiver that does not know the kind has handled it nevertheless.
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

/// Returns why the application at `to` is not ready, if it is not: more specific than a missing answer.
pub(crate) fn not_ready(system: &mut System, to: Tid) -> Option<String> {
    let answers = system.ask_these::<AskApps, AppsReport>(vec![(to.node, String::new())]);
    let report = answers.into_iter().find_map(|answer| answer.result.ok())?;
    report.apps.iter().find(|app| app.tid == to).and_then(unready)
}

/// Returns why this application is not ready, if it is not.
pub(crate) fn unready(app: &AppReport) -> Option<String> {
    let why = apps::why(app);
    match (app.ready, why.is_empty()) {
        (true, _) => None,
        (false, true) => Some("it is not ready".to_owned()),
        (false, false) => Some(format!("it is not ready: {why}")),
    }
}

impl Tally {
    /// Returns the round trip that this share of all did not exceed, in nanoseconds.
    fn quantile(&self, share: f64) -> Option<u64> {
        let rank = (share * self.round_trips.len() as f64).ceil() as usize;
        self.round_trips.get(rank.saturating_sub(1)).copied()
    }

    fn report(&self, target: &str, to: Tid) -> Report {
        let answered = self.round_trips.len();
        let quantiles = [self.quantile(0.0), self.quantile(0.5), self.quantile(0.99), self.quantile(1.0)];
        let [min, p50, p99, max] = quantiles;
        let mut text = format!("{} ({to}): {answered} of {} answered\n", clean(target), self.sent);
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
    fn only_an_unready_application_has_a_reason() {
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
        // It lost a requirement, and continues.
        (app.ready, app.waits_us) = (true, None);
        assert_eq!(unready(&app), None);
        // Its last incarnation ended without a reason.
        (app.ready, app.ended) = (false, Some(String::new()));
        app.missing.clear();
        assert_eq!(unready(&app).as_deref(), Some("it is not ready"));
    }

    #[test]
    fn quantile_is_the_round_trip_of_its_rank() {
        let tally = Tally { round_trips: (1..=200).collect(), ..Tally::default() };
        let [min, p50, p99, max] = [0.0, 0.5, 0.99, 1.0].map(|share| tally.quantile(share));
        assert_eq!([min, p50, p99, max], [Some(1), Some(100), Some(198), Some(200)]);
        assert_eq!(Tally::default().quantile(0.5), None);
    }
}
