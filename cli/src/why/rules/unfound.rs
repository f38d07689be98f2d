//! Explains why a node has never found another one.

use sinew::inspect::NodeReport;

use super::{
    super::facts::TrafficEnd,
    groups, keys,
    places::{self, is_on_loopback, names},
    version,
};
use crate::table::time;

/// Returns why `from` has never found `to`, from the differences of their configurations; and the remedy, unless
/// another step has it.
pub(super) fn why_unknown(from: &NodeReport, to: &TrafficEnd) -> (String, Option<String>) {
    let with_fix = |(detail, fix)| (detail, Some(fix));
    if let Some(foreign) = from.foreign.iter().find(|foreign| Some(foreign.node) == to.node) {
        let detail = format!(
            "{} at that address speaks for project '{}', not '{}', {} ago",
            foreign.name,
            foreign.project,
            from.project,
            time(foreign.ago_us)
        );
        return (detail, Some("set the same `project` under [node] in both configurations".to_owned()));
    }
    let Some(theirs) = &to.report else {
        let fix = "is it started, with the same `project` and the same multicast group? Where multicast does not pass (WiFi, VPN, containers, most clouds): \
                    [ndl] seeds = [\"ITS_ADDRESS:PORT\"], with a fixed `ndl.port` there";
        let refused = keys::refused_of_anybody(from);
        let asked = asked(from);
        let detail = format!(
            "no datagram from it has arrived, by multicast or from a seed; {} asks {asked}{refused}",
            from.name
        );
        return (detail, Some(fix.to_owned()));
    };
    if from.project != theirs.project {
        // An earlier step reports it, and it is a sufficient reason.
        return ("not found, as it is of another project".to_owned(), None);
    }
    if keys::are_unlike(from, theirs) {
        let detail = "not found, as one of them has keys and the other none";
        return (detail.to_owned(), None);
    }
    if let Some(refused) =
        keys::refused_datagrams(from, theirs).or_else(|| keys::refused_datagrams(theirs, from))
    {
        return with_fix(refused);
    }
    if let Some(differ) = version::differs(from, theirs) {
        return with_fix(differ);
    }
    let seeded = |of: &NodeReport, other: &NodeReport| {
        other.udp.as_ref().is_some_and(|udp| of.seeds.iter().any(|seed| names(seed, udp)))
    };
    if seeded(from, theirs) || seeded(theirs, from) {
        let fix = "is UDP let through by the firewalls of both hosts (`sudo nft list ruleset`), and is `ndl.port` the one that the seed names?";
        return ("a seed names it, and no answer has come".to_owned(), Some(fix.to_owned()));
    }
    if let Some(useless) = places::useless_seed(from, theirs).or_else(|| places::useless_seed(theirs, from)) {
        return with_fix(useless);
    }
    if is_on_loopback(&from.interface) != is_on_loopback(&theirs.interface) {
        let detail = format!(
            "it asks at {}, the other at {}: one of them on its own host only",
            from.interface, theirs.interface
        );
        let fix = "set `interface` under [ndl] to the address of the interface between the hosts, in both";
        return (detail, Some(fix.to_owned()));
    }
    let udp = theirs.udp.as_deref().unwrap_or("ITS_ADDRESS:PORT");
    let seed = format!("[ndl] seeds = [\"{udp}\"] in the configuration of {}", from.name);
    with_fix(groups::explain_silence(from, theirs, &seed))
}

/// Returns where a node looks for others.
pub(super) fn asked(report: &NodeReport) -> String {
    let seeds = if report.seeds.is_empty() {
        "no seeds".to_owned()
    } else {
        format!("seeds {}", report.seeds.join(", "))
    };
    format!("{} at {}, {seeds}", groups::in_words(report), report.interface)
}
