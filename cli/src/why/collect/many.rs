//! Collects the receivers of a message to many, the members of a group or all applications, from the nodes that host
//! them.

use sinew::{
    AppAddress, NodeAddress, Outcome, Payload, Tid,
    client::ApiError,
    inspect::{AccessReport, AskGroups, AskReach, NodeReport, ReachReport, Reached},
    message::Rejection,
};

use super::{
    super::facts::{Many, Member, MembersOn, TrafficEnd},
    Collected, Found,
};
use crate::system::in_words;

/// Returns whether it names, or may name, more than one application: a group, every application, or an address on every
/// node.
pub(super) fn is_many(tid: Tid) -> bool {
    !tid.is_single() && tid.app != AppAddress::NONE && !tid.app.is_layer()
}

impl Collected<'_> {
    /// Returns the end that is many; if both are, the second, because many do not send.
    pub(super) fn many(&mut self, wanted: [&str; 2], found: &[Found; 2]) -> Option<Many> {
        for end in [1, 0] {
            let (tid, is_guessed) = match (found[end].many, found[end].node) {
                (Some(tid), _) => (tid, false),
                // No node and no application has this name; a group may have, if it has a member.
                (None, None) => (Tid::group(wanted[end]), true),
                (None, Some(_)) => continue,
            };
            let many = self.reached(end, tid, &found[1 - end]);
            if !is_guessed || !many.places.is_empty() {
                return Some(many);
            }
        }
        None
    }

    /// Asks every node which of its applications it would reach.
    fn reached(&mut self, end: usize, tid: Tid, sender: &Found) -> Many {
        let here = if tid.node == NodeAddress::HERE { self.nodes[0].node } else { tid.node };
        let tid = Tid::new(here, tid.app);
        let mut many = Many {
            end,
            tid,
            is_judged: sender.app.is_some(),
            is_sender_many: sender.many.is_some(),
            places: Vec::new(),
            unreported: Vec::new(),
        };
        let node = sender.node.unwrap_or(NodeAddress::HERE);
        let question = AskReach {
            source: sender.app.unwrap_or_else(|| Tid::new(node, AppAddress::INSPECT)),
            to: tid.app,
        };
        let is_meant = |node: NodeAddress| tid.node == NodeAddress::ALL || tid.node == node;
        let mut unreported = Vec::new();
        for at in 0..self.nodes.len() {
            let asked = &self.nodes[at];
            if !is_meant(asked.node) {
                continue;
            }
            let label = asked.label();
            let on_node = match asked.result.clone() {
                Ok(report) => self.ask_reach(at, &question).map(|reach| self.place(at, report, reach)),
                Err(why) => Err(why),
            };
            match on_node {
                // It has no receivers: only nodes with receivers are listed.
                Ok(place) if place.members.is_empty() && place.left_out == 0 => {}
                Ok(place) => many.places.push(place),
                Err(why) => unreported.push((at, (label, why))),
            }
        }
        // Messages to many stay in their project.
        let project = &self.nodes[sender.at.unwrap_or(0)].project;
        let is_of_project =
            |on: &MembersOn| on.node.report.as_ref().is_some_and(|report| report.project == *project);
        if many.places.iter().any(is_of_project) {
            many.places.retain(is_of_project);
            unreported.retain(|(at, _)| self.nodes[*at].project == *project);
        }
        many.unreported.extend(unreported.into_iter().map(|(_, of)| of));
        if !self.nodes.iter().any(|asked| is_meant(asked.node)) {
            let why = "no node that was asked knows it".to_owned();
            many.unreported.push((tid.node.to_string(), why));
        }
        many
    }

    fn ask_reach<Q: Payload>(&mut self, at: usize, question: &Q) -> Result<ReachReport, String> {
        let (node, through) = (self.nodes[at].node, self.nodes[at].through);
        let system = self.system(through);
        let within = system.within;
        let answer = system.endpoint.message(Tid::new(node, AppAddress::INSPECT), question).ask(within);
        answer.map_err(|error| {
            if let ApiError::Ended(Outcome::Rejected(Rejection::UnknownKind)) = error {
                return "it runs a version of Sinew that cannot be asked this; update it".to_owned();
            }
            in_words(&error)
        })
    }

    /// Returns the receivers on one node, without this program itself.
    fn place(&self, at: usize, report: NodeReport, reach: ReachReport) -> MembersOn {
        let asked = &self.nodes[at];
        let is_own = |tid: Tid| {
            self.first.own.contains(&tid) || self.others.iter().any(|other| other.own.contains(&tid))
        };
        let label = |tid: Tid| {
            let app = asked.named_apps().iter().find(|app| app.tid == tid);
            app.and_then(|app| app.name.clone()).unwrap_or_else(|| tid.to_string())
        };
        let members = reach.reached.into_iter().filter(|one| !is_own(one.app));
        let members = members
            .map(|Reached { app, verdicts, .. }| Member { label: label(app), app, verdicts })
            .collect();
        let node = TrafficEnd {
            wanted: asked.label(),
            node: Some(asked.node),
            report: Some(report),
            ..TrafficEnd::default()
        };
        MembersOn { node, is_given: reach.is_given, members, left_out: reach.left_out }
    }

    /// Returns the groups for which the verdict of the receiver's list differs from that on direct messages, if both
    /// ends are applications and the list applies to them.
    pub(super) fn by_groups(
        &mut self,
        access: Option<&AccessReport>,
        (source, target): (&Found, &Found),
    ) -> Vec<Member> {
        let (Some(source), Some(member), Some(at)) = (source.app, target.app, target.at) else {
            return Vec::new();
        };
        if !access.is_some_and(|access| access.is_given) {
            return Vec::new();
        }
        // A node of an older version does not know the question; its verdict on direct messages is reported.
        let reached = self.ask_reach(at, &AskGroups { source, member }).map(|report| report.reached);
        let reached = reached.unwrap_or_default().into_iter();
        let label = |to: AppAddress| Tid::new(NodeAddress::ALL, to).to_string();
        reached.map(|Reached { to, app, verdicts }| Member { label: label(to), app, verdicts }).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn groups_and_broadcasts_are_many_unlike_single_addresses() {
        for (tid, is_it) in [
            ("*/f0000007", true),
            ("10.0.0.2/f0000007", true),
            ("here/f0000007", true),
            ("*/*", true),
            ("10.0.0.2/*", true),
            ("*/1001", true),
            ("10.0.0.2/1001", false),
            ("10.0.0.2/inspect", false),
            ("*/ndl", false),
            ("*/0", false),
        ] {
            assert_eq!(is_many(tid.parse().expect("a TID")), is_it, "{tid}");
        }
    }
}
