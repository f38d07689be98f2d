//! Checks whether two nodes authenticate in the same way: by keys of their project, or not at all. Nodes with keys and
//! nodes without refuse each other.

use sinew::inspect::{NodeReport, RefusalReport, SecurityReport};

use super::{super::facts::TrafficEnd, RECENT_US, Steps};
use crate::table::{quoted, time};

/// The cause under which a node with keys counts discovery datagrams that it refuses.
const NOT_OURS: &str = "NDL datagram not of this project's keys";
/// The cause under which a node without keys counts datagrams of nodes with keys.
const SEALED: &str = "sealed NDL datagram at a node without keys";
/// The causes for connections with an unauthenticated peer.
const UNPROVEN: [&str; 2] = ["peer not proven", "security"];

impl Steps {
    /// Checks that both nodes have keys, or neither has.
    pub(super) fn keys(&mut self, a: &TrafficEnd, b: &TrafficEnd) {
        let (Some(ours), Some(theirs)) = (&a.report, &b.report) else { return };
        let (Some(has_ours), Some(has_theirs)) = (has_keys(ours), has_keys(theirs)) else { return };
        let what = "both have keys, or neither has";
        let (secured, open) = match (has_ours, has_theirs) {
            (true, true) => return self.fine(what, "both have"),
            (false, false) => return self.fine(what, "neither has: both are open"),
            (true, false) => (ours, theirs),
            (false, true) => (theirs, ours),
        };
        self.blocked(
            what,
            format!("{} has keys, and {} has none: each rejects the datagrams of the other", secured.name, open.name),
            format!(
                "where the ca.key of project {} is: sinew keys issue {}={} --keys DIR; copy them as it says, set security.keys of {}, and start \
                 it again; or take security.keys from the configuration of {}: then both are open",
                secured.project,
                quoted(&open.name),
                open.node,
                open.name,
                secured.name
            ),
        );
    }
}

/// Returns whether the node has keys; `None` if its version does not report it.
pub(super) fn has_keys(report: &NodeReport) -> Option<bool> {
    report.security.as_ref().map(|SecurityReport { certificate, .. }| certificate.is_some())
}

/// Returns whether one of them is known to have keys and the other none.
pub(super) fn are_unlike(one: &NodeReport, other: &NodeReport) -> bool {
    has_keys(one).zip(has_keys(other)).is_some_and(|(one, other)| one != other)
}

/// Returns that `from` has keys and currently refuses the other's datagrams, with the suggested fix.
pub(super) fn refused_datagrams(from: &NodeReport, theirs: &NodeReport) -> Option<(String, String)> {
    let udp = theirs.udp.as_deref()?;
    // The detail starts with the address.
    let is_theirs = |refusal: &&RefusalReport| {
        let rest = refusal.detail.strip_prefix(udp);
        refusal.cause == NOT_OURS
            && refusal.ago_us < RECENT_US
            && rest.is_some_and(|rest| rest.starts_with(": "))
    };
    let refusal = from.refusals.iter().find(is_theirs)?;
    let detail =
        format!("{} refused its datagram {} ago: {}", from.name, time(refusal.ago_us), refusal.detail);
    let fix = format!(
        "have both keys of one project, made by one `sinew keys init`: compare `sinew keys show --keys DIR` of their directories; for new ones \
         where the ca.key is: sinew keys issue {} --keys DIR",
        quoted(&theirs.name)
    );
    Some((detail, fix))
}

/// Returns that the node currently refuses datagrams because of keys, or missing keys. The sender of such datagrams is
/// unknown if that node cannot be asked.
pub(super) fn refused_of_anybody(from: &NodeReport) -> String {
    let is_for_keys = |refusal: &&RefusalReport| {
        [NOT_OURS, SEALED].contains(&refusal.cause.as_str()) && refusal.ago_us < RECENT_US
    };
    let refused = from.refusals.iter().find(is_for_keys);
    refused.map_or_else(String::new, |refusal| {
        format!("; {} ago it refused a datagram of another node: {}", time(refusal.ago_us), refusal.detail)
    })
}

/// Returns the remedy of a node that has refused an unauthenticated connection.
pub(super) fn remedy_of<'a>(mut refusals: impl Iterator<Item = &'a RefusalReport>) -> Option<String> {
    let unproven = refusals.find(|refusal| UNPROVEN.contains(&refusal.cause.as_str()))?;
    Some(remedy(&unproven.detail).to_owned())
}

/// Returns the remedy part of a fault, if it is separate from the description.
pub(super) fn remedy(fault: &str) -> &str {
    fault.split_once("; ").map_or(fault, |(_, remedy)| remedy)
}
