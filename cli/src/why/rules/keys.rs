//! Whether two nodes prove themselves in the same way: by keys of their project, or not at all. Those with keys and those without refuse each other.

use sinew::inspect::{NodeReport, RefusalReport, SecurityReport};

use super::{super::facts::End, RECENT_US, Steps};
use crate::table::{quoted, time};

/// Under which a node with keys counts datagrams of discovery that it does not take.
const NOT_OURS: &str = "NDL datagram not of this project's keys";
/// Under which a node without keys counts those of nodes with keys.
const SEALED: &str = "sealed NDL datagram at a node without keys";
/// Under which connections are counted where somebody is not taken for who he says he is.
const UNPROVEN: [&str; 2] = ["peer not proven", "security"];

impl Steps {
    /// Both have keys, or neither has.
    pub(super) fn keys(&mut self, a: &End, b: &End) {
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
            format!("{} has keys, and {} has none: each refuses what the other says", secured.name, open.name),
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

/// `None`: it is of a version that does not say.
pub(super) fn has_keys(report: &NodeReport) -> Option<bool> {
    report.security.as_ref().map(|SecurityReport { certificate, .. }| certificate.is_some())
}

/// Whether it is known that one of them has keys and the other none.
pub(super) fn are_unlike(one: &NodeReport, other: &NodeReport) -> bool {
    has_keys(one).zip(has_keys(other)).is_some_and(|(one, other)| one != other)
}

/// That `from` has keys and refuses the datagrams of the other just now, with what mends it.
pub(super) fn refused_datagrams(from: &NodeReport, theirs: &NodeReport) -> Option<(String, String)> {
    let udp = theirs.udp.as_deref()?;
    // The address is the first word.
    let is_theirs = |refusal: &&RefusalReport| {
        let rest = refusal.detail.strip_prefix(udp);
        refusal.cause == NOT_OURS
            && refusal.ago_us < RECENT_US
            && rest.is_some_and(|rest| rest.starts_with(": "))
    };
    let refusal = from.refusals.iter().find(is_theirs)?;
    let seen = format!("{} refused its datagram {} ago: {}", from.name, time(refusal.ago_us), refusal.detail);
    let mend = format!(
        "have both keys of one project, made by one `sinew keys init`: compare `sinew keys show --keys DIR` of their directories; for new ones \
         where the ca.key is: sinew keys issue {} --keys DIR",
        quoted(&theirs.name)
    );
    Some((seen, mend))
}

/// That it refuses somebody's datagrams just now for their keys, or for want of them: of a node that cannot be asked nobody knows whose they are.
pub(super) fn refused_of_anybody(from: &NodeReport) -> String {
    let is_for_keys = |refusal: &&RefusalReport| {
        [NOT_OURS, SEALED].contains(&refusal.cause.as_str()) && refusal.ago_us < RECENT_US
    };
    let refused = from.refusals.iter().find(is_for_keys);
    refused.map_or_else(String::new, |refusal| {
        format!("; {} ago it refused somebody's: {}", time(refusal.ago_us), refusal.detail)
    })
}

/// What a node says to do that has refused a connection because nothing was proven on it.
pub(super) fn remedy_of<'a>(mut refusals: impl Iterator<Item = &'a RefusalReport>) -> Option<String> {
    let unproven = refusals.find(|refusal| UNPROVEN.contains(&refusal.cause.as_str()))?;
    Some(remedy(&unproven.detail).to_owned())
}

/// What a fault says is to be done: behind what it says is so, where these are told apart.
pub(super) fn remedy(fault: &str) -> &str {
    fault.split_once("; ").map_or(fault, |(_, remedy)| remedy)
}
