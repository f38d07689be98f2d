//! The monitors of this node's applications, and the nodes of their targets.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::Duration,
};

use sinew_model::cause::Cause;
use sinew_runtime::{
    monitor::MonitorId,
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    time::Time,
};

use super::{LifeState, ORPHAN, REPEAT, SPACING, no_such_address};

/// The monitoring side: monitors of local applications.
#[derive(Debug)]
pub(super) struct Watching {
    monitors: BTreeMap<MonitorId, Monitor>,
    by_target: BTreeMap<Tid, BTreeSet<MonitorId>>,
    peers: BTreeMap<NodeAddress, Peer>,
    nodes_max: usize,
    next: u64,
}

#[derive(Debug)]
struct Monitor {
    watcher: AppAddress,
    target: Tid,
    since: Time,
    /// The monitored life, once it is known.
    life: Option<u64>,
    /// The highest version of a target state that was evaluated.
    last_version: u64,
}

/// Another node.
#[derive(Debug, Default)]
pub(super) struct Peer {
    /// The known incarnation.
    incarnation: Incarnation,
    is_found: bool,
    is_linked: bool,
    /// The known incarnation was lost, but its link has not broken yet.
    is_lost: bool,
    /// The time at which the node counts as lost if its link does not come up again.
    orphan: Option<Time>,
    version: u64,
    sent: Option<Time>,
    /// The time at which the WATCH list is sent next.
    due: Option<Time>,
}

impl Watching {
    pub(super) const fn new(nodes_max: usize) -> Self {
        Self {
            monitors: BTreeMap::new(),
            by_target: BTreeMap::new(),
            peers: BTreeMap::new(),
            nodes_max,
            next: 0,
        }
    }

    pub(super) fn add(&mut self, watcher: AppAddress, target: Tid, now: Time) -> MonitorId {
        self.next += 1;
        let id = MonitorId(self.next);
        self.monitors.insert(id, Monitor { watcher, target, since: now, life: None, last_version: 0 });
        self.by_target.entry(target).or_default().insert(id);
        id
    }

    pub(super) fn establish(&mut self, id: MonitorId, life: u64) {
        if let Some(monitor) = self.monitors.get_mut(&id) {
            monitor.life = Some(life);
        }
    }

    /// Removes a monitor. Returns its watcher and its target.
    pub(super) fn remove(&mut self, id: MonitorId) -> Option<(AppAddress, Tid)> {
        let Monitor { watcher, target, .. } = self.monitors.remove(&id)?;
        if let Some(ids) = self.by_target.get_mut(&target) {
            ids.remove(&id);
            if ids.is_empty() {
                self.by_target.remove(&target);
            }
        }
        Some((watcher, target))
    }

    pub(super) fn remove_of(&mut self, watcher: AppAddress, id: MonitorId) -> Option<Tid> {
        let is_its = self.monitors.get(&id).is_some_and(|monitor| monitor.watcher == watcher);
        if is_its { self.remove(id).map(|(_, target)| target) } else { None }
    }

    /// Removes all monitors of `watcher`. Returns their targets.
    pub(super) fn remove_watcher(&mut self, watcher: AppAddress) -> Vec<Tid> {
        let its = self.monitors.iter().filter(|(_, monitor)| monitor.watcher == watcher);
        let ids: Vec<_> = its.map(|(id, _)| *id).collect();
        ids.into_iter().filter_map(|id| self.remove(id)).map(|(_, target)| target).collect()
    }

    pub(super) fn len(&self) -> usize {
        self.monitors.len()
    }

    pub(super) fn count_of(&self, watcher: AppAddress) -> usize {
        self.monitors.values().filter(|monitor| monitor.watcher == watcher).count()
    }

    pub(super) fn is_watched(&self, target: Tid) -> bool {
        self.by_target.contains_key(&target)
    }

    /// Returns the monitors on `target`.
    pub(super) fn of(&self, target: Tid) -> Vec<MonitorId> {
        self.by_target.get(&target).into_iter().flatten().copied().collect()
    }

    fn targets(&self, node: NodeAddress) -> impl Iterator<Item = (&Tid, &BTreeSet<MonitorId>)> {
        let first = Tid::new(node, AppAddress::NONE);
        let last = Tid::new(node, AppAddress::ALL);
        self.by_target.range(first..=last)
    }

    pub(super) fn targets_on(&self, node: NodeAddress) -> usize {
        self.targets(node).count()
    }

    /// Returns the monitors on applications of `node`.
    pub(super) fn on(&self, node: NodeAddress) -> Vec<MonitorId> {
        self.targets(node).flat_map(|(_, ids)| ids).copied().collect()
    }

    /// Evaluates a state of a monitor's target. Returns the cause if the monitor ends.
    pub(super) fn evaluate(
        &mut self,
        id: MonitorId,
        version: u64,
        state: &LifeState,
        now: Time,
    ) -> Option<Cause> {
        let monitor = self.monitors.get_mut(&id)?;
        if version <= monitor.last_version {
            return None;
        }
        monitor.last_version = version;
        let ended = || state.ended.as_ref().map_or_else(no_such_address, |ended| ended.cause.clone());
        match monitor.life {
            Some(life) if state.life == life => None,
            Some(_) => Some(ended()),
            None => {
                // spec: MON-4: the newer life may have started after the monitor was set.
                let is_younger = Duration::from_micros(state.age_us) < now.since(monitor.since);
                match (state.life, is_younger && state.ended.is_some()) {
                    (_, true) => Some(ended()),
                    (0, false) => Some(no_such_address()),
                    (life, false) => {
                        monitor.life = Some(life);
                        None
                    }
                }
            }
        }
    }
}

/// The other nodes.
impl Watching {
    fn at(&mut self, node: NodeAddress) -> Option<&mut Peer> {
        if !self.peers.contains_key(&node) && self.peers.len() >= self.nodes_max {
            return None;
        }
        Some(self.peers.entry(node).or_default())
    }

    /// Returns whether a monitor on `node` can be about this incarnation, and not about a later one.
    pub(super) fn is_about(&self, node: NodeAddress, incarnation: Incarnation) -> bool {
        self.peers.get(&node).is_some_and(|peer| peer.incarnation <= incarnation)
    }

    /// Returns the known incarnation of `node` if it is earlier than `incarnation`.
    pub(super) fn earlier_incarnation(
        &self,
        node: NodeAddress,
        incarnation: Incarnation,
    ) -> Option<Incarnation> {
        self.peers.get(&node).map(|peer| peer.incarnation).filter(|known| *known < incarnation)
    }

    pub(super) fn linked(&self, node: NodeAddress) -> Option<Incarnation> {
        self.peers.get(&node).filter(|peer| peer.is_linked).map(|peer| peer.incarnation)
    }

    pub(super) fn found(&mut self, node: NodeAddress, incarnation: Incarnation) {
        if let Some(peer) = self.at(node) {
            // The node was lost and found in an earlier incarnation: the later one was another process with
            // the same node address.
            peer.incarnation = if peer.is_lost { incarnation } else { peer.incarnation.max(incarnation) };
            (peer.is_found, peer.is_lost, peer.orphan) = (true, false, None);
        }
    }

    /// Records that this incarnation of `node` is over. Its watchers have been notified.
    pub(super) fn lost(&mut self, node: NodeAddress, incarnation: Incarnation) {
        if let Some(peer) = self.peers.get_mut(&node)
            && peer.incarnation <= incarnation
        {
            if peer.is_linked {
                // The link breaks later, or the node is found again before that.
                (peer.is_found, peer.is_lost) = (false, true);
            } else {
                self.peers.remove(&node);
            }
        }
    }

    pub(super) fn link_up(&mut self, now: Time, node: NodeAddress, incarnation: Incarnation) {
        let is_watched = self.targets_on(node) > 0;
        if let Some(peer) = self.at(node) {
            peer.incarnation = peer.incarnation.max(incarnation);
            (peer.is_linked, peer.orphan) = (true, None);
            if is_watched {
                peer.due = Some(now);
            }
        }
    }

    pub(super) fn link_broken(&mut self, now: Time, node: NodeAddress, incarnation: Incarnation) {
        if let Some(peer) = self.peers.get_mut(&node)
            && peer.incarnation <= incarnation
        {
            (peer.is_linked, peer.due) = (false, None);
            if !peer.is_found {
                peer.orphan = Some(now + ORPHAN);
            }
        }
    }

    /// Removes and returns the nodes that NDL did not find and that have had no link since.
    pub(super) fn orphans(&mut self, now: Time) -> Vec<NodeAddress> {
        let over = |peer: &Peer| peer.orphan.is_some_and(|at| at <= now);
        let orphans: Vec<_> =
            self.peers.iter().filter(|(_, peer)| over(peer)).map(|(node, _)| *node).collect();
        for node in &orphans {
            self.peers.remove(node);
        }
        orphans
    }

    /// Schedules a WATCH list to `node` after a change. Returns `false` if the node is not known.
    pub(super) fn make_due(&mut self, node: NodeAddress, now: Time) -> bool {
        let Some(peer) = self.peers.get_mut(&node) else { return false };
        if peer.is_linked {
            let earliest = peer.sent.map_or(now, |sent| now.max(sent + SPACING));
            peer.due = Some(peer.due.map_or(earliest, |due| due.min(earliest)));
        }
        peer.is_linked || peer.is_found
    }

    /// Returns the lists that are due now: node, version and monitored applications.
    pub(super) fn take_due(&mut self, now: Time) -> Vec<(NodeAddress, u64, Vec<AppAddress>)> {
        let due = |peer: &Peer| peer.is_linked && peer.due.is_some_and(|due| due <= now);
        let nodes: Vec<_> = self.peers.iter().filter(|(_, peer)| due(peer)).map(|(node, _)| *node).collect();
        let mut lists = Vec::new();
        for node in nodes {
            let apps: Vec<_> = self.targets(node).map(|(target, _)| target.app).collect();
            let Some(peer) = self.peers.get_mut(&node) else { continue };
            peer.version += 1;
            peer.sent = Some(now);
            peer.due = (!apps.is_empty()).then(|| now + REPEAT);
            lists.push((node, peer.version, apps));
        }
        lists
    }

    pub(super) fn next_due(&self) -> Option<Time> {
        let due = |peer: &Peer| [peer.due, peer.orphan].into_iter().flatten().min();
        self.peers.values().filter_map(due).min()
    }
}
