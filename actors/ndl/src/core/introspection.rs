//! State kept for introspection, which decides nothing in NDL: lost nodes, and received nodes of other projects.

use std::{collections::BTreeMap, net::SocketAddr, time::Duration};

use sinew_model::facts::LossReason;
use sinew_runtime::{
    tid::{Incarnation, NodeAddress},
    time::Time,
};

use super::{Member, Source};
use crate::datagram::Announcement;

/// Maximum number of remembered lost nodes. The one that was lost first is evicted.
const LOST_MAX: usize = 64;
/// Maximum number of remembered addresses of other projects. The one received from longest ago is evicted.
const NEIGHBOURS_MAX: usize = 16;

/// A node that was a member and has not returned.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LostNode {
    pub name: String,
    pub incarnation: Incarnation,
    pub address: SocketAddr,
    pub sources: Vec<Source>,
    pub lost: Time,
    pub why: LossReason,
    /// Time between its last sign of life and its loss.
    pub silent: Duration,
    /// Loss bound: time after the last sign of life within which a loss is known.
    pub bound: Duration,
}

/// Details of a loss.
#[derive(Clone, Debug)]
pub(super) struct Loss {
    pub(super) why: LossReason,
    /// Same as in [`LostNode`].
    pub(super) bound: Duration,
}

/// Number of times that this node's own timer was so late that no node was counted as silent. The node was
/// not scheduled, or its host slept. Each time delays the losses of that moment by the same time plus one
/// period.
///
/// # Examples
///
/// ```
/// use sinew::{NodeHandle, discovery::OwnStalls};
///
/// /// Whether this host was ever too busy to watch others.
/// fn was_starved(handle: &NodeHandle) -> bool {
///     let OwnStalls { count, longest, .. } = handle.own_stalls();
///     println!("{count} stalls, the longest {longest:?}");
///     count > 0
/// }
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct OwnStalls {
    /// Number of times since the node started.
    pub count: u64,
    /// Largest delay of the timer.
    pub longest: Duration,
    /// Time of the last delay.
    pub last: Option<Time>,
}

/// A node of another project.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Neighbour {
    pub project: String,
    pub node: NodeAddress,
    pub name: String,
    /// Time at which it was last received.
    pub last_seen: Time,
}

/// The state for introspection.
#[derive(Debug, Default)]
pub(super) struct Introspection {
    lost: BTreeMap<NodeAddress, LostNode>,
    neighbours: BTreeMap<SocketAddr, Neighbour>,
    stalls: OwnStalls,
}

impl Introspection {
    /// Records the loss of a member.
    pub(super) fn lost(&mut self, now: Time, member: &Member, sources: Vec<Source>, loss: Loss) {
        let Announcement { node, incarnation, ref name, .. } = member.announcement;
        make_room(&mut self.lost, LOST_MAX, &node, |lost| lost.lost);
        let (address, silent) = (member.routes.best().there, now.since(member.last_seen));
        let (name, Loss { why, bound }) = (name.clone(), loss);
        let lost = LostNode { name, incarnation, address, sources, lost: now, why, silent, bound };
        self.lost.insert(node, lost);
    }

    /// Records that a node is present.
    pub(super) fn found(&mut self, node: NodeAddress) {
        self.lost.remove(&node);
    }

    /// Records a node of another project that sent from `from`.
    pub(super) fn received(&mut self, now: Time, from: SocketAddr, announcement: &Announcement) {
        make_room(&mut self.neighbours, NEIGHBOURS_MAX, &from, |neighbour| neighbour.last_seen);
        let Announcement { project, node, name, .. } = announcement;
        let neighbour =
            Neighbour { project: project.clone(), node: *node, name: name.clone(), last_seen: now };
        self.neighbours.insert(from, neighbour);
    }

    /// Records a delay of the local timer. Late cycles of several groups at one time count as one stall.
    pub(super) fn stalled(&mut self, now: Time, late: Duration) {
        let OwnStalls { count, longest, last } = &mut self.stalls;
        *count += u64::from(*last != Some(now));
        (*longest, *last) = (late.max(*longest), Some(now));
    }

    pub(super) const fn stalls(&self) -> OwnStalls {
        self.stalls
    }

    pub(super) fn lost_nodes(&self) -> Vec<(NodeAddress, LostNode)> {
        self.lost.iter().map(|(node, lost)| (*node, lost.clone())).collect()
    }

    pub(super) fn name_of(&self, node: NodeAddress) -> Option<String> {
        self.lost.get(&node).map(|lost| lost.name.clone())
    }

    pub(super) fn neighbours(&self) -> Vec<(SocketAddr, Neighbour)> {
        self.neighbours.iter().map(|(from, neighbour)| (*from, neighbour.clone())).collect()
    }
}

/// Evicts the oldest entry, if `key` is new and the map is full.
fn make_room<K: Ord + Copy, V>(map: &mut BTreeMap<K, V>, most: usize, key: &K, age: impl Fn(&V) -> Time) {
    if map.len() >= most
        && !map.contains_key(key)
        && let Some(oldest) = map.iter().min_by_key(|(_, value)| age(value)).map(|(key, _)| *key)
    {
        map.remove(&oldest);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn oldest_makes_room_for_a_new_one_only() {
        let at = |seconds: u64| Time::ZERO + Duration::from_secs(seconds);
        let mut map: BTreeMap<u32, Time> = (0..4).map(|key| (key, at(u64::from(key)))).collect();
        make_room(&mut map, 4, &2, |time| *time);
        assert_eq!(map.len(), 4, "it has a place already");
        map.insert(0, at(100));
        make_room(&mut map, 4, &9, |time| *time);
        assert_eq!(map.keys().copied().collect::<Vec<_>>(), [0, 2, 3]);
    }
}
