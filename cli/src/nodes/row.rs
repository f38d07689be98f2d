//! One node of the table: its cells and its JSON, from its own report and that of the entry node.

use serde_json::{Value, json};
use sinew::inspect::{
    IdleReport, LinkReport, NodeReport, PeerReport, RetainedReport, RouteReport, StallReport, TroubleReport,
};

use super::{
    COLUMNS, real_time,
    stop::{self, Stop},
};
use crate::{
    security,
    system::Answer,
    table::{or_dash, time},
};

/// A node: its own report, and the report of the entry node about it.
pub(super) struct Row<'a> {
    pub(super) answer: &'a Answer<NodeReport>,
    pub(super) seen: Option<&'a PeerReport>,
}

impl<'a> Row<'a> {
    pub(super) fn of(here: &'a NodeReport, answer: &'a Answer<NodeReport>) -> Self {
        Self { answer, seen: here.peers.iter().find(|peer| peer.node == answer.node) }
    }

    pub(super) fn name(&self) -> &str {
        self.answer.result.as_ref().map_or(&self.answer.name, |report| &report.name)
    }

    fn incarnation(&self) -> Option<u64> {
        let reported = self.answer.result.as_ref().ok().map(|report| report.incarnation.0);
        reported.or_else(|| self.seen.map(|seen| seen.incarnation.0))
    }

    fn state(&self) -> &'static str {
        match (&self.answer.result, self.seen) {
            (Ok(report), _) if report.stopping => "stops",
            (Ok(_), None) => "here",
            (Ok(_), Some(_)) => "ready",
            (Err(_), Some(seen)) if !seen.is_there => "lost",
            (Err(_), _) => "does not answer",
        }
    }

    pub(super) fn is_fine(&self) -> bool {
        let is_linked = self.seen.is_none_or(|seen| seen.links.iter().all(|link| link.is_up));
        let gets_on = self.troubles().is_none_or(|(count, _)| count == 0);
        self.answer.result.as_ref().is_ok_and(|report| !report.stopping) && is_linked && gets_on
    }

    fn links(&self) -> String {
        let Some(seen) = self.seen else { return "-".to_owned() };
        let link = |link: &LinkReport| format!("{} {}", link.class, if link.is_up { "up" } else { "DOWN" });
        if seen.links.is_empty() {
            return "none".to_owned();
        }
        if seen.links.iter().all(|link| link.is_up) && seen.links.len() > 1 {
            return format!("{} up", seen.links.len());
        }
        seen.links.iter().map(link).collect::<Vec<_>>().join(", ")
    }

    fn clock(&self) -> String {
        let Some((offset, bound)) = self.seen.and_then(|seen| seen.offset_ns.zip(seen.offset_bound_ns))
        else {
            return "-".to_owned();
        };
        format!("{:+.1} us +- {:.1} us", offset as f64 / 1e3, bound as f64 / 1e3)
    }

    /// Returns the drift of its clock against that of the entry node.
    fn drift(&self) -> String {
        let drift = self.seen.and_then(|seen| seen.drift_ppb.zip(seen.drift_bound_ppb));
        or_dash(
            drift
                .map(|(ppb, bound)| format!("{:+.1} ppm +- {:.1} ppm", ppb as f64 / 1e3, bound as f64 / 1e3)),
        )
    }

    fn found_by(&self) -> String {
        or_dash(self.seen.map(|seen| seen.found_by.join(", ")).filter(|words| !words.is_empty()))
    }

    /// Returns the number of its layers and applications in trouble, and the first of them. The data are those of the
    /// entry node; for the entry node itself, its own report.
    pub(super) fn troubles(&self) -> Option<(u32, &[TroubleReport])> {
        let seen = self.seen.map(|seen| (seen.troubled, &seen.troubles[..]));
        seen.or_else(|| {
            self.answer.result.as_ref().ok().map(|report| (report.troubled, &report.troubles[..]))
        })
    }

    /// Returns the number of its clients that do not read, and the first of them. The data are those of the entry node;
    /// for the entry node itself, its own report.
    pub(super) fn idle(&self) -> Option<(u32, &[IdleReport])> {
        let seen = self.seen.map(|seen| (seen.idle_clients, &seen.idle[..]));
        seen.or_else(|| {
            self.answer.result.as_ref().ok().map(|report| (report.idle_clients, &report.idle[..]))
        })
    }

    pub(super) fn cells(&self, stop: Option<&Stop>) -> [String; COLUMNS] {
        let report = self.answer.result.as_ref().ok();
        [
            self.answer.node.to_string(),
            self.name().to_owned(),
            or_dash(self.incarnation().map(|number| number.to_string())),
            or_dash(report.map(|report| time(report.up_us))),
            self.state().to_owned(),
            stop::cell(stop, self.answer.node, report.and_then(|report| report.stop)),
            or_dash(report.map(security::cell)),
            self.found_by(),
            self.links(),
            or_dash(self.seen.filter(|seen| seen.is_there).map(routes)),
            or_dash(self.seen.and_then(|seen| seen.asked_every_us).map(time)),
            or_dash(self.seen.and_then(|seen| seen.bound_us).map(time)),
            or_dash(self.seen.and_then(|seen| seen.round_trip_ns).map(|ns| time(ns / 1_000))),
            self.clock(),
            self.drift(),
        ]
    }

    pub(super) fn json(&self) -> Value {
        let result = self.answer.result.as_ref();
        let seen = self.seen;
        json!({
            "node": self.answer.node.to_string(),
            "name": self.name(),
            "incarnation": self.incarnation(),
            "state": self.state(),
            "fault": result.err(),
            "up_us": result.ok().map(|report| report.up_us),
            "pid": result.ok().map(|report| report.pid),
            "security": result.ok().map(security::json),
            "version": result.ok().map(|report| &report.version),
            "refused": result.ok().map(|report| report.refused),
            "own_stalls": result.ok().and_then(|report| report.own_stalls).map(|stalls| stalls_json(&stalls)),
            "real_time": result.ok().and_then(|report| report.real_time.as_ref()).map(real_time::json),
            "stop": result.ok().and_then(|report| report.stop).map(|state| crate::stop::state(Some(state))),
            "retained": result.ok().and_then(|report| report.retained).map(|retained| retained_json(&retained)),
            "found_us": seen.and_then(|seen| seen.found_us),
            "found_by": seen.map(|seen| &seen.found_by),
            "silent_us": seen.and_then(|seen| seen.silent_us),
            "missed": seen.map(|seen| seen.missed),
            "asked_every_us": seen.and_then(|seen| seen.asked_every_us),
            "bound_us": seen.and_then(|seen| seen.bound_us),
            "troubled": self.troubles().map(|(count, _)| count),
            "troubles": self.troubles().map(|(_, named)| named.iter().map(trouble_json).collect::<Vec<_>>()),
            "idle_clients": self.idle().map(|(count, _)| count),
            "idle": self.idle().map(|(_, named)| named.iter().map(idle_json).collect::<Vec<_>>()),
            "routes": seen.map(|seen| seen.routes.iter().map(route_json).collect::<Vec<_>>()),
            "round_trip_ns": seen.and_then(|seen| seen.round_trip_ns),
            "clock_offset_ns": seen.and_then(|seen| seen.offset_ns),
            "clock_offset_bound_ns": seen.and_then(|seen| seen.offset_bound_ns),
            "clock_drift_ppb": seen.and_then(|seen| seen.drift_ppb),
            "clock_drift_bound_ppb": seen.and_then(|seen| seen.drift_bound_ppb),
            "links": seen.map(|seen| seen.links.iter().map(link_json).collect::<Vec<_>>()),
        })
    }
}

fn link_json(link: &LinkReport) -> Value {
    let LinkReport { class, is_up, waiting, unconfirmed } = link;
    json!({ "class": class, "up": is_up, "waiting": waiting, "unconfirmed": unconfirmed })
}

/// Returns on how many routes NDL queries it, and how many of them answer, if not all do. The interfaces of
/// these follow, that of the route in use first.
fn routes(seen: &PeerReport) -> String {
    let answering: Vec<_> = seen.routes.iter().filter(|route| route.missed == 0).collect();
    let (all, answer) = (seen.routes.len(), answering.len());
    let count = if all == answer { all.to_string() } else { format!("{answer} of {all}") };
    let mut names: Vec<&str> = Vec::new();
    for name in answering.iter().filter_map(|route| route.interface.as_deref()) {
        if !names.contains(&name) {
            names.push(name);
        }
    }
    if names.is_empty() { count } else { format!("{count} ({})", names.join(", ")) }
}

fn route_json(of: &RouteReport) -> Value {
    let RouteReport { here, interface, there, missed, round_trip_ns } = of;
    json!({
        "here": here,
        "interface": interface,
        "there": there,
        "missed": missed,
        "round_trip_ns": round_trip_ns,
    })
}

fn trouble_json(of: &TroubleReport) -> Value {
    let TroubleReport { app, name, trouble, since_us } = of;
    json!({ "app": app.to_string(), "name": name, "trouble": trouble, "since_us": since_us })
}

fn idle_json(of: &IdleReport) -> Value {
    let IdleReport { app, name, since_us } = of;
    json!({ "app": app.to_string(), "name": name, "since_us": since_us })
}

fn retained_json(of: &RetainedReport) -> Value {
    let RetainedReport { values, bytes, not_kept, not_handed_over } = of;
    json!({ "values": values, "bytes": bytes, "not_kept": not_kept, "not_handed_over": not_handed_over })
}

fn stalls_json(of: &StallReport) -> Value {
    let StallReport { count, longest_us, last_us } = of;
    json!({ "count": count, "longest_us": longest_us, "last_us": last_us })
}

#[cfg(test)]
mod tests {
    use sinew::{NodeAddress, address::Incarnation};

    use super::*;

    #[test]
    fn answering_routes_are_counted_and_their_interfaces_named() {
        let route = |missed| RouteReport {
            here: "10.0.0.1:1".to_owned(),
            interface: None,
            there: "10.0.0.7:1".to_owned(),
            missed,
            round_trip_ns: None,
        };
        let of = |missed: &[u32]| {
            let routes = missed.iter().map(|missed| route(*missed)).collect();
            routes_of(routes)
        };
        assert_eq!([of(&[]), of(&[0]), of(&[0, 0]), of(&[0, 3])], ["0", "1", "2", "1 of 2"]);
        let by = |name: &str, missed| RouteReport { interface: Some(name.to_owned()), ..route(missed) };
        assert_eq!(routes_of(vec![by("zenoh", 0), by("eth0", 3)]), "1 of 2 (zenoh)");
        assert_eq!(routes_of(vec![by("eth0", 0), by("eth0", 0), by("zenoh", 0)]), "3 (eth0, zenoh)");
    }

    fn routes_of(routes: Vec<RouteReport>) -> String {
        super::routes(&PeerReport {
            routes,
            ..PeerReport::lost(NodeAddress::from([10, 0, 0, 7]), Incarnation(1))
        })
    }
}
