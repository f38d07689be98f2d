//! From what two ends say to what stands in the way between them: facts in, steps out, nothing asked and nothing waited for.

mod access;
mod address;
mod groups;
mod keys;
mod many;
mod places;
mod stream;
mod types;
mod unnamed;
mod version;

use std::collections::BTreeSet;

use sinew::{
    inspect::{LostReport, Missing, NodeReport, PeerReport, RefusalReport},
    message::Rejection,
};

use self::places::{is_on_loopback, names};
use super::facts::{App, End, Facts, Namesakes};
use crate::table::time;

/// A step of the way, and how it is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Step {
    /// What was looked at.
    pub(super) what: String,
    pub(super) state: State,
    /// What is so, in words.
    pub(super) seen: String,
    /// What mends it, where something is to be mended.
    pub(super) mend: Option<String>,
}

/// How a step is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum State {
    /// It is as it should be.
    Fine,
    /// It does not stand in the way, and should be known.
    Note,
    /// It stands in the way.
    Blocked,
}

/// Refusals that are older say nothing of now, in microseconds.
const RECENT_US: u64 = 60_000_000;
/// Further applications of one name that are told by their TIDs.
const NAMESAKES_SHOWN: usize = 4;

/// Every step from the one to the other and back, in the order in which a message meets them.
pub(super) fn judge(facts: &Facts) -> Vec<Step> {
    let mut steps = Steps(Vec::new());
    if let Some(many) = &facts.many {
        steps.towards_many(many, facts);
        return steps.0;
    }
    let [a, b] = &facts.ends;
    for end in [a, b] {
        steps.there(end, facts);
        steps.meant(end);
    }
    steps.address(facts);
    if a.node.is_some() && a.node != b.node {
        steps.project(a, b);
        steps.keys(a, b);
        for ((from, to), value) in [(a, b), (b, a)].into_iter().zip(&facts.streams) {
            steps.known(from, to);
            steps.linked(from, to);
            steps.streamed(from, to, value.as_ref());
        }
    }
    let [there, back] = facts.pings.each_ref().map(Option::as_ref);
    for ((end, other), ping) in [(a, b), (b, a)].into_iter().zip([back, there]) {
        steps.application((end, other), ping, facts);
    }
    for (from, to) in [(a, b), (b, a)] {
        steps.handled(from, to);
    }
    steps.access(a, b, facts);
    steps.by_groups(a, b, facts);
    for (ping, (from, to)) in facts.pings.iter().zip([(a, b), (b, a)]) {
        steps.ping(ping.as_ref(), from, to);
    }
    steps.0
}

struct Steps(Vec<Step>);

impl Steps {
    fn fine(&mut self, what: impl Into<String>, seen: impl Into<String>) {
        self.0.push(Step { what: what.into(), state: State::Fine, seen: seen.into(), mend: None });
    }

    fn note(&mut self, what: impl Into<String>, seen: impl Into<String>, mend: impl Into<String>) {
        let (what, seen) = (what.into(), seen.into());
        self.0.push(Step { what, state: State::Note, seen, mend: Some(mend.into()) });
    }

    /// It stands in the way, and another step has the remedy.
    fn explained(&mut self, what: impl Into<String>, seen: impl Into<String>) {
        self.0.push(Step { what: what.into(), state: State::Blocked, seen: seen.into(), mend: None });
    }

    fn is_blocked(&self) -> bool {
        self.0.iter().any(|step| step.state == State::Blocked)
    }

    fn blocked(&mut self, what: impl Into<String>, seen: impl Into<String>, mend: impl Into<String>) {
        let (what, seen) = (what.into(), seen.into());
        self.0.push(Step { what, state: State::Blocked, seen, mend: Some(mend.into()) });
    }

    /// Whether its node runs and can be asked.
    fn there(&mut self, end: &End, facts: &Facts) {
        let what = format!("{} is there", end.label());
        // Perhaps its own.
        let shut: String = facts.shut.iter().map(|door| format!("; {door}")).collect();
        match (&end.report, end.node) {
            (Some(report), _) if report.stopping => self.blocked(
                what,
                "its node is about to end",
                "wait until it is started again, or start it",
            ),
            (Some(report), _) => {
                let NodeReport { node, name, pid, up_us, .. } = report;
                self.fine(what, format!("node {name} at {node}, process {pid}, up {}", time(*up_us)));
            }
            (None, Some(node)) => self.blocked(
                what,
                format!("its node {node} cannot be asked: {}{shut}", end.silence.as_deref().unwrap_or("no answer")),
                "is it running? Start it; if it runs on another host, run `sinew why` there, too; if its socket is elsewhere on this one: \
                 --other-socket PATH",
            ),
            (None, None) => self.nowhere(what, &end.wanted, facts, &shut),
        }
    }

    /// Which application is looked at, where several have the name.
    fn meant(&mut self, end: &End) {
        let Some(Namesakes { tid, seen_from, others }) = &end.namesakes else { return };
        let named: Vec<_> = others.iter().take(NAMESAKES_SHOWN).map(ToString::to_string).collect();
        let more = others.len() - named.len();
        let more = if more > 0 { format!(" and {more} more") } else { String::new() };
        self.note(
            format!("{} is one of {}", end.label(), others.len() + 1),
            format!("from node {seen_from} the name stands for {tid}, not for {}{more}", named.join(", ")),
            "`sinew why` with the TID of another one looks at that",
        );
    }

    fn project(&mut self, a: &End, b: &End) {
        let (Some(ours), Some(theirs)) = (&a.report, &b.report) else { return };
        let what = "both are of one project";
        if ours.project == theirs.project {
            self.fine(what, format!("'{}'", ours.project));
        } else {
            self.blocked(
                what,
                format!("{} is of '{}', {} of '{}'", a.label(), ours.project, b.label(), theirs.project),
                "set the same `project` under [node] in both configurations",
            );
        }
    }

    /// Whether `from` has found `to`, and still hears it.
    fn known(&mut self, from: &End, to: &End) {
        let (Some(report), Some(node)) = (&from.report, to.node) else { return };
        let what = format!("{} knows {}", from.label(), to.label());
        if let Some(peer) = from.peer(node).filter(|peer| peer.is_there) {
            let seen = heard(peer);
            if peer.missed == 0 {
                return self.fine(what, seen);
            }
            let mend =
                "is it stopped, or its host overloaded? `sinew ping` it, `sinew tree` shows what it does";
            return self.note(what, format!("{seen}; missed its last {} answers", peer.missed), mend);
        }
        if let Some(lost) = report.lost.iter().find(|lost| lost.node == node) {
            let (seen, mend) = lost_in_words(lost);
            return self.blocked(what, seen, mend);
        }
        match why_unknown(report, to) {
            (seen, Some(mend)) => self.blocked(what, seen, mend),
            (seen, None) => self.explained(what, seen),
        }
    }

    /// Whether messages flow from `from` to `to`.
    fn linked(&mut self, from: &End, to: &End) {
        let Some(node) = to.node else { return };
        let Some(peer) = from.peer(node) else { return };
        let what = format!("{} is connected to {}", from.label(), to.label());
        let down: Vec<_> =
            peer.links.iter().filter(|link| !link.is_up).map(|link| link.class.as_str()).collect();
        if peer.links.is_empty() || !down.is_empty() {
            let which = if peer.links.is_empty() {
                "never connected".to_owned()
            } else {
                format!("{} down", down.join(", "))
            };
            let since = peer.broken_us.map_or_else(String::new, |us| format!(", broken {} ago", time(us)));
            let (dial, mend) = dial_in_words(peer);
            let refused = refused_just_now(from, to);
            let told: String = refused
                .iter()
                .map(|(end, refusal)| {
                    format!("; {} refused: {} ({})", end.label(), refusal.detail, refusal.cause)
                })
                .collect();
            let proof = keys::remedy_of(refused.iter().map(|(_, refusal)| *refusal));
            let mend = match &peer.dial {
                None => proof.unwrap_or(mend),
                Some(_) => mend,
            };
            self.blocked(what, format!("{which}{since}{dial}{told}"), mend);
            return;
        }
        let since = peer.linked_us.map_or_else(String::new, |us| format!(" since {}", time(us)));
        let sum = |count: fn(&sinew::inspect::LinkReport) -> u64| peer.links.iter().map(count).sum::<u64>();
        let (waiting, unconfirmed) = (sum(|link| link.waiting), sum(|link| link.unconfirmed));
        let mut seen = format!("{} up{since}", peer.links.len());
        if waiting + unconfirmed > 0 {
            seen += &format!(", {waiting} messages wait, {unconfirmed} are not confirmed yet");
        }
        self.fine(what, seen);
    }

    /// Whether the application that was asked for takes messages; `ping` is what came of one to it.
    fn application(&mut self, (end, other): (&End, &End), ping: Option<&Result<u64, String>>, facts: &Facts) {
        let Some(app) = &end.app else { return };
        let what = format!("{} takes messages", end.label());
        let Some(report) = &app.report else {
            if end.report.is_some() {
                self.unnamed(what, app.unsaid.as_ref(), ping);
            }
            return;
        };
        if let Some(circle) = report.name.as_ref().and_then(|name| circle(name, facts)) {
            return self.blocked(
                what,
                format!("requirements in a circle: {}", circle.join(" -> ")),
                "take one of these `requires` away: none of them can start before the others",
            );
        }
        if !report.ready {
            let why = crate::apps::why(report);
            let why = if why.is_empty() { "not ready".to_owned() } else { why };
            let is_other = |missing: &Missing| missing.name == other.wanted;
            if self.is_blocked() && !report.missing.is_empty() && report.missing.iter().all(is_other) {
                return self.explained(what, why);
            }
            return self.blocked(what, why, unnamed::mend_of_wait(&report.missing));
        }
        if let Some((seen, mend)) = troubled(app) {
            return self.blocked(what, seen, mend);
        }
        if !report.missing.is_empty() {
            let mend = "see what has become of it; what it does meanwhile is its `on_requirement_lost`";
            return self.note(what, format!("ready, but it lost {}", crate::apps::lacks(report)), mend);
        }
        let mailbox = app.line.as_ref().and_then(|line| line.waiting.zip(line.waiting_most));
        let mailbox = mailbox
            .map_or_else(String::new, |(now, most)| format!(", {now} messages wait for it (at most {most})"));
        let refused = app.refused;
        if refused > 0 {
            let mend = "`sinew watch` shows each refusal with its reason, `sinew audit` the sums; is it slower than its senders?";
            return self.note(what, format!("ready{mailbox}; {refused} messages were refused so far"), mend);
        }
        self.fine(what, format!("ready{mailbox}"));
    }

    fn ping(&mut self, ping: Option<&Result<u64, String>>, from: &End, to: &End) {
        let what = format!("a message goes from {} to {}", from.node_label(), to.label());
        // None was sent, as it would only wait there; what mends that was told.
        if from.report.is_some()
            && !matches!(ping, Some(Ok(_)))
            && let Some(why) = to.not_ready()
        {
            let seen = format!("not tried: {why}");
            return self.0.push(Step { what, state: State::Note, seen, mend: None });
        }
        match ping {
            Some(Ok(micros)) => self.fine(what, format!("confirmed after {}", time(*micros))),
            Some(Err(why)) if *why == Rejection::NotAllowed.to_string() => {
                let may = access::may_send(from, to);
                let seen = "the access list there does not let this command send";
                if self.0.iter().any(|step| step.what == may) {
                    // The list was looked at for the two applications; this command is a third one.
                    let mend = "a [[rule]] for this command, if it is to; what the list says of the two is told above";
                    self.note(what, seen, mend);
                } else {
                    // Of no sender it was said what the list makes of it.
                    let to = to.label();
                    let mend = format!(
                        "`sinew why SENDER {to}`, with an application for SENDER, names the rule; or have a [[rule]] let this command send"
                    );
                    self.blocked(what, seen, mend);
                }
            }
            Some(Err(why)) => {
                // What was found before explains it.
                let is_explained = self.is_blocked();
                let mend = "`sinew tree` of its node shows what it does; is it busy, or does it hang?";
                let mend = (!is_explained).then(|| mend.to_owned());
                self.0.push(Step { what, state: State::Blocked, seen: why.clone(), mend });
            }
            // It cannot be asked, or nobody knows where to: that stands in the way, and was told.
            None if from.report.is_none() || to.node.is_none() => {}
            None => {
                let node = from.node_label();
                self.note(
                    what,
                    format!("not tried from there: this command has no socket of {node}, which other nodes told of"),
                    format!(
                        "`sinew why {} {}` on the host of {node}; if its socket is on this one: --other-socket PATH",
                        from.label(),
                        to.label()
                    ),
                );
            }
        }
    }
}

fn heard(peer: &PeerReport) -> String {
    let silent = peer.silent_us.map_or_else(|| "heard".to_owned(), |us| format!("heard {} ago", time(us)));
    let found = peer.found_us.map_or_else(String::new, |us| format!(", found {} ago", time(us)));
    format!("{silent}{found} by {}", joined(&peer.found_by))
}

fn joined(words: &[String]) -> String {
    if words.is_empty() { "another way".to_owned() } else { words.join(", ") }
}

/// How it was lost, and what to do.
pub(crate) fn lost_in_words(lost: &LostReport) -> (String, &'static str) {
    let ago = time(lost.lost_us);
    match lost.why.as_str() {
        "left" => (format!("lost {ago} ago: it stopped in order"), "start it again"),
        "crashed" => (
            format!("lost {ago} ago: its process has ended, nobody listens at its address"),
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
            (format!("lost {ago} ago: it {why}"), "mend that, and start it again; its log says more")
        }
        why => (format!("lost {ago} ago: {why}"), "its log says more"),
    }
}

/// Why `from` has never found `to`: in what their configurations do not meet; and the remedy, unless another step has it.
fn why_unknown(from: &NodeReport, to: &End) -> (String, Option<String>) {
    let told = |(seen, mend)| (seen, Some(mend));
    if let Some(foreign) = from.foreign.iter().find(|foreign| Some(foreign.node) == to.node) {
        let seen = format!(
            "{} at that address speaks for project '{}', not '{}', {} ago",
            foreign.name,
            foreign.project,
            from.project,
            time(foreign.ago_us)
        );
        return (seen, Some("set the same `project` under [node] in both configurations".to_owned()));
    }
    let Some(theirs) = &to.report else {
        let mend = "is it started, with the same `project` and the same multicast group? Where multicast does not pass (WiFi, VPN, containers, most clouds): \
                    [ndl] seeds = [\"ITS_ADDRESS:PORT\"], with a fixed `ndl.port` there";
        let refused = keys::refused_of_anybody(from);
        let asked = asked(from);
        let seen = format!(
            "no datagram from it has arrived, by multicast or from a seed; {} asks {asked}{refused}",
            from.name
        );
        return (seen, Some(mend.to_owned()));
    };
    if from.project != theirs.project {
        // It was said already, and is reason enough.
        return ("not found, as it is of another project".to_owned(), None);
    }
    if keys::are_unlike(from, theirs) {
        let seen = "not found, as one of them has keys and the other none";
        return (seen.to_owned(), None);
    }
    if let Some(refused) =
        keys::refused_datagrams(from, theirs).or_else(|| keys::refused_datagrams(theirs, from))
    {
        return told(refused);
    }
    if let Some(differ) = version::differs(from, theirs) {
        return told(differ);
    }
    let seeded = |of: &NodeReport, other: &NodeReport| {
        other.udp.as_ref().is_some_and(|udp| of.seeds.iter().any(|seed| names(seed, udp)))
    };
    if seeded(from, theirs) || seeded(theirs, from) {
        let mend = "is UDP let through by the firewalls of both hosts (`sudo nft list ruleset`), and is `ndl.port` the one that the seed names?";
        return ("a seed names it, and no answer has come".to_owned(), Some(mend.to_owned()));
    }
    if let Some(useless) = places::useless_seed(from, theirs).or_else(|| places::useless_seed(theirs, from)) {
        return told(useless);
    }
    if is_on_loopback(&from.interface) != is_on_loopback(&theirs.interface) {
        let seen = format!(
            "it asks at {}, the other at {}: one of them on its own host only",
            from.interface, theirs.interface
        );
        let mend = "set `interface` under [ndl] to the address of the interface between the hosts, in both";
        return (seen, Some(mend.to_owned()));
    }
    let udp = theirs.udp.as_deref().unwrap_or("ITS_ADDRESS:PORT");
    let seed = format!("[ndl] seeds = [\"{udp}\"] in the configuration of {}", from.name);
    told(groups::why_unheard(from, theirs, &seed))
}

/// Where a node looks for others.
fn asked(report: &NodeReport) -> String {
    let seeds = if report.seeds.is_empty() {
        "no seeds".to_owned()
    } else {
        format!("seeds {}", report.seeds.join(", "))
    };
    format!("{} at {}, {seeds}", groups::in_words(report), report.interface)
}

fn dial_in_words(peer: &PeerReport) -> (String, String) {
    let Some(dial) = &peer.dial else {
        return (
            String::new(),
            "is it just starting? Else its log and that of the other say which of them refuses the connection".to_owned(),
        );
    };
    let said = format!(
        "; {} dials in vain, the last of {} {} ago: {}",
        dial.failed,
        dial.address,
        time(dial.ago_us),
        dial.error
    );
    let address = &dial.address;
    let mend = match dial.fault.as_str() {
        "not proven" => {
            format!("TCP reaches {address}, and it is not proven who is there: {}", keys::remedy(&dial.error))
        }
        "hung up" => format!(
            "TCP reaches {address}, and whoever is there hung up: is that its node, and what does its log say?"
        ),
        "refused" => nobody_listens(address),
        // Of a version that does not say.
        "" if dial.error.contains("refused") => nobody_listens(address),
        _ => format!(
            "TCP does not reach {address}: is there a route (`ip route get {}`), does a firewall drop it?",
            address.rsplit_once(':').map_or(address.as_str(), |(host, _)| host)
        ),
    };
    (said, mend)
}

fn nobody_listens(address: &str) -> String {
    format!(
        "nobody listens at {address}: does `gncl.announce` of the other name its real address, does a firewall reject TCP there?"
    )
}

/// What either of them has refused of the other just now.
fn refused_just_now<'a>(from: &'a End, to: &'a End) -> Vec<(&'a End, &'a RefusalReport)> {
    let of = |end: &'a End, other: &'a End| {
        let node = other.node.map(|node| node.to_string());
        let refusals = end.report.iter().flat_map(|report| &report.refusals);
        let concerns = refusals.filter(move |refusal| {
            refusal.ago_us < RECENT_US && node.as_ref().is_some_and(|node| speaks_of(&refusal.detail, node))
        });
        concerns.map(move |refusal| (end, refusal))
    };
    of(from, to).chain(of(to, from)).collect()
}

/// Whether a text has this address in it, and not only as a part of a longer one: `10.0.0.1` is not in `10.0.0.10`.
fn speaks_of(text: &str, address: &str) -> bool {
    text.match_indices(address).any(|(at, _)| {
        let (before, behind) = (&text[..at], &text[at + address.len()..]);
        !before.ends_with(char::is_alphanumeric) && !behind.starts_with(char::is_alphanumeric)
    })
}

/// An application that is ready by name, and whose actor does not come to its messages.
fn troubled(app: &App) -> Option<(String, &'static str)> {
    let line = app.line.as_ref()?;
    let is_well = line.state == "ready";
    (!is_well).then(|| {
        let reason =
            line.last_reason.as_ref().map_or_else(String::new, |reason| format!(", the last life {reason}"));
        let seen = format!("{} for {}{reason}", line.state, time(line.since_us));
        (seen, "`sinew tree` shows its supervisor, its log says more")
    })
}

/// The names that wait for each other in a circle with `name`, with `name` at both ends.
fn circle<'a>(name: &'a str, facts: &'a Facts) -> Option<Vec<&'a str>> {
    let mut ways = vec![vec![name]];
    let mut been = BTreeSet::new();
    while let Some(way) = ways.pop() {
        let last = way.last().copied()?;
        for next in facts.waits.get(last).into_iter().flatten() {
            let longer: Vec<_> = way.iter().copied().chain([next.as_str()]).collect();
            if next == name {
                return Some(longer);
            }
            if been.insert(next.as_str()) {
                ways.push(longer);
            }
        }
    }
    None
}

#[cfg(test)]
mod tests;
