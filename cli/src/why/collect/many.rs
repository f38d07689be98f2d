//! Whom a message to many reaches, the members of a group or everybody, as the nodes say at which they are.

use sinew::{
    AppAddress, NodeAddress, Outcome, Payload, Tid,
    client::ApiError,
    inspect::{AccessReport, AskGroups, AskReach, NodeReport, ReachReport, Reached},
    message::Rejection,
};

use super::{
    super::facts::{End, Many, Member, MembersOn},
    Found, Gathered,
};
use crate::system::in_words;

/// Whether it names more than one application, or may: a group, every application, or the one at an address on every node.
pub(super) fn is_many(tid: Tid) -> bool {
    !tid.is_single() && tid.app != AppAddress::NONE && !tid.app.is_layer()
}

impl Gathered<'_> {
    /// The one of the two that is many, if one is; of two the second, as nothing is sent by many.
    pub(super) fn many(&mut self, wanted: [&str; 2], found: &[Found; 2]) -> Option<Many> {
        for end in [1, 0] {
            let (tid, is_guessed) = match (found[end].many, found[end].node) {
                (Some(tid), _) => (tid, false),
                // No node and no application is called so; a group may be, where somebody is in it.
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

    /// Asks every node whom of its applications it would reach.
    fn reached(&mut self, end: usize, tid: Tid, sender: &Found) -> Many {
        let here = if tid.node == NodeAddress::HERE { self.nodes[0].node } else { tid.node };
        let tid = Tid::new(here, tid.app);
        let mut many = Many {
            end,
            tid,
            is_judged: sender.app.is_some(),
            is_sender_many: sender.many.is_some(),
            places: Vec::new(),
            unsaid: Vec::new(),
        };
        let node = sender.node.unwrap_or(NodeAddress::HERE);
        let question = AskReach {
            source: sender.app.unwrap_or_else(|| Tid::new(node, AppAddress::INSPECT)),
            to: tid.app,
        };
        let is_meant = |node: NodeAddress| tid.node == NodeAddress::ALL || tid.node == node;
        for at in 0..self.nodes.len() {
            let asked = &self.nodes[at];
            if !is_meant(asked.node) {
                continue;
            }
            let label = asked.label();
            let said = match asked.said.clone() {
                Ok(report) => self.ask_reach(at, &question).map(|said| self.place(at, report, said)),
                Err(why) => Err(why),
            };
            match said {
                // Nobody there gets it: what is told are those who do.
                Ok(place) if place.members.is_empty() && place.left_out == 0 => {}
                Ok(place) => many.places.push(place),
                Err(why) => many.unsaid.push((label, why)),
            }
        }
        if !self.nodes.iter().any(|asked| is_meant(asked.node)) {
            let why = "no node that was asked knows it".to_owned();
            many.unsaid.push((tid.node.to_string(), why));
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

    /// Those of one node, without this program itself.
    fn place(&self, at: usize, report: NodeReport, said: ReachReport) -> MembersOn {
        let asked = &self.nodes[at];
        let is_own = |tid: Tid| {
            self.first.own.contains(&tid) || self.others.iter().any(|other| other.own.contains(&tid))
        };
        let label = |tid: Tid| {
            let app = asked.named_apps().iter().find(|app| app.tid == tid);
            app.and_then(|app| app.name.clone()).unwrap_or_else(|| tid.to_string())
        };
        let members = said.reached.into_iter().filter(|one| !is_own(one.app));
        let members =
            members.map(|Reached { app, verdicts, .. }| Member { label: label(app), verdicts }).collect();
        let node =
            End { wanted: asked.label(), node: Some(asked.node), report: Some(report), ..End::default() };
        MembersOn { node, is_given: said.is_given, members, left_out: said.left_out }
    }

    /// By which groups the one reaches the other otherwise than by itself, where both are applications and the list of the node of the other
    /// says something of the two.
    pub(super) fn by_groups(
        &mut self,
        said: Option<&AccessReport>,
        (source, target): (&Found, &Found),
    ) -> Vec<Member> {
        let (Some(source), Some(member), Some(at)) = (source.app, target.app, target.at) else {
            return Vec::new();
        };
        if !said.is_some_and(|said| said.is_given) {
            return Vec::new();
        }
        // A node of an older version does not know the question; what it says of the two alone is told.
        let reached = self.ask_reach(at, &AskGroups { source, member }).map(|said| said.reached);
        let reached = reached.unwrap_or_default().into_iter();
        let label = |to: AppAddress| Tid::new(NodeAddress::ALL, to).to_string();
        reached.map(|Reached { to, verdicts, .. }| Member { label: label(to), verdicts }).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn groups_everybody_and_an_address_on_each_node_are_many_and_layers_and_one_application_are_not() {
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
