//! The cause of the silence of a node that cannot be asked, as the node of the other end knows it.

use sinew::{
    NodeAddress,
    inspect::{LostReport, PeerReport, TroubleReport},
};

use super::super::facts::TrafficEnd;
use crate::table::time;

/// Returns whether the node of this end knows why the other node is silent: it has lost that node, or that node does
/// not get on.
pub(super) fn is_cause_known(end: &TrafficEnd, silent: NodeAddress) -> bool {
    match end.peer(silent).filter(|peer| peer.is_there) {
        Some(peer) => cause(peer).is_some(),
        None => end.report.iter().flat_map(|report| &report.lost).any(|lost| lost.node == silent),
    }
}

/// Returns why a node that is not lost answers no question, and the suggested fix.
pub(super) fn cause(peer: &PeerReport) -> Option<(String, &'static str)> {
    if peer.missed > 0 {
        let cause = format!("missed its last {} answers", peer.missed);
        return Some((
            cause,
            "does its process run? Is it stopped (`kill -CONT`), in a debugger, without a CPU? Is its host reached (`ping`)?",
        ));
    }
    if peer.troubled == 0 {
        return None;
    }
    let named = |TroubleReport { name, trouble, since_us, .. }: &TroubleReport| {
        format!("{name} {trouble} for {}", time(*since_us))
    };
    let named: Vec<_> = peer.troubles.iter().map(named).collect();
    let named = if named.is_empty() { String::new() } else { format!(": {}", named.join(", ")) };
    let cause = format!("{} of its layers and applications do not get on{named}", peer.troubled);
    Some((
        cause,
        "its process runs, and is busy or hangs: its log says more; end it and start it again if that stays so",
    ))
}

/// Returns how a node was lost, and the remedy.
pub(crate) fn lost_in_words(lost: &LostReport) -> (String, &'static str) {
    let ago = time(lost.lost_us);
    match lost.why.as_str() {
        "left" => (format!("lost {ago} ago: it stopped in order"), "start it again"),
        "crashed" => (
            format!("lost {ago} ago: its process has ended, nothing listens at its address"),
            "start it again; its log says why it ended",
        ),
        "hung" => (
            format!("lost {ago} ago: it had not answered for {}, while its host did", time(lost.silent_us)),
            "its process does not run: is it stopped (`kill -CONT`), in a debugger, without a CPU? Its host lives",
        ),
        "link down" => (
            format!("lost {ago} ago: it had not answered for {}, nor had its host", time(lost.silent_us)),
            "is the cable in, the interface up (`ip link`), the way free (`ping` its host), its host on?",
        ),
        why if why.starts_with("gave up") => {
            (format!("lost {ago} ago: it {why}"), "fix that, and start it again; its log says more")
        }
        why => (format!("lost {ago} ago: {why}"), "its log says more"),
    }
}
