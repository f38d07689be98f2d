//! What is heard of other nodes: who is there, whom messages reach, what each says about itself.

use sinew_runtime::{tid::NodeAddress, time::Time};

use super::{Core, Output, Reason, peers::Accepted};
use crate::{
    gncl::LinkFact,
    ndl::{LossReason, MembershipFact},
    sync::list::List,
};

/// Names that two nodes have, of which it was said, at most; of more it is not said.
const SAME_NAMES_MAX: usize = 1_024;

impl Core {
    pub(super) fn membership_changed(&mut self, fact: MembershipFact) {
        self.directory_changed();
        match fact {
            MembershipFact::NodeFound { node, incarnation, .. } => {
                self.peers.found(node, incarnation);
                self.route_groups(node);
            }
            // A double that nobody here takes for the node any more: messages reach the right one already.
            MembershipFact::NodeLost { node, incarnation, why: LossReason::Duplicate }
                if self.peers.linked(node).is_some_and(|life| life != incarnation) =>
            {
                self.peers.found_wrongly(node, incarnation);
            }
            MembershipFact::NodeLost { node, incarnation, why } => {
                let reason = match why {
                    LossReason::Left => Reason::NodeLeft,
                    LossReason::GaveUp(_)
                    | LossReason::Crashed
                    | LossReason::Hung
                    | LossReason::LinkDown
                    | LossReason::Restarted
                    | LossReason::Duplicate => Reason::NodeLost,
                };
                self.peers.lost(node, incarnation, reason);
                self.hear_no_more(node);
                self.route_groups(node);
            }
        }
    }

    pub(super) fn link_changed(&mut self, now: Time, fact: LinkFact) {
        self.directory_changed();
        match fact {
            LinkFact::LinkUp { node, incarnation } => {
                if !self.peers.link_up(now, node, incarnation) {
                    self.refuse(
                        "nodes",
                        format!("{node} is linked, but `ndl.nodes_max` nodes are known already"),
                    );
                }
                self.rendezvous.link_up(now, node);
                self.route_groups(node);
            }
            LinkFact::LinkBroken { node, incarnation } => {
                self.peers.link_broken(node, incarnation);
                self.hear_no_more(node);
            }
            // A link that was refused was down before. Whether its node is lost, NDL says.
            LinkFact::DialRefused { .. } => {}
            LinkFact::PeerLeft { node, incarnation, gave_up } => {
                let reason = if gave_up.is_some() { Reason::NodeLost } else { Reason::NodeLeft };
                self.peers.lost(node, incarnation, reason);
                self.peers.link_broken(node, incarnation);
                self.hear_no_more(node);
                self.route_groups(node);
            }
        }
    }

    pub(super) fn list_received(&mut self, from: NodeAddress, payload: &[u8]) {
        if from == self.node || !from.is_single() {
            return self.refuse("directory", format!("{from} is not another node"));
        }
        // A list that is longer than ours may be is not even looked at.
        if payload.len() > self.list_bytes_max {
            return self.refuse("directory", format!("{from} sent {} bytes", payload.len()));
        }
        match List::parse(payload) {
            Err(fault) => self.refuse("directory", format!("from {from}: {fault}")),
            Ok(list) => match self.peers.accept(from, list) {
                Err(why) => self.refuse("directory", format!("from {from}: {why}")),
                Ok(Accepted::New) => {
                    self.directory_changed();
                    self.route_groups(from);
                    for name in self.peers.names_of(from) {
                        self.note_same_name(&name);
                    }
                }
                Ok(Accepted::Again) => self.directory_changed(),
                Ok(Accepted::Same | Accepted::Old) => {}
            },
        }
    }

    /// What `node` said of barriers does not count any more, unless news of a former life changed nothing.
    fn hear_no_more(&mut self, node: NodeAddress) {
        if self.peers.current(node).is_none() {
            self.rendezvous.silent(node);
        }
    }

    fn route_groups(&mut self, node: NodeAddress) {
        if let Some(groups) = self.peers.changed_groups(node) {
            self.outputs.push_back(Output::RouteGroups { node, groups });
        }
    }

    pub(super) fn note_same_name(&mut self, name: &str) {
        let tids = self.called(name);
        if tids.len() > 1 && self.same_names.len() < SAME_NAMES_MAX && self.same_names.insert(name.to_owned())
        {
            self.outputs.push_back(Output::SameName { name: name.to_owned(), tids });
        }
    }
}
