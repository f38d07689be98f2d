//! What is remembered for whoever asks, and decides nothing in NDL: nodes that were lost, and those of other projects that are heard.

use std::{collections::BTreeMap, net::SocketAddr, time::Duration};

use sinew_runtime::{
    tid::{Incarnation, NodeAddress},
    time::Time,
};

use super::{Member, Source};
use crate::ndl::{LossReason, datagram::Announcement};

/// Lost nodes that are remembered; the one that was lost first makes room.
const LOST_MAX: usize = 64;
/// Addresses of other projects that are remembered; the one that was heard longest ago makes room.
const NEIGHBOURS_MAX: usize = 16;

/// A node that was there, and has not come back.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct LostNode {
    pub(crate) name: String,
    pub(crate) incarnation: Incarnation,
    pub(crate) address: SocketAddr,
    pub(crate) sources: Vec<Source>,
    pub(crate) lost: Time,
    pub(crate) why: LossReason,
    /// Time between its last sign of life and its loss.
    pub(crate) silent: Duration,
    /// Within how much of that a loss is known.
    pub(crate) bound: Duration,
}

/// What is told of a loss.
#[derive(Clone, Debug)]
pub(super) struct Loss {
    pub(super) why: LossReason,
    /// As in [`LostNode`].
    pub(super) bound: Duration,
}

/// How often this node's own timer came so late that nobody was counted as silent: it got no processor, or its host slept. Each of these puts
/// the losses of that moment off by as much and one period.
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
    /// How often since the node started.
    pub count: u64,
    /// How late the timer was at worst.
    pub longest: Duration,
    /// When it was late last.
    pub last: Option<Time>,
}

/// A node of another project.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Neighbour {
    pub(crate) project: String,
    pub(crate) node: NodeAddress,
    pub(crate) name: String,
    /// Heard last.
    pub(crate) heard: Time,
}

/// All that is remembered so.
#[derive(Debug, Default)]
pub(super) struct Recall {
    lost: BTreeMap<NodeAddress, LostNode>,
    neighbours: BTreeMap<SocketAddr, Neighbour>,
    stalls: OwnStalls,
}

impl Recall {
    /// A member is gone.
    pub(super) fn lost(&mut self, now: Time, member: &Member, sources: Vec<Source>, loss: Loss) {
        let Announcement { node, incarnation, ref name, .. } = member.announcement;
        make_room(&mut self.lost, LOST_MAX, &node, |lost| lost.lost);
        let (address, silent) = (member.routes.best().there, now.since(member.heard));
        let (name, Loss { why, bound }) = (name.clone(), loss);
        let lost = LostNode { name, incarnation, address, sources, lost: now, why, silent, bound };
        self.lost.insert(node, lost);
    }

    /// A node is there.
    pub(super) fn found(&mut self, node: NodeAddress) {
        self.lost.remove(&node);
    }

    /// Somebody of another project spoke at `from`.
    pub(super) fn heard(&mut self, now: Time, from: SocketAddr, announcement: &Announcement) {
        make_room(&mut self.neighbours, NEIGHBOURS_MAX, &from, |neighbour| neighbour.heard);
        let Announcement { project, node, name, .. } = announcement;
        let neighbour = Neighbour { project: project.clone(), node: *node, name: name.clone(), heard: now };
        self.neighbours.insert(from, neighbour);
    }

    /// Our own timer was so late. What made the cycles of several groups late at once was one stall.
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

/// The oldest one goes, if `key` is new and all places are taken.
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
    fn the_oldest_makes_room_for_a_new_one_and_for_none_that_is_there() {
        let at = |seconds: u64| Time::ZERO + Duration::from_secs(seconds);
        let mut map: BTreeMap<u32, Time> = (0..4).map(|key| (key, at(u64::from(key)))).collect();
        make_room(&mut map, 4, &2, |time| *time);
        assert_eq!(map.len(), 4, "it has a place already");
        map.insert(0, at(100));
        make_room(&mut map, 4, &9, |time| *time);
        assert_eq!(map.keys().copied().collect::<Vec<_>>(), [0, 2, 3]);
    }
}
