//! The state that other nodes published, and whether it is still valid.

mod peer;

use std::collections::{BTreeMap, BTreeSet};

use sinew_model::facts::{DeclaredTypes, LinkFact, LossReason, MembershipFact};
use sinew_runtime::{
    app::Requirement,
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    wire::Kind,
};
use sinew_security::access::ReportedNames;

use self::peer::{Listed, Peer};
use super::{Output, Reason, outputs::Outputs};
use crate::{
    list::{Entry, List, Name},
    own_app::{AppTypes, ListVersion},
};

/// The other nodes.
#[derive(Debug)]
pub(super) struct Peers {
    /// The address of this node.
    here: NodeAddress,
    nodes: BTreeMap<NodeAddress, Peer>,
    /// An index of the nodes that list each name.
    names: BTreeMap<Name, BTreeSet<NodeAddress>>,
    nodes_max: usize,
    /// Maximum size of a list, in bytes.
    list_bytes_max: usize,
}

/// The result of a received list.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Accepted {
    /// The list has new content.
    New,
    /// The list is already known, and becomes valid again after its node was unreachable.
    Again,
    /// The list is already known.
    Same,
    /// A newer list is known.
    Old,
}

impl Peers {
    /// Returns an empty table of the node `here`, for at most `nodes_max` other nodes.
    pub(super) const fn new(here: NodeAddress, nodes_max: usize, list_bytes_max: usize) -> Self {
        Self { here, nodes: BTreeMap::new(), names: BTreeMap::new(), nodes_max, list_bytes_max }
    }

    /// Returns the address of this node.
    pub(super) const fn here(&self) -> NodeAddress {
        self.here
    }

    /// Handles a node that was found or lost. Returns the node if its state may be invalid now.
    pub(super) fn membership_changed(
        &mut self,
        fact: MembershipFact,
        outputs: &mut Outputs,
    ) -> Option<NodeAddress> {
        match fact {
            MembershipFact::NodeFound { node, incarnation, .. } => {
                self.found(node, incarnation);
                self.route_groups(node, outputs);
                None
            }
            // The lost duplicate is not the linked incarnation: messages already reach the right node.
            MembershipFact::NodeLost { node, incarnation, why: LossReason::Duplicate }
                if self.linked(node).is_some_and(|linked| linked != incarnation) =>
            {
                self.found_wrongly(node, incarnation);
                None
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
                self.lost(node, incarnation, reason);
                self.route_groups(node, outputs);
                Some(node)
            }
        }
    }

    /// Handles a node that became reachable or unreachable. Returns the node if its state may be invalid now.
    pub(super) fn link_changed(&mut self, fact: LinkFact, outputs: &mut Outputs) -> Option<NodeAddress> {
        match fact {
            LinkFact::LinkUp { node, incarnation } => {
                if !self.link_up(node, incarnation) {
                    let detail = format!("{node} is linked, but `ndl.nodes_max` nodes are known already");
                    outputs.refuse("nodes", detail);
                }
                self.route_groups(node, outputs);
                None
            }
            LinkFact::LinkBroken { node, incarnation } => {
                self.link_broken(node, incarnation);
                Some(node)
            }
            // A rejected link was already down. NDL reports whether its node is lost.
            LinkFact::DialRefused { .. } => None,
            LinkFact::PeerLeft { node, incarnation, gave_up } => {
                let reason = if gave_up.is_some() { Reason::NodeLost } else { Reason::NodeLeft };
                self.lost(node, incarnation, reason);
                self.link_broken(node, incarnation);
                self.route_groups(node, outputs);
                Some(node)
            }
        }
    }

    /// Handles the list of `from`. Returns its effect if it is valid.
    pub(super) fn list_received(
        &mut self,
        from: NodeAddress,
        payload: &[u8],
        outputs: &mut Outputs,
    ) -> Option<Accepted> {
        let list = if from == self.here || !from.is_single() {
            Err(format!("{from} is not another node"))
        } else if payload.len() > self.list_bytes_max {
            // A list that exceeds the limit for this node's own list is not parsed.
            Err(format!("{from} sent {} bytes", payload.len()))
        } else {
            List::parse(payload).map_err(|fault| format!("from {from}: {fault}"))
        };
        let accepted =
            list.and_then(|list| self.accept(from, list).map_err(|why| format!("from {from}: {why}")));
        match accepted {
            Ok(accepted) => {
                if accepted == Accepted::New {
                    self.route_groups(from, outputs);
                }
                Some(accepted)
            }
            Err(detail) => {
                outputs.refuse("directory", detail);
                None
            }
        }
    }

    fn route_groups(&mut self, node: NodeAddress, outputs: &mut Outputs) {
        if let Some(groups) = self.changed_groups(node) {
            outputs.push(Output::RouteGroups { node, groups });
        }
    }

    /// Records the link to this incarnation of `node`. Returns whether there was room for the node.
    fn link_up(&mut self, node: NodeAddress, incarnation: Incarnation) -> bool {
        let Some(peer) = self.at(node) else { return false };
        peer.expect(incarnation);
        (peer.linked, peer.found, peer.lost) = (Some(incarnation), Some(incarnation), None);
        true
    }

    /// Records that the link to this incarnation of `node` is broken.
    fn link_broken(&mut self, node: NodeAddress, incarnation: Incarnation) {
        if let Some(peer) = self.nodes.get_mut(&node)
            && !peer.is_former(incarnation)
        {
            (peer.linked, peer.has_reported) = (None, false);
            // A link to a lost incarnation may still come up, and says no more than that it ran then.
            let gone = peer.gone.filter(|(gone, _)| *gone == incarnation);
            peer.lost = peer.lost.or_else(|| gone.map(|(_, why)| why));
            // Another incarnation was found while this one was linked.
            peer.found.into_iter().for_each(|found| peer.expect(found));
        }
    }

    /// Discards a found incarnation of `node` that was another process. The linked incarnation is the node.
    fn found_wrongly(&mut self, node: NodeAddress, incarnation: Incarnation) {
        if let Some(peer) = self.nodes.get_mut(&node)
            && peer.found == Some(incarnation)
        {
            peer.found = peer.linked;
        }
    }

    /// Records that this incarnation of `node` is over.
    fn lost(&mut self, node: NodeAddress, incarnation: Incarnation, why: Reason) {
        if let Some(peer) = self.nodes.get_mut(&node)
            && !peer.is_former(incarnation)
        {
            // A node is unreachable after its goodbye: the first reason stays.
            let why = peer.lost.unwrap_or(why);
            (peer.lost, peer.gone, peer.has_reported) = (Some(why), Some((incarnation, why)), false);
        }
    }

    /// Records that `node` was found. The list of another incarnation becomes stale until the found one sends
    /// its list. This does not apply while another incarnation is linked: the found one may be a duplicate
    /// that does not know it. spec: SYNC-3
    fn found(&mut self, node: NodeAddress, incarnation: Incarnation) {
        if let Some(peer) = self.nodes.get_mut(&node)
            && !peer.is_former(incarnation)
        {
            peer.found = Some(incarnation);
            peer.gone = None;
            if peer.lost.is_some() || peer.linked.is_none_or(|linked| linked == incarnation) {
                peer.expect(incarnation);
            }
            peer.lost = None;
        }
    }

    /// Stores the list of `node`, unless a newer one is known. spec: SYNC-1
    ///
    /// # Errors
    /// Returns why the list is not used.
    fn accept(&mut self, node: NodeAddress, list: List) -> Result<Accepted, &'static str> {
        let Some(peer) = self.at(node) else {
            return Err("more nodes than `ndl.nodes_max` publish a directory");
        };
        if peer.linked.is_some_and(|linked| linked != list.incarnation) {
            return Err("this directory is about another incarnation of its node than the linked one");
        }
        let known = peer.list.as_ref().filter(|_| !peer.stale).map(|held| (held.incarnation, held.version));
        match known.map(|known| (list.incarnation, list.version).cmp(&known)) {
            Some(std::cmp::Ordering::Less) => return Ok(Accepted::Old),
            Some(std::cmp::Ordering::Equal) => {
                let is_back = !std::mem::replace(&mut peer.has_reported, true);
                return Ok(if is_back { Accepted::Again } else { Accepted::Same });
            }
            Some(std::cmp::Ordering::Greater) | None => {}
        }
        self.replace(node, list);
        Ok(Accepted::New)
    }

    fn replace(&mut self, node: NodeAddress, list: List) {
        self.unlist(node);
        let List { incarnation, version, entries, groups } = list;
        for entry in &entries {
            self.names.entry(entry.name.clone()).or_default().insert(node);
        }
        let entries = entries.into_iter().map(|entry| (entry.name.clone(), entry)).collect();
        let peer = self.nodes.entry(node).or_default();
        (peer.has_reported, peer.stale) = (true, false);
        peer.list = Some(Listed { incarnation, version, entries, groups });
    }

    /// Removes the list of `node`.
    fn unlist(&mut self, node: NodeAddress) {
        let former = self.nodes.get_mut(&node).and_then(|peer| peer.list.take());
        for name in former.into_iter().flat_map(|list| list.entries.into_keys()) {
            if let Some(nodes) = self.names.get_mut(&name) {
                nodes.remove(&node);
                if nodes.is_empty() {
                    self.names.remove(&name);
                }
            }
        }
    }

    /// Returns the linked incarnation of `node`, if its state is valid. spec: SYNC-3
    pub(super) fn current(&self, node: NodeAddress) -> Option<Incarnation> {
        self.nodes.get(&node).filter(|peer| peer.is_current())?.linked
    }

    /// Returns the incarnation of `node` that messages can reach.
    pub(super) fn linked(&self, node: NodeAddress) -> Option<Incarnation> {
        self.nodes.get(&node)?.linked
    }

    /// Returns whether `node` has a record.
    pub(super) fn contains(&self, node: NodeAddress) -> bool {
        self.nodes.contains_key(&node)
    }

    /// Returns whether the table has a record of `node`, or room for one.
    pub(super) fn admit(&mut self, node: NodeAddress) -> bool {
        self.at(node).is_some()
    }

    /// Returns the record of `node`. In a full table it replaces the record of a lost node.
    fn at(&mut self, node: NodeAddress) -> Option<&mut Peer> {
        if !self.nodes.contains_key(&node) && self.nodes.len() >= self.nodes_max {
            let mut lost = self.nodes.iter().filter(|(_, peer)| peer.lost.is_some() && peer.linked.is_none());
            let forgotten = lost.next().map(|(node, _)| *node)?;
            self.unlist(forgotten);
            self.nodes.remove(&forgotten);
        }
        Some(self.nodes.entry(node).or_default())
    }

    /// Returns the applications called `name`, by node address, with their peers and entries.
    fn called<'a>(&'a self, name: &str) -> impl Iterator<Item = (Tid, &'a Peer, &'a Entry)> {
        self.names.get(name).into_iter().flatten().filter_map(move |node| {
            let peer = self.nodes.get(node)?;
            let entry = peer.entry(name)?;
            Some((Tid::new(*node, entry.app), peer, entry))
        })
    }

    /// Returns the applications called `name`, and why each is not ready, or has not reached a phase.
    pub(super) fn states<'a>(
        &'a self,
        name: &'a str,
        phase: Option<&'a str>,
    ) -> impl Iterator<Item = (Tid, Option<Reason>)> {
        self.called(name).map(move |(tid, peer, entry)| (tid, peer.why_not(entry, phase)))
    }

    /// Returns all names.
    pub(super) fn names(&self) -> impl Iterator<Item = &Name> {
        self.names.keys()
    }

    /// Returns the requirements of each application called `name`, for nodes with valid state.
    pub(super) fn requirements(&self, name: &str) -> Vec<Vec<Requirement>> {
        let current = self.called(name).filter(|(_, peer, _)| peer.is_current());
        current.map(|(_, _, entry)| entry.requires.clone()).collect()
    }

    /// Returns the applications called `name` on nodes that are not lost. The order is: ready ones, then
    /// those of linked nodes, then by address. spec: SYNC-6
    pub(super) fn resolve(&self, name: &str) -> Vec<Tid> {
        let there = self.called(name).filter(|(_, peer, _)| peer.lost.is_none() && !peer.stale);
        let order = |(tid, peer, entry): (Tid, &Peer, &Entry)| {
            (peer.why_not(entry, None).is_some(), peer.linked.is_none(), tid)
        };
        let mut found: Vec<_> = there.map(order).collect();
        found.sort();
        found.into_iter().map(|(.., tid)| tid).collect()
    }

    /// Returns every application of every node that is not lost: name, address, readiness and kinds.
    pub(super) fn directory(&self) -> impl Iterator<Item = (&Name, Tid, bool, &Vec<Kind>)> {
        let there = self.nodes.iter().filter(|(_, peer)| peer.lost.is_none() && !peer.stale);
        there.flat_map(|(node, peer)| {
            let entries = peer.list.iter().flat_map(|list| list.entries.values());
            entries.map(|entry| {
                let is_ready = peer.why_not(entry, None).is_none();
                (&entry.name, Tid::new(*node, entry.app), is_ready, &entry.kinds)
            })
        })
    }

    /// Returns the list of each node, or of one, that is not lost.
    fn valid_lists(&self, of: Option<NodeAddress>) -> impl Iterator<Item = (NodeAddress, &Listed)> {
        let range = of.map_or(NodeAddress::HERE..=NodeAddress::ALL, |node| node..=node);
        let there = self.nodes.range(range).filter(|(_, peer)| peer.lost.is_none() && !peer.stale);
        there.filter_map(|(node, peer)| Some((*node, peer.list.as_ref()?)))
    }

    /// Returns the version of the list of every node that is not lost.
    pub(super) fn list_versions(&self) -> impl Iterator<Item = (NodeAddress, ListVersion)> {
        self.valid_lists(None).map(|(node, list)| (node, (list.incarnation, list.version)))
    }

    /// Returns every application with declared types of every node, or of one, that is not lost.
    pub(super) fn declared_types(&self, of: Option<NodeAddress>) -> impl Iterator<Item = AppTypes> {
        self.valid_lists(of).flat_map(|(node, list)| {
            let entries = list.entries.values();
            let declared = entries.filter(|entry| !(entry.handles.is_empty() && entry.sends.is_empty()));
            declared.map(move |entry| AppTypes {
                tid: Tid::new(node, entry.app),
                name: entry.name.to_string(),
                types: DeclaredTypes { handles: entry.handles.clone(), sends: entry.sends.clone() },
            })
        })
    }

    /// Returns the entry of an application of a node that is not lost.
    pub(super) fn listed(&self, tid: Tid) -> Option<&Entry> {
        let (_, list) = self.valid_lists(Some(tid.node)).next()?;
        list.entries.values().find(|entry| entry.app == tid.app)
    }

    /// Returns every published name of all nodes, or of one. Nodes that are lost, or have not sent a list in
    /// their new incarnation, are included: their earlier messages still arrive, such as last wills. The
    /// access list uses only the names of the incarnation that it knows.
    pub(super) fn published_names(&self, of: Option<NodeAddress>) -> impl Iterator<Item = ReportedNames<'_>> {
        let range = of.map_or(NodeAddress::HERE..=NodeAddress::ALL, |node| node..=node);
        let lists = self.nodes.range(range).filter_map(|(node, peer)| Some((*node, peer.list.as_ref()?)));
        lists.map(|(node, list)| {
            let names = list.entries.values().map(|entry| (entry.app, &*entry.name)).collect();
            ReportedNames { node, incarnation: list.incarnation, names }
        })
    }

    /// Returns the names in the list of `node`.
    pub(super) fn names_of(&self, node: NodeAddress) -> Vec<Name> {
        let list = self.nodes.get(&node).and_then(|peer| peer.list.as_ref());
        list.into_iter().flat_map(|list| list.entries.keys().cloned()).collect()
    }

    /// Returns the groups of `node`, if the routing table has others.
    fn changed_groups(&mut self, node: NodeAddress) -> Option<Vec<AppAddress>> {
        let peer = self.nodes.get_mut(&node)?;
        let wanted = peer.wanted_groups().to_vec();
        if peer.routed == wanted {
            return None;
        }
        peer.routed.clone_from(&wanted);
        Some(wanted)
    }
}
