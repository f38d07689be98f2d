//! What other nodes said about themselves, and whether it still counts.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::Duration,
};

use sinew_runtime::{
    app::{Requirement, matches},
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    time::Time,
    wire::Kind,
};

use super::{barrier::RETRY, reason::Reason};
use crate::{
    access::Said,
    sync::list::{Entry, List, Name},
};

/// Time between two lists to a peer when nothing changed: the net beneath a list that was lost.
pub(super) const REPEAT: Duration = Duration::from_secs(2);
/// Least time between two lists to a peer, the first of them a long one: a burst of changes costs 200 of these a second, not one each.
const SPACING_LONG: Duration = Duration::from_millis(5);
/// The same behind a short one: who waits for the change is not to wait longer for the list than for the network and its processors.
pub(super) const SPACING: Duration = Duration::from_millis(1);
/// Bytes of a list that is short: 1,000 of them a second are no more to write, carry and read than 200 of 20 KiB.
const SHORT: usize = 4 * 1024;

/// Least time from a list of so many bytes to the next one. // spec: SYNC-2
pub(super) const fn spacing(bytes: usize) -> Duration {
    if bytes <= SHORT { SPACING } else { SPACING_LONG }
}

/// The other nodes.
#[derive(Debug)]
pub(super) struct Peers {
    nodes: BTreeMap<NodeAddress, Peer>,
    /// Which nodes' lists contain a name, so that nobody searches them all.
    names: BTreeMap<Name, BTreeSet<NodeAddress>>,
    nodes_max: usize,
}

#[derive(Debug, Default)]
struct Peer {
    /// Which life of it messages can reach now.
    linked: Option<Incarnation>,
    /// Which life of it was found last, or linked after that.
    found: Option<Incarnation>,
    /// Why it is not there, if it is not.
    lost: Option<Reason>,
    /// Whether it sent a list since the link came up or it was lost.
    heard: bool,
    /// Whether the list is about a life that has ended.
    stale: bool,
    list: Option<Held>,
    /// The groups that the routing table has for it.
    routed: Vec<AppAddress>,
    /// When our list went to it last.
    sent: Option<Time>,
    /// When it goes to it next.
    due: Time,
}

#[derive(Debug)]
struct Held {
    incarnation: Incarnation,
    version: u64,
    entries: BTreeMap<Name, Entry>,
    groups: Vec<AppAddress>,
}

impl Peer {
    /// Whether what it says counts. spec: SYNC-3
    const fn is_current(&self) -> bool {
        self.linked.is_some() && self.heard && self.lost.is_none()
    }

    fn entry(&self, name: &str) -> Option<&Entry> {
        self.list.as_ref()?.entries.get(name)
    }

    /// Why an application of it that stands in its list is not ready, or has not reached a phase; `None`: it is, it has.
    fn why_not(&self, entry: &Entry, phase: Option<&str>) -> Option<Reason> {
        if self.lost.is_some() {
            self.lost
        } else if self.stale {
            Some(Reason::NodeRestarted)
        } else if self.linked.is_none() {
            Some(Reason::LinkDown)
        } else if !self.heard {
            Some(Reason::ListAwaited)
        } else if let Some(phase) = phase {
            let has_reached = entry.phases.iter().any(|reached| &**reached == phase);
            (!has_reached).then(|| entry.ended.map_or(Reason::NotReached, Reason::from))
        } else if entry.ready {
            None
        } else {
            Some(entry.ended.map_or(Reason::NotReady, Reason::from))
        }
    }

    fn wanted_groups(&self) -> &[AppAddress] {
        match &self.list {
            Some(list) if self.lost.is_none() && !self.stale => &list.groups,
            _ => &[],
        }
    }

    /// It is in this life: a list about another one says nothing about it, and one about this life does.
    fn expect(&mut self, incarnation: Incarnation) {
        if let Some(list) = &self.list {
            self.stale = list.incarnation != incarnation;
            self.heard &= !self.stale;
        }
    }

    /// Which life of it is known, by its link or else by its list, unless another life was linked after that: it may be an earlier one, of a
    /// host whose clock began anew.
    fn life(&self) -> Option<Incarnation> {
        let listed = self.list.as_ref().filter(|_| !self.stale).map(|list| list.incarnation);
        self.linked.or(listed)
    }

    /// Whether news about `incarnation` are about a life before the known one.
    fn is_former(&self, incarnation: Incarnation) -> bool {
        self.life().is_some_and(|life| incarnation < life)
    }
}

/// What became of a list.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Accepted {
    /// It says something new.
    New,
    /// It is the one that is known, and counts again: its node was not heard for a while.
    Again,
    /// It is the one that is known.
    Same,
    /// A newer one is known.
    Old,
}

impl Peers {
    /// Nobody yet, and never more than `nodes_max`.
    pub(super) const fn new(nodes_max: usize) -> Self {
        Self { nodes: BTreeMap::new(), names: BTreeMap::new(), nodes_max }
    }

    /// Messages can flow to this life of `node`; our list goes there first. Returns whether there was room for it.
    pub(super) fn link_up(&mut self, now: Time, node: NodeAddress, incarnation: Incarnation) -> bool {
        let Some(peer) = self.at(node) else { return false };
        peer.expect(incarnation);
        (peer.linked, peer.found) = (Some(incarnation), Some(incarnation));
        (peer.lost, peer.due) = (None, now);
        true
    }

    /// Messages cannot flow to this life of `node` any more.
    pub(super) fn link_broken(&mut self, node: NodeAddress, incarnation: Incarnation) {
        if let Some(peer) = self.nodes.get_mut(&node)
            && !peer.is_former(incarnation)
        {
            (peer.linked, peer.heard) = (None, false);
            // Another one was found while this one was linked.
            peer.found.into_iter().for_each(|found| peer.expect(found));
        }
    }

    /// Who was found as this life of `node` was another process, and the one that is linked is the node.
    pub(super) fn found_wrongly(&mut self, node: NodeAddress, incarnation: Incarnation) {
        if let Some(peer) = self.nodes.get_mut(&node)
            && peer.found == Some(incarnation)
        {
            peer.found = peer.linked;
        }
    }

    /// This life of `node` is over.
    pub(super) fn lost(&mut self, node: NodeAddress, incarnation: Incarnation, why: Reason) {
        if let Some(peer) = self.nodes.get_mut(&node)
            && !peer.is_former(incarnation)
        {
            // Who said goodbye is silent afterwards: the first reason stays.
            (peer.lost, peer.heard) = (peer.lost.or(Some(why)), false);
        }
    }

    /// `node` is there. What was known of another life of it is over, and stays so before that one is heard; but not while messages reach that
    /// one: who is linked is there, and who is found may be a double that does not know it. spec: SYNC-3
    pub(super) fn found(&mut self, node: NodeAddress, incarnation: Incarnation) {
        if let Some(peer) = self.nodes.get_mut(&node)
            && !peer.is_former(incarnation)
        {
            peer.found = Some(incarnation);
            if peer.lost.is_some() || peer.linked.is_none_or(|linked| linked == incarnation) {
                peer.expect(incarnation);
            }
            peer.lost = None;
        }
    }

    /// Takes over what `node` says about itself, unless something newer is known. spec: SYNC-1
    ///
    /// # Errors
    /// Why its list is not used.
    pub(super) fn accept(&mut self, node: NodeAddress, list: List) -> Result<Accepted, &'static str> {
        let Some(peer) = self.at(node) else {
            return Err("more nodes than `ndl.nodes_max` publish a directory");
        };
        if peer.linked.is_some_and(|life| life != list.incarnation) {
            return Err("this directory is about another life of its node than the one that is linked");
        }
        let known = peer.list.as_ref().filter(|_| !peer.stale).map(|held| (held.incarnation, held.version));
        match known.map(|known| (list.incarnation, list.version).cmp(&known)) {
            Some(std::cmp::Ordering::Less) => return Ok(Accepted::Old),
            Some(std::cmp::Ordering::Equal) => {
                let is_back = !std::mem::replace(&mut peer.heard, true);
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
        (peer.heard, peer.stale) = (true, false);
        peer.list = Some(Held { incarnation, version, entries, groups });
    }

    /// Forgets the list of `node`.
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

    /// The linked life of `node`, if what it says counts. spec: SYNC-3
    pub(super) fn current(&self, node: NodeAddress) -> Option<Incarnation> {
        self.nodes.get(&node).filter(|peer| peer.is_current())?.linked
    }

    /// The life of `node` that messages can reach.
    pub(super) fn linked(&self, node: NodeAddress) -> Option<Incarnation> {
        self.nodes.get(&node)?.linked
    }

    /// Whether anything is known of `node`.
    pub(super) fn knows(&self, node: NodeAddress) -> bool {
        self.nodes.contains_key(&node)
    }

    /// Whether there is room to know something of `node`.
    pub(super) fn admit(&mut self, node: NodeAddress) -> bool {
        self.at(node).is_some()
    }

    /// The record of `node`; where the table is full, in place of a node that was lost.
    fn at(&mut self, node: NodeAddress) -> Option<&mut Peer> {
        if !self.nodes.contains_key(&node) && self.nodes.len() >= self.nodes_max {
            let mut lost = self.nodes.iter().filter(|(_, peer)| peer.lost.is_some() && peer.linked.is_none());
            let forgotten = lost.next().map(|(node, _)| *node)?;
            self.unlist(forgotten);
            self.nodes.remove(&forgotten);
        }
        Some(self.nodes.entry(node).or_default())
    }

    /// The applications called `name`, by node address, and why they are not ready.
    fn called<'a>(&'a self, name: &str) -> impl Iterator<Item = (Tid, &'a Peer, &'a Entry)> {
        self.names.get(name).into_iter().flatten().filter_map(move |node| {
            let peer = self.nodes.get(node)?;
            let entry = peer.entry(name)?;
            Some((Tid::new(*node, entry.app), peer, entry))
        })
    }

    /// The applications called `name`, and why each is not ready, or has not reached a phase.
    pub(super) fn standing<'a>(
        &'a self,
        name: &'a str,
        phase: Option<&'a str>,
    ) -> impl Iterator<Item = (Tid, Option<Reason>)> {
        self.called(name).map(move |(tid, peer, entry)| (tid, peer.why_not(entry, phase)))
    }

    /// All names.
    pub(super) fn names(&self) -> impl Iterator<Item = &Name> {
        self.names.keys()
    }

    /// The names that match `pattern`.
    pub(super) fn names_like(&self, pattern: &str) -> impl Iterator<Item = &Name> {
        self.names.keys().filter(move |name| matches(pattern, name))
    }

    /// The requirements of each application called `name` on a linked node.
    pub(super) fn requirements(&self, name: &str) -> Vec<Vec<Requirement>> {
        let current = self.called(name).filter(|(_, peer, _)| peer.is_current());
        current.map(|(_, _, entry)| entry.requires.clone()).collect()
    }

    /// The applications called `name` on nodes that are not lost: those that are ready first, then those of linked nodes, then by address. spec: SYNC-6
    pub(super) fn resolve(&self, name: &str) -> Vec<Tid> {
        let there = self.called(name).filter(|(_, peer, _)| peer.lost.is_none() && !peer.stale);
        let order = |(tid, peer, entry): (Tid, &Peer, &Entry)| {
            (peer.why_not(entry, None).is_some(), peer.linked.is_none(), tid)
        };
        let mut found: Vec<_> = there.map(order).collect();
        found.sort();
        found.into_iter().map(|(.., tid)| tid).collect()
    }

    /// Every application of every node that is not lost: name, address, whether it is ready, what it handles.
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

    /// Every name that a node, or this one, has given itself, also of those that are lost or have not said yet who is in their new life: what they sent
    /// before still comes, their last wills among it. The access list takes what is of the life that it has met.
    pub(super) fn said_names(&self, of: Option<NodeAddress>) -> impl Iterator<Item = Said<'_>> {
        let range = of.map_or(NodeAddress::HERE..=NodeAddress::ALL, |node| node..=node);
        let lists = self.nodes.range(range).filter_map(|(node, peer)| Some((*node, peer.list.as_ref()?)));
        lists.map(|(node, list)| {
            let names = list.entries.values().map(|entry| (entry.app, &*entry.name)).collect();
            Said { node, life: list.incarnation, names }
        })
    }

    /// The names in the list of `node`.
    pub(super) fn names_of(&self, node: NodeAddress) -> Vec<Name> {
        let list = self.nodes.get(&node).and_then(|peer| peer.list.as_ref());
        list.into_iter().flat_map(|list| list.entries.keys().cloned()).collect()
    }

    /// The groups of `node`, if the routing table does not have them so yet.
    pub(super) fn changed_groups(&mut self, node: NodeAddress) -> Option<Vec<AppAddress>> {
        let peer = self.nodes.get_mut(&node)?;
        let wanted = peer.wanted_groups().to_vec();
        if peer.routed == wanted {
            return None;
        }
        peer.routed.clone_from(&wanted);
        Some(wanted)
    }

    /// Our list changed: it goes to every linked peer, at once or when the least time since the last one has passed. spec: SYNC-2
    pub(super) fn make_due(&mut self, now: Time, spacing: Duration) {
        for peer in self.nodes.values_mut() {
            let earliest = peer.sent.map_or(now, |sent| now.max(sent + spacing));
            peer.due = peer.due.min(earliest);
        }
    }

    /// Our list did not get into the queue to `node`: it is said again soon, as nothing of this node is ready for that one before. // spec: SYNC-2
    pub(super) fn not_taken(&mut self, now: Time, node: NodeAddress) {
        if let Some(peer) = self.nodes.get_mut(&node) {
            peer.due = now + RETRY;
        }
    }

    /// The linked peers to which our list goes now.
    pub(super) fn take_due(&mut self, now: Time) -> Vec<NodeAddress> {
        let due = self.nodes.iter_mut().filter(|(_, peer)| peer.linked.is_some() && peer.due <= now);
        due.map(|(node, peer)| {
            (peer.sent, peer.due) = (Some(now), now + REPEAT);
            *node
        })
        .collect()
    }

    /// When our list goes to a peer next.
    pub(super) fn next_due(&self) -> Option<Time> {
        self.nodes.values().filter(|peer| peer.linked.is_some()).map(|peer| peer.due).min()
    }
}
