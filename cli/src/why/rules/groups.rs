//! Checks in which multicast groups nodes query, and whether two of them share one.

use sinew::inspect::NodeReport;

/// Returns the groups that a node queries. A node of a version without the full list reports one.
fn asked(report: &NodeReport) -> Vec<&str> {
    let known = if report.groups.is_empty() { report.group.as_slice() } else { &report.groups };
    known.iter().map(String::as_str).collect()
}

/// The same, as text.
pub(super) fn in_words(report: &NodeReport) -> String {
    let asked = asked(report);
    if asked.is_empty() { "no group".to_owned() } else { asked.join(" and ") }
}

/// Returns why `from` does not receive the other's multicast, and the suggested fix. With the seed, no common group is
/// needed.
pub(super) fn explain_silence(from: &NodeReport, theirs: &NodeReport, seed: &str) -> (String, String) {
    let (ours, others) = (asked(from), asked(theirs));
    if ours.is_empty() || others.is_empty() {
        let without = if ours.is_empty() { &from.name } else { &theirs.name };
        let detail = format!("{without} takes no part in multicast, and no seed names the other");
        return (detail, format!("{seed}; or [ndl] multicast in both"));
    }
    let shared: Vec<_> = ours.iter().copied().filter(|group| others.contains(group)).collect();
    if shared.is_empty() {
        let detail = format!("it asks in the group {}, the other in {}", in_words(from), in_words(theirs));
        return (detail, one_group(&ours, &others, seed));
    }
    let fix = format!(
        "does multicast pass between the two interfaces ({} and {})? `sinew doctor --interface ADDRESS` tries each host by itself; look at firewalls, IGMP and \
         MLD snooping of the switch; or {seed}",
        from.interface, theirs.interface
    );
    (format!("both ask in the group {}, and it has not heard the other", shared.join(" and ")), fix)
}

/// Returns the fix that gives two nodes a common group.
fn one_group(ours: &[&str], others: &[&str], seed: &str) -> String {
    let of_ipv6 = |group: &&str| group.starts_with('[');
    let of_ipv4 = |group: &&str| !group.starts_with('[');
    let both = |is_of: fn(&&str) -> bool| ours.iter().any(is_of) && others.iter().any(is_of);
    if both(of_ipv4) {
        return format!("set the same `multicast` under [ndl] in both; or {seed}");
    }
    if both(of_ipv6) {
        return format!("set the same `multicast6` under [ndl] in both; or {seed}");
    }
    // A seed of one family is useless for a node that has only addresses of the other.
    "choose `interface` under [ndl] so that both have addresses of IPv4, or both of IPv6, and set its group (`multicast`, `multicast6`) to the \
     same in both"
        .to_owned()
}
