//! In which multicast groups nodes ask, and whether two of them meet there.

use sinew::inspect::NodeReport;

/// The groups that a node asks. One of a version that does not say them all says one.
fn asked(report: &NodeReport) -> Vec<&str> {
    let known = if report.groups.is_empty() { report.group.as_slice() } else { &report.groups };
    known.iter().map(String::as_str).collect()
}

/// The same, for people.
pub(super) fn in_words(report: &NodeReport) -> String {
    let asked = asked(report);
    if asked.is_empty() { "no group".to_owned() } else { asked.join(" and ") }
}

/// Why `from` does not hear the other by multicast, and what mends it. The seed is what makes groups needless.
pub(super) fn why_unheard(from: &NodeReport, theirs: &NodeReport, seed: &str) -> (String, String) {
    let (ours, others) = (asked(from), asked(theirs));
    if ours.is_empty() || others.is_empty() {
        let who = if ours.is_empty() { &from.name } else { &theirs.name };
        let seen = format!("{who} takes no part in multicast, and no seed names the other");
        return (seen, format!("{seed}; or [ndl] multicast in both"));
    }
    let shared: Vec<_> = ours.iter().copied().filter(|group| others.contains(group)).collect();
    if shared.is_empty() {
        let seen = format!("it asks in the group {}, the other in {}", in_words(from), in_words(theirs));
        return (seen, one_group(&ours, &others, seed));
    }
    let mend = format!(
        "does multicast pass between the two interfaces ({} and {})? `sinew doctor --interface ADDRESS` tries each host by itself; look at firewalls, IGMP and \
         MLD snooping of the switch; or {seed}",
        from.interface, theirs.interface
    );
    (format!("both ask in the group {}, and it has not heard the other", shared.join(" and ")), mend)
}

/// What gives two nodes a group in common that have none.
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
    // A seed of the one family is no use to who has addresses of the other alone.
    "choose `interface` under [ndl] so that both have addresses of IPv4, or both of IPv6, and set its group (`multicast`, `multicast6`) to the \
     same in both"
        .to_owned()
}
