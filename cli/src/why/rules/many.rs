//! The applications that a message to many reaches, the members of a group or all, and the access list rule that
//! decides on each.

use sinew::{AppAddress, Tid};

use super::{
    super::facts::{Facts, Many, Member, MembersOn, TrafficEnd},
    State, Step, Steps,
    access::{in_words, sender},
};

/// Maximum number of members, groups or nodes that are named in one step.
const SHOWN: usize = 8;

impl Many {
    /// Returns a description for users.
    fn detail(&self) -> String {
        match self.tid.app {
            app if app.is_group() => format!("group {}", self.tid),
            AppAddress::ALL => format!("every application at {}", self.tid),
            _ => format!("the applications at {}", self.tid),
        }
    }
}

impl Steps {
    /// Adds every step from the sender to each of the many, in the order in which a message passes them. Many have no
    /// path back.
    pub(super) fn towards_many(&mut self, many: &Many, facts: &Facts) {
        let (from, to) = (&facts.ends[1 - many.end], &facts.ends[many.end]);
        if many.is_sender_many {
            let detail = "it stands for several applications, and a message has one sender";
            self.blocked(format!("{} sends", from.label()), detail, "name the application that sends");
        } else {
            self.there(from, to, facts);
            self.meant(from);
            self.address(facts);
            self.application((from, to), None, facts);
        }
        self.members(many, to);
        self.ways(many, from);
        self.handled_by_many(many, from);
        self.may_send_to_many(many, from, to);
    }

    /// Adds the step of the receivers.
    fn members(&mut self, many: &Many, to: &TrafficEnd) {
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
        let unreported: Vec<_> = many
            .unreported
            .iter()
            .take(SHOWN)
            .map(|(node, why)| format!("; {node} did not report its members: {why}"))
            .collect();
        let unreported = unreported.concat();
        let (detail, is_known) = (many.detail(), many.unreported.is_empty());
        let ask_again = "ask again, with more time if need be (--deadline-ms); `sinew nodes` shows its links";
        if !many.places.is_empty() {
            let detail = format!("{detail}: {}{more}{unreported}", places.join("; "));
            if is_known { self.fine(what, detail) } else { self.note(what, detail, ask_again) }
        } else if is_known {
            let fix = "is the name spelled right? A member has joined by it (`join`) and is registered; the sender gets nothing of its own";
            self.blocked(what, format!("{detail}: no application of any node that was asked"), fix);
        } else {
            self.blocked(what, format!("{detail}: none that is known{unreported}"), ask_again);
        }
    }

    /// Adds the steps of the connections to the nodes of the members; the working ones share one step.
    fn ways(&mut self, many: &Many, from: &TrafficEnd) {
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

    /// Adds the verdicts of the list of each member's node. A refusal for some of many is often intended; a refusal for
    /// all known members blocks.
    fn may_send_to_many(&mut self, many: &Many, from: &TrafficEnd, to: &TrafficEnd) {
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
                let fix = fix(many, (from, to), on);
                self.allowed(what, &part, (is_for_nobody, fix));
            }
        }
    }

    /// Adds the step of members with the same verdicts: whether a refusal blocks, and the suggested fix.
    fn allowed(&mut self, what: String, part: &[&Member], (is_in_the_way, fix): (bool, String)) {
        let Some((first, others)) = part.split_first() else { return };
        let same = if others.is_empty() {
            String::new()
        } else {
            format!("; the same for {}", named(others.iter().copied()))
        };
        let detail = format!("{}{same}", in_words(&first.verdicts));
        if first.is_allowed_all() {
            self.fine(what, detail);
        } else if is_in_the_way {
            self.blocked(what, detail, fix);
        } else {
            self.note(what, detail, fix);
        }
    }

    /// Adds the groups of the receiver for which the list's verdict differs from that on messages to it alone. Messages
    /// to it alone do not use a group, so this never blocks.
    pub(super) fn by_groups(&mut self, a: &TrafficEnd, b: &TrafficEnd, facts: &Facts) {
        let [there, back] = &facts.by_groups;
        for (groups, from, to, is_asked_for) in [(there, a, b, true), (back, b, a, false)] {
            for part in alike(groups) {
                // Nothing on the way from `a` to `b` needs a group of `a`.
                if !is_asked_for && part.iter().any(|member| !member.is_allowed_all()) {
                    continue;
                }
                let what = format!(
                    "{} may send to {} by group {}",
                    from.label(),
                    to.label(),
                    named(part.iter().copied())
                );
                let fix = format!(
                    "have a [[rule]] of that list allow it, with `groups` or `to`, before any that refuses it; then `sinew reload` on the host of {}",
                    to.node_label()
                );
                self.allowed(what, &part, (false, fix));
            }
        }
    }
}

impl Member {
    /// Returns whether the list allows no class.
    fn is_refused_all(&self) -> bool {
        !self.verdicts.is_empty() && self.verdicts.iter().all(|verdict| !verdict.is_allowed)
    }

    fn is_allowed_all(&self) -> bool {
        self.verdicts.iter().all(|verdict| verdict.is_allowed)
    }

    /// Returns the verdict on each class and its rule: the text starts with the number of the rule, followed by the
    /// names.
    fn rules(&self) -> Vec<(bool, &str)> {
        let rules = self.verdicts.iter().map(|verdict| {
            let why = verdict.why.as_str();
            (verdict.is_allowed, why.split_once(", for ").map_or(why, |(rule, _)| rule))
        });
        rules.collect()
    }
}

/// Returns the members grouped by equal verdicts of equal rules.
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

/// Returns the first of them by name, and the number of further ones.
fn named<'a>(members: impl ExactSizeIterator<Item = &'a Member>) -> String {
    let count = members.len();
    let shown: Vec<_> = members.take(SHOWN).map(|member| member.label.as_str()).collect();
    format!("{}{}", shown.join(", "), more(count - shown.len(), ""))
}

fn more(count: usize, of_what: &str) -> String {
    let words = format!(" and {count} more {of_what}");
    if count == 0 { String::new() } else { words.trim_end().to_owned() }
}

/// Returns the fix that allows messages to the members on one node.
fn fix(many: &Many, (from, to): (&TrafficEnd, &TrafficEnd), on: &MembersOn) -> String {
    let host = on.node.label();
    let reload = format!("before any that refuses it, then `sinew reload` on the host of {host}");
    if !many.tid.app.is_group() {
        return format!(
            "have a [[rule]] of that list allow it (`to`: what is for all is judged member by member), {reload}"
        );
    }
    // A message carries the group's number, from which the name cannot be derived.
    let is_number = to.wanted.parse::<Tid>().is_ok();
    let name = if is_number { "THE GROUP'S NAME" } else { to.wanted.as_str() };
    let rule = format!("[[rule]]\nfrom = [\"{}\"]\ngroups = [\"{name}\"]", sender(from));
    format!("have a rule of that list allow it (`groups`: every member; `to`: some), {reload}:\n{rule}")
}
