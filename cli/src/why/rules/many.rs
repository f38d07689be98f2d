//! Whom a message to many reaches, the members of a group or everybody, and which rule of which node's access list decides of each.

use sinew::{AppAddress, Tid};

use super::{
    super::facts::{End, Facts, Many, Member, MembersOn},
    State, Step, Steps,
    access::in_words,
};

/// Members, groups or nodes that are told by name in one step.
const SHOWN: usize = 8;

impl Many {
    /// What it is, for people.
    fn seen(&self) -> String {
        match self.tid.app {
            app if app.is_group() => format!("group {}", self.tid),
            AppAddress::ALL => format!("every application at {}", self.tid),
            _ => format!("the applications at {}", self.tid),
        }
    }
}

impl Steps {
    /// Every step from the one that sends to each of the many, in the order in which a message meets them. Nothing comes back from many.
    pub(super) fn towards_many(&mut self, many: &Many, facts: &Facts) {
        let (from, to) = (&facts.ends[1 - many.end], &facts.ends[many.end]);
        if many.is_sender_many {
            let seen = "it stands for many, and a message has one sender";
            self.blocked(format!("{} sends", from.label()), seen, "name the application that sends");
        } else {
            self.there(from, facts);
            self.meant(from);
            self.address(facts);
            self.application((from, to), None, facts);
        }
        self.members(many, to);
        self.ways(many, from);
        self.may_send_to_many(many, from, to);
    }

    /// Who would get it.
    fn members(&mut self, many: &Many, to: &End) {
        let what = format!("{} has members", to.label());
        let at = |on: &MembersOn| {
            let more = if on.left_out > 0 {
                format!(", and {} more that had no room in its answer", on.left_out)
            } else {
                String::new()
            };
            format!("{}{more} on {}", named(on.members.iter()), on.node.label())
        };
        let places: Vec<_> = many.places.iter().take(SHOWN).map(at).collect();
        let more = more(many.places.len() - places.len(), "nodes");
        let unsaid: Vec<_> = many
            .unsaid
            .iter()
            .take(SHOWN)
            .map(|(node, why)| format!("; {node} did not say whom it has: {why}"))
            .collect();
        let unsaid = unsaid.concat();
        let (seen, is_known) = (many.seen(), many.unsaid.is_empty());
        let ask_again = "ask again, with more time if need be (--deadline-ms); `sinew nodes` shows its links";
        if !many.places.is_empty() {
            let seen = format!("{seen}: {}{more}{unsaid}", places.join("; "));
            if is_known { self.fine(what, seen) } else { self.note(what, seen, ask_again) }
        } else if is_known {
            let mend = "is the name spelled right? A member has joined by it (`join`) and is registered; the sender gets nothing of its own";
            self.blocked(what, format!("{seen}: no application of any node that was asked"), mend);
        } else {
            self.blocked(what, format!("{seen}: none that is known{unsaid}"), ask_again);
        }
    }

    /// Whether messages flow to the nodes where the members are; those that are as they should be in one step.
    fn ways(&mut self, many: &Many, from: &End) {
        if from.report.is_none() {
            return;
        }
        let mut reached = Vec::new();
        for on in many.places.iter().filter(|on| on.node.node != from.node) {
            let mut way = Self(Vec::new());
            way.project(from, &on.node);
            way.keys(from, &on.node);
            way.known(from, &on.node);
            way.linked(from, &on.node);
            let troubles: Vec<Step> = way.0.into_iter().filter(|step| step.state != State::Fine).collect();
            if troubles.is_empty() {
                reached.push(on.node.label());
            }
            self.0.extend(troubles);
        }
        if !reached.is_empty() {
            let shown = reached.iter().take(SHOWN).copied().collect::<Vec<_>>().join(", ");
            let more = more(reached.len().saturating_sub(SHOWN), "nodes");
            self.fine(
                format!("{} reaches nodes of members", from.label()),
                format!("connected to {shown}{more}"),
            );
        }
    }

    /// What the list of each member's node says. That of many some may not get it is often meant so; that nobody may
    /// who is known is in the way.
    fn may_send_to_many(&mut self, many: &Many, from: &End, to: &End) {
        let has_list = many.places.iter().any(|on| on.is_given);
        if !many.is_judged {
            if has_list && from.node.is_some() {
                self.note(
                    format!("{} may send to {}", from.label(), to.label()),
                    "there are access lists, and which application would send is open",
                    format!("`sinew why` with an application of {} by its name or TID", from.node_label()),
                );
            }
            return;
        }
        let is_for_nobody = many.places.iter().flat_map(|on| &on.members).all(Member::is_refused_all);
        for on in &many.places {
            let what = format!("{} may send to {} on {}", from.label(), to.label(), on.node.label());
            if !on.is_given {
                self.fine(what, format!("node {} has no access list", on.node.label()));
                continue;
            }
            let parts = alike(&on.members);
            let are_several = parts.len() > 1;
            for part in parts {
                let what = if are_several {
                    format!("{what}: {}", named(part.iter().copied()))
                } else {
                    what.clone()
                };
                let mend = mend(many, to, on);
                self.allowed(what, &part, (is_for_nobody, mend));
            }
        }
    }

    /// What the list says of some for whom it says the same, whether that is in the way where it refuses, and what mends it.
    fn allowed(&mut self, what: String, part: &[&Member], (is_in_the_way, mend): (bool, String)) {
        let Some((first, others)) = part.split_first() else { return };
        let same = if others.is_empty() {
            String::new()
        } else {
            format!("; the same for {}", named(others.iter().copied()))
        };
        let seen = format!("{}{same}", in_words(&first.verdicts));
        if first.verdicts.iter().all(|verdict| verdict.is_allowed) {
            self.fine(what, seen);
        } else if is_in_the_way {
            self.blocked(what, seen, mend);
        } else {
            self.note(what, seen, mend);
        }
    }

    /// Groups of the one by which the list lets through what it refuses to it alone, or the other way round. What goes to it alone does not
    /// go that way, so nothing of this is in the way.
    pub(super) fn by_groups(&mut self, a: &End, b: &End, facts: &Facts) {
        let [there, back] = &facts.by_groups;
        for (groups, from, to) in [(there, a, b), (back, b, a)] {
            for part in alike(groups) {
                let what = format!(
                    "{} may send to {} by group {}",
                    from.label(),
                    to.label(),
                    named(part.iter().copied())
                );
                let mend = format!(
                    "have a [[rule]] of that list allow it, with `groups` or `to`, before any that refuses it; then `sinew reload` on the host of {}",
                    to.node_label()
                );
                self.allowed(what, &part, (false, mend));
            }
        }
    }
}

impl Member {
    /// Whether the list lets nothing through to it.
    fn is_refused_all(&self) -> bool {
        !self.verdicts.is_empty() && self.verdicts.iter().all(|verdict| !verdict.is_allowed)
    }

    /// What the list says of each class, and by which rule: its number stands first in what is said of it, and for whom behind it.
    fn rules(&self) -> Vec<(bool, &str)> {
        let rules = self.verdicts.iter().map(|verdict| {
            let why = verdict.why.as_str();
            (verdict.is_allowed, why.split_once(", for ").map_or(why, |(rule, _)| rule))
        });
        rules.collect()
    }
}

/// Those of whom a list says the same by the same rules, together.
fn alike(members: &[Member]) -> Vec<Vec<&Member>> {
    let mut parts: Vec<Vec<&Member>> = Vec::new();
    for member in members {
        let same =
            |part: &&mut Vec<&Member>| part.first().is_some_and(|first| first.rules() == member.rules());
        match parts.iter_mut().find(same) {
            Some(part) => part.push(member),
            None => parts.push(vec![member]),
        }
    }
    parts
}

/// The first of them by name, and how many more there are.
fn named<'a>(members: impl ExactSizeIterator<Item = &'a Member>) -> String {
    let count = members.len();
    let shown: Vec<_> = members.take(SHOWN).map(|member| member.label.as_str()).collect();
    format!("{}{}", shown.join(", "), more(count - shown.len(), ""))
}

fn more(count: usize, of_what: &str) -> String {
    let words = format!(" and {count} more {of_what}");
    if count == 0 { String::new() } else { words.trim_end().to_owned() }
}

/// What lets it through to those on one node.
fn mend(many: &Many, to: &End, on: &MembersOn) -> String {
    let host = on.node.label();
    let reload = format!("before any that refuses it, then `sinew reload` on the host of {host}");
    if !many.tid.app.is_group() {
        return format!(
            "have a [[rule]] of that list allow it (`to`: what is for all is judged member by member), {reload}"
        );
    }
    // What travels is a number, from which no name comes back.
    let is_number = to.wanted.parse::<Tid>().is_ok();
    let name = if is_number { "THE GROUP'S NAME" } else { to.wanted.as_str() };
    format!(
        "have a [[rule]] of that list allow it (`groups = [\"{name}\"]`: every member; `to`: some), {reload}"
    )
}
