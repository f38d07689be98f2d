//! Whether two processes have one node address, or had it until just now.

use sinew::{
    inspect::{NodeReport, RefusalReport},
    message::Rejection,
};

use super::{
    super::facts::{End, Facts},
    RECENT_US, Steps,
};
use crate::table::time;

/// The cause under which a node counts that somebody claims an address that another one has.
const TWICE: &str = "NDL node address used twice";
/// A process that lives and claims such an address is refused again within so many periods of NDL: it is asked once a period, and the contest
/// for the address takes less than another one (NDL-5.3). One answer may be lost, and one more be late.
const PERIODS: u64 = 4;
/// The least that is waited for it, in microseconds: ten periods of 500 ms, the default, as a host may be slow.
const AGAIN_US: u64 = 5_000_000;

impl Steps {
    /// No two processes have the address of one of them.
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
                let mend = "give one of the two another `address` under [node]";
                self.blocked(what, format!("{ago} ago: {detail}"), mend);
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

/// That the node of this name was refused because another one has its address; and the remedy.
pub(super) fn not_let_in(name: &str, facts: &Facts) -> Option<(String, String)> {
    let refusals =
        facts.ends.iter().filter_map(|end| end.report.as_ref()).flat_map(|report| &report.refusals);
    let is_its = |refusal: &&RefusalReport| {
        refusal.cause == TWICE && refusal.detail.contains(&format!("the node '{name}' at "))
    };
    let RefusalReport { detail, ago_us, .. } = refusals.into_iter().find(is_its)?;
    let mend = format!("give node {name} another `address` under [node], and start it again");
    Some((format!("its node was not let in {} ago: {detail}", time(*ago_us)), mend))
}

/// Whether this says, of now or of just before, that the address of one of the two is used twice.
fn is_of_one(refusal: &RefusalReport, facts: &Facts) -> bool {
    // The node that is used twice is the first word.
    let word = refusal.detail.split(' ').next();
    let is_its = |end: &End| end.node.is_some_and(|node| word == Some(node.to_string().as_str()));
    refusal.cause == TWICE && refusal.ago_us < RECENT_US && facts.ends.iter().any(is_its)
}

/// Within which time a second life that answers still is refused again by this node, in microseconds.
fn again_us(report: &NodeReport) -> u64 {
    let slowest = report.peers.iter().filter_map(|peer| peer.asked_every_us).max();
    slowest.map_or(AGAIN_US, |period| period.saturating_mul(PERIODS).max(AGAIN_US))
}

/// Whether messages pass, as far as it was tried, and each knows the other and is linked to it.
fn passes(facts: &Facts) -> bool {
    let [a, b] = &facts.ends;
    // One that the access list there refuses has got there.
    let is_lost = |ping: &Result<u64, String>| {
        ping.as_ref().is_err_and(|why| *why != Rejection::NotAllowed.to_string())
    };
    is_linked(a, b) && is_linked(b, a) && !facts.pings.iter().flatten().any(is_lost)
}

/// Whether `from` is linked to `to`; also where nobody can say so, which is told elsewhere.
fn is_linked(from: &End, to: &End) -> bool {
    let (Some(_), Some(node)) = (&from.report, to.node) else { return true };
    from.node == to.node
        || from.peer(node).is_some_and(|peer| {
            peer.is_there && !peer.links.is_empty() && peer.links.iter().all(|link| link.is_up)
        })
}
