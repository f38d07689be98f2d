//! Incarnations that authenticated themselves to GNCL, where nodes have keys. No datagram replaces such an
//! incarnation. A leave in its name is accepted until it answers again
//! (docs/book/src/explanation/threats.md).
//!
//! Every node of a project can forge the datagrams of any other node, and so can a stolen one. The connection
//! authenticates an incarnation: its certificate is shown there and nowhere else. While the connection is
//! established, another incarnation that answers in its node's name, from any address, is only a hint. A
//! process that has ended has no connection: its host closes it at once, or GNCL detects the loss within 4 s
//! (GNCL-9). NDL counts the answers missed meanwhile. // spec: NDL-5.8

use std::collections::BTreeMap;

use sinew_model::{config::NodeConfig, facts::LinkFact, refusals::Refusals};
use sinew_runtime::{
    tid::{Incarnation, NodeAddress},
    time::Time,
};

use super::{
    Member, Place, contact::Role, contacts::Contacts, incarnations::AcceptedAnswer, members::Members,
};
use crate::datagram::Announcement;

/// The incarnations with an established connection, for at most `nodes_max` nodes. GNCL may connect a node
/// before NDL knows it, so they are not stored in the members. Their authentication only counts where nodes
/// have keys.
#[derive(Debug)]
pub(super) struct Authenticated {
    nodes_max: usize,
    is_required: bool,
    connected: BTreeMap<NodeAddress, Incarnation>,
}

impl Authenticated {
    pub(super) fn new(config: &NodeConfig) -> Self {
        let (nodes_max, is_required) = (config.ndl.nodes_max, config.security.keys.is_some());
        Self { nodes_max, is_required, connected: BTreeMap::new() }
    }

    /// Returns whether connections authenticate their peers.
    pub(super) const fn is_required(&self) -> bool {
        self.is_required
    }

    /// Records a connection that was made or ended.
    pub(super) fn link_changed(&mut self, fact: &LinkFact) {
        match *fact {
            LinkFact::LinkUp { node, incarnation } => {
                // GNCL has at most that many peers.
                if self.connected.len() < self.nodes_max || self.connected.contains_key(&node) {
                    self.connected.insert(node, incarnation);
                }
            }
            LinkFact::LinkBroken { node, incarnation } | LinkFact::PeerLeft { node, incarnation, .. } => {
                self.lost(node, incarnation);
            }
            LinkFact::DialRefused { .. } => {}
        }
    }

    /// Removes an incarnation that NDL lost, since that ends its connection.
    pub(super) fn lost(&mut self, node: NodeAddress, incarnation: Incarnation) {
        if self.is_connected(node, incarnation) {
            self.connected.remove(&node);
        }
    }

    /// Updates the established connections after a restart of GNCL.
    pub(super) fn check_links(&mut self, is_connected: impl Fn(NodeAddress, Incarnation) -> bool) {
        self.connected.retain(|node, incarnation| is_connected(*node, *incarnation));
    }

    /// Returns whether this incarnation has a connection, authenticated or not.
    pub(super) fn is_connected(&self, node: NodeAddress, incarnation: Incarnation) -> bool {
        self.connected.get(&node) == Some(&incarnation)
    }

    /// Returns the authenticated incarnation of a node.
    fn incarnation_of(&self, node: NodeAddress) -> Option<Incarnation> {
        self.connected.get(&node).copied().filter(|_| self.is_required)
    }

    /// Returns whether any node accepts this node's identity on an authenticated connection now.
    pub(super) fn is_any(&self) -> bool {
        self.is_required && !self.connected.is_empty()
    }

    /// Returns whether the member at `node` is the incarnation with the established connection.
    pub(super) fn has(&self, members: &Members, node: NodeAddress) -> bool {
        let incarnation = members.get(&node).map(|member| member.announcement.incarnation);
        incarnation.is_some() && self.incarnation_of(node) == incarnation
    }

    /// Returns whether a member's identity is trusted. Where nodes have keys, that requires authentication.
    /// // spec: NDL-2.5
    pub(super) fn trusts(&self, members: &Members, node: NodeAddress) -> bool {
        members.contains_key(&node) && (!self.is_required || self.has(members, node))
    }

    /// Returns whether a lost member bars earlier incarnations of its node. Where connections authenticate
    /// peers, a member that never had one does not.
    pub(super) const fn bars_earlier(&self, member: &Member) -> bool {
        !self.is_required || member.has_been_linked()
    }

    /// Returns whether an answer contradicts an established connection: another incarnation of its node has
    /// it, or the node that was queried there. That is counted in `refusals`.
    pub(super) fn contradicts(
        &self,
        now: Time,
        answer: &AcceptedAnswer,
        (members, contacts): (&Members, &Contacts),
        refusals: &Refusals,
    ) -> bool {
        let claimed = &answer.announcement;
        let is_other_incarnation = self.incarnation_of(claimed.node).is_some_and(|connected| {
            let known = members.get(&claimed.node).map(|member| &member.announcement);
            let is_known_otherwise =
                |known: &Announcement| known.incarnation == connected && !known.is_same_incarnation(claimed);
            connected != claimed.incarnation || known.is_some_and(is_known_otherwise)
        });
        let there = self.member_at(answer.from, members, contacts).filter(|other| *other != claimed.node);
        let Some(holder) = (if is_other_incarnation { Some(claimed.node) } else { there }) else {
            return false;
        };
        let Announcement { node, incarnation, ref name, .. } = *claimed;
        let (its_name, at) = members.get(&holder).map_or(("?", None), |holder| {
            (holder.announcement.name.as_str(), Some(holder.routes.best().there))
        });
        let what = format_args!(
            "{} claims to be the node {name:?} with address {node} in incarnation {incarnation}; the node {its_name:?} ({at:?}) is \
             connected, and its connection is authenticated",
            answer.from.there
        );
        refusals.count(now, "NDL answer of an unauthenticated incarnation", &what);
        true
    }

    /// Returns the authenticated member that is queried at `place`.
    fn member_at(&self, place: Place, members: &Members, contacts: &Contacts) -> Option<NodeAddress> {
        let Role::Member(node) = contacts.role_at(&place)? else { return None };
        self.has(members, node).then_some(node)
    }
}
