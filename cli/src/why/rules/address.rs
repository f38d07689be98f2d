//! Checks whether two processes use, or used until recently, the same node address.

use sinew::{
    inspect::{NodeReport, RefusalReport},
    message::Rejection,
};

use super::{
    super::facts::{Facts, TrafficEnd},
    RECENT_US, Steps,
};
use crate::table::time;

/// The cause under which a node counts claims of an address that another node has.
const TWICE: &str = "NDL node address used twice";
/// Number of NDL periods within which a living process that claims such an address is refused again. It is queried once
/// per period, and the contest for the address takes less than another one (NDL-5.3). One answer may be lost, and one
/// more be late.
const PERIODS: u64 = 4;
/// Minimum wait for that, in microseconds: ten periods of 500 ms, the default, because a host may be slow.
const AGAIN_US: u64 = 5_000_000;

impl Steps {
    /// Checks that no two processes use the address of one of the ends.
    pub(super) fn address(&mut self, facts: &Facts) {
        for end in &facts.ends {
            if let (Some(node), Some(double)) = (end.node, end.doubles.first()) {
                self.blocked(
                    format!("{} has its address alone", end.label()),
                    format!("node address {node} is used by {double}, too"),
                    "give one of them another `address` under [node]",
                );
                continue;
            }
            let Some(report) = &end.report else { continue };
            let Some(refusal) = report.refusals.iter().find(|refusal| is_of_one(refusal, facts)) else {
                continue;
            };
            let what = format!("{} sees both addresses once", end.label());
            let (ago, detail) = (time(refusal.ago_us), &refusal.detail);
            if refusal.ago_us < again_us(report) || !passes(facts) {
                let fix = "give one of the two another `address` under [node]";
                self.blocked(what, format!("{ago} ago: {detail}"), fix);
            } else {
                let last = if refusal.count == 1 { "seen once," } else { "seen last" };
                self.note(
                    what,
                    format!("{last} {ago} ago; over since: {detail}"),
                    "if it comes again, give one of the two another `address` under [node]",
                );
            }
        }
    }
}

/// Returns that the node of this name was refused because another one has its address, and the remedy.
pub(super) fn not_let_in(name: &str, facts: &Facts) -> Option<(String, String)> {
    let refusals =
        facts.ends.iter().filter_map(|end| end.report.as_ref()).flat_map(|report| &report.refusals);
    let is_its = |refusal: &&RefusalReport| {
        refusal.cause == TWICE && refusal.detail.contains(&format!("the node '{name}' at "))
    };
    let RefusalReport { detail, ago_us, .. } = refusals.into_iter().find(is_its)?;
    let fix = format!("give node {name} another `address` under [node], and start it again");
    Some((format!("its node was not let in {} ago: {detail}", time(*ago_us)), fix))
}

/// Returns whether this refusal shows, for now or recently, that the address of one of the two is used twice.
fn is_of_one(refusal: &RefusalReport, facts: &Facts) -> bool {
    // The detail starts with the node that is used twice.
    let word = refusal.detail.split(' ').next();
    let is_its = |end: &TrafficEnd| end.node.is_some_and(|node| word == Some(node.to_string().as_str()));
    refusal.cause == TWICE && refusal.ago_us < RECENT_US && facts.ends.iter().any(is_its)
}

/// Returns the time within which this node again refuses a second incarnation that still answers, in microseconds.
fn again_us(report: &NodeReport) -> u64 {
    let slowest = report.peers.iter().filter_map(|peer| peer.asked_every_us).max();
    slowest.map_or(AGAIN_US, |period| period.saturating_mul(PERIODS).max(AGAIN_US))
}

/// Returns whether messages pass, as far as tested, and each end knows the other and is linked to it.
fn passes(facts: &Facts) -> bool {
    let [a, b] = &facts.ends;
    // A message that the access list there refuses has arrived there.
    let is_lost = |ping: &Result<u64, String>| {
        ping.as_ref().is_err_and(|why| *why != Rejection::NotAllowed.to_string())
    };
    is_linked(a, b) && is_linked(b, a) && !facts.pings.iter().flatten().any(is_lost)
}

/// Returns whether `from` is linked to `to`; true if unknown, which another step reports.
fn is_linked(from: &TrafficEnd, to: &TrafficEnd) -> bool {
    let (Some(_), Some(node)) = (&from.report, to.node) else { return true };
    from.node == to.node
        || from.peer(node).is_some_and(|peer| {
            peer.is_there && !peer.links.is_empty() && peer.links.iter().all(|link| link.is_up)
        })
}
