//! Lives that have proven themselves to GNCL, where nodes have keys: no datagram puts another life in their place. One that says in their name that they leave
//! is believed, until they answer again (docs/THREAT_MODEL.md).
//!
//! Every node of a project can make datagrams that pass for any other node's, so one that was stolen can, too. The connection is what
//! proves a life: its certificate is shown there and nowhere else. As long as it stands, another life that answers in its node's name, from
//! wherever, is a hint and no more. A process that has ended has no connection any more: its host ends it at once, or GNCL finds it
//! dead within 4 s (GNCL-9), and NDL counts what it misses meanwhile. // spec: NDL-5.8

use std::{collections::BTreeMap, time::Duration};

use sinew_runtime::{
    tid::{Incarnation, NodeAddress},
    time::Time,
};

use super::{Core, Member, Place, contact::Role, lives::Proof};
use crate::{
    config::NodeConfig,
    gncl::LinkFact,
    ndl::{LossReason, datagram::Announcement},
};

/// For so long after the loss of a life no earlier one takes its place.
const EARLIER_LIFE_BARRED: Duration = Duration::from_secs(15);

/// Which lives have a connection that stands, of `nodes_max` nodes at most. GNCL may link a node before NDL knows it, so these are not members'
/// own. What that proves is asked where nodes have keys, and nowhere else.
#[derive(Debug)]
pub(super) struct Proven {
    nodes_max: usize,
    proves: bool,
    lives: BTreeMap<NodeAddress, Incarnation>,
}

impl Proven {
    pub(super) fn new(config: &NodeConfig) -> Self {
        let (nodes_max, proves) = (config.ndl.nodes_max, config.security.keys.is_some());
        Self { nodes_max, proves, lives: BTreeMap::new() }
    }

    /// Whether a connection proves who is at its other end.
    const fn is_asked(&self) -> bool {
        self.proves
    }

    fn note(&mut self, fact: &LinkFact) {
        match *fact {
            LinkFact::LinkUp { node, incarnation } => {
                // GNCL has no more peers than that.
                if self.lives.len() < self.nodes_max || self.lives.contains_key(&node) {
                    self.lives.insert(node, incarnation);
                }
            }
            LinkFact::LinkBroken { node, incarnation } | LinkFact::PeerLeft { node, incarnation, .. } => {
                self.lost(node, incarnation);
            }
            LinkFact::DialRefused { .. } => {}
        }
    }

    /// NDL's own word ends the connection of this life.
    pub(super) fn lost(&mut self, node: NodeAddress, incarnation: Incarnation) {
        if self.stands(node, incarnation) {
            self.lives.remove(&node);
        }
    }

    /// GNCL was restarted, and these are the connections that stand.
    pub(super) fn look_at_links(&mut self, stands: impl Fn(NodeAddress, Incarnation) -> bool) {
        self.lives.retain(|node, incarnation| stands(*node, *incarnation));
    }

    /// Whether there is a connection with this life, whatever it proves.
    pub(super) fn stands(&self, node: NodeAddress, incarnation: Incarnation) -> bool {
        self.lives.get(&node) == Some(&incarnation)
    }

    /// The life that has proven itself.
    fn life_of(&self, node: NodeAddress) -> Option<Incarnation> {
        self.lives.get(&node).copied().filter(|_| self.proves)
    }

    /// Whether any node holds this one for what it says that it is, now.
    pub(super) fn is_anybody(&self) -> bool {
        self.proves && !self.lives.is_empty()
    }
}

impl Core {
    /// A connection was made or ended. Who proves to be another life than the one that answered in its name takes that one's place.
    pub(super) fn note_proof(&mut self, now: Time, fact: &LinkFact) {
        self.proven.note(fact);
        let LinkFact::LinkUp { node, incarnation } = *fact else { return };
        let is_other = |member: &Member| member.announcement.incarnation != incarnation;
        if self.proven.is_asked() && self.members.get(&node).is_some_and(is_other) {
            self.lose(now, node, LossReason::Duplicate);
        }
        self.note_all_met(node);
        for place in self.settle_remembered(node) {
            self.ask_unless_just_asked(now, place);
        }
    }

    /// Whether what was answered contradicts a connection that stands: another life of its node has it, or the node that was asked there.
    pub(super) fn contradicts_a_proof(&mut self, now: Time, proof: &Proof) -> bool {
        let claimed = &proof.announcement;
        let is_other_life = self.proven.life_of(claimed.node).is_some_and(|life| {
            let known = self.members.get(&claimed.node).map(|member| &member.announcement);
            let is_known_otherwise =
                |known: &Announcement| known.incarnation == life && !known.is_same_life(claimed);
            life != claimed.incarnation || known.is_some_and(is_known_otherwise)
        });
        let is_another_there = self.proven_member_at(proof.from).is_some_and(|other| other != claimed.node);
        if is_other_life || is_another_there {
            let Announcement { node, incarnation, ref name, .. } = *claimed;
            let at_that_place = || self.members.get(&self.proven_member_at(proof.from)?);
            let holder = if is_other_life { self.members.get(&node) } else { at_that_place() };
            let (its_name, at) = holder.map_or(("?", None), |holder| {
                (holder.announcement.name.as_str(), Some(holder.routes.best().there))
            });
            let what = format_args!(
                "{} says that it is the node {name:?} with address {node} in life {incarnation}; the node {its_name:?} ({at:?}) proved itself, and \
                 is connected",
                proof.from.there
            );
            self.refusals.count(now, "NDL answer of a life that is not proven", &what);
        }
        is_other_life || is_another_there
    }

    fn proven_member_at(&self, place: Place) -> Option<NodeAddress> {
        let Role::Member(node) = self.contacts.get(&place)?.role else { return None };
        self.is_proven(node).then_some(node)
    }

    /// Whether connections prove who is at their other end.
    pub(super) const fn proves_peers(&self) -> bool {
        self.proven.is_asked()
    }

    /// Whether the member at `node` is the life whose connection stands.
    pub(super) fn is_proven(&self, node: NodeAddress) -> bool {
        let life = self.members.get(&node).map(|member| member.announcement.incarnation);
        life.is_some() && self.proven.life_of(node) == life
    }

    /// Whether a lost member bars earlier lives of its node: where connections prove, one that never had any has proven nothing.
    pub(super) fn bars_earlier(&self, member: &Member) -> bool {
        !self.proven.is_asked() || member.link_until != Time::ZERO
    }

    /// Since when an earlier life than one that was lost then may come: its host's clock may have begun anew. By then a process that was only
    /// frozen, or cut off, has found that a later one is there, if there is one (NDL-5.7). // spec: NDL-5.2
    pub(super) fn earlier_may_come(&self, now: Time, lost: Time) -> bool {
        now.since(lost) >= EARLIER_LIFE_BARRED.max(self.loss_bound() * 2)
    }
}
