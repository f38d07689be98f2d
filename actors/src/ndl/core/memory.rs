//! Where members answered, kept so that they are asked there again after a restart: of the process, where the shell keeps it in a file,
//! and of this layer in any case.
//!
//! A remembered address is a hint, as a seed is: only an answer makes a member. It is asked as that of a lost node is, ever more seldom.

use std::{net::SocketAddr, time::Duration};

use sinew_runtime::{tid::NodeAddress, time::Time};

use super::{
    Core, Place, Source,
    contact::{Contact, Role},
};
use crate::ndl::{address::unscoped, datagram::Announcement};

/// Addresses that are remembered; the one at which a node was met longest ago makes room.
pub(crate) const REMEMBERED_MAX: usize = 64;
/// Those of one node: in two networks it is found when one of them is gone.
const OF_ONE_MAX: usize = 2;
/// Starts in a row in which nobody answered there, after which an address is forgotten.
pub(crate) const UNANSWERED_MAX: u32 = 8;
/// A start counts when it has lasted for this long, so that a process that fails again and again forgets nobody. No clock is asked for the
/// date: a robot may boot in 1970.
const COUNTS_AFTER: Duration = Duration::from_secs(60);

/// Where a member answered.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct RememberedPeer {
    /// Of its NDL; a link-local one without an interface, whose number may be another one tomorrow.
    pub(crate) address: SocketAddr,
    pub(crate) node: NodeAddress,
    /// Starts in a row that counted and in which nobody answered there.
    pub(crate) unanswered: u32,
}

#[derive(Debug)]
struct Entry {
    peer: RememberedPeer,
    /// Nobody has become a member there since it was read, or since this layer was started anew.
    is_sought: bool,
}

/// All that is remembered so.
#[derive(Debug, Default)]
pub(super) struct Memory {
    /// The one that was met longest ago first.
    entries: Vec<Entry>,
    /// When what earlier lives remembered was taken in.
    recalled: Option<Time>,
    has_counted: bool,
    /// Changes so far of what is to be kept.
    changes: u64,
}

impl Memory {
    /// A member answers there, and on all these `routes`.
    fn met(&mut self, node: NodeAddress, address: SocketAddr, routes: &[SocketAddr]) {
        let known = self.entries.iter().position(|entry| entry.peer.address == address);
        let known = known.map(|at| self.entries.remove(at).peer);
        let is_its = known.is_some_and(|peer| peer.node == node);
        self.changes += u64::from(known.is_none_or(|peer| !is_its || peer.unanswered > 0));
        if !is_its && self.entries.iter().filter(|entry| entry.peer.node == node).count() >= OF_ONE_MAX {
            // Where it does not answer now makes room, not where it does.
            let is_left = |entry: &Entry| entry.peer.node == node && !routes.contains(&entry.peer.address);
            let Some(left) = self.entries.iter().position(is_left) else {
                self.changes -= u64::from(known.is_none());
                return;
            };
            self.entries.remove(left);
        }
        if self.entries.len() >= REMEMBERED_MAX {
            self.entries.remove(0);
        }
        self.entries.push(Entry { peer: RememberedPeer { address, node, unanswered: 0 }, is_sought: false });
    }

    /// Earlier lives remembered these, the one that was met longest ago first. Who was met in this life goes before them.
    fn recall(&mut self, now: Time, peers: Vec<RememberedPeer>) {
        self.recalled.get_or_insert(now);
        for peer in peers.into_iter().rev() {
            let is_known = self.entries.iter().any(|entry| entry.peer.address == peer.address);
            let of_one = self.entries.iter().filter(|entry| entry.peer.node == peer.node).count();
            if !is_known && of_one < OF_ONE_MAX && self.entries.len() < REMEMBERED_MAX {
                self.entries.insert(0, Entry { peer, is_sought: true });
            }
        }
    }

    /// This layer is started anew: all are asked again.
    pub(super) fn seek_all(&mut self) {
        self.entries.iter_mut().for_each(|entry| entry.is_sought = true);
    }

    fn has(&self, node: NodeAddress) -> bool {
        self.entries.iter().any(|entry| entry.peer.node == node)
    }
}

impl Core {
    /// What is remembered, the one that was met longest ago first.
    pub(crate) fn remembered(&self) -> Vec<RememberedPeer> {
        self.memory.entries.iter().map(|entry| entry.peer).collect()
    }

    /// How often that has changed.
    pub(crate) const fn memory_changes(&self) -> u64 {
        self.memory.changes
    }

    /// Whether what earlier lives remembered has been taken in.
    pub(crate) const fn has_recalled(&self) -> bool {
        self.memory.recalled.is_some()
    }

    /// Earlier lives of this node remembered these. // spec: NDL-2.5
    pub(super) fn recalled(&mut self, now: Time, peers: Vec<RememberedPeer>) {
        self.memory.recall(now, peers);
        for place in self.meet_remembered(now) {
            self.ask_unless_just_asked(now, place);
        }
    }

    /// Makes contacts of those that are sought, from every address of ours; returns where they are.
    pub(super) fn meet_remembered(&mut self, now: Time) -> Vec<Place> {
        let sought = self.memory.entries.iter().filter(|entry| entry.is_sought).map(|entry| entry.peer);
        let mut met = Vec::new();
        for RememberedPeer { address, node, .. } in sought.collect::<Vec<_>>() {
            let places = self.paths.iter().map(|here| Place::between(*here, address));
            // An address that was another node's may be our own by now.
            let places = places.filter(|place| place.is_a_way() && !self.paths.contains(&place.there));
            for place in places.collect::<Vec<_>>() {
                let contact = self.contacts.entry(place).or_insert_with(|| Contact::remembered(now, node));
                match &mut contact.role {
                    Role::Member(_) => continue,
                    Role::Candidate { .. } => {}
                    Role::Former { wait, left, .. } => (*wait, *left) = (1, 0),
                }
                contact.sources.entry(Source::Remembered).or_insert(now);
                met.push(place);
            }
        }
        met
    }

    /// A member answers there. Where nodes have keys it is remembered when it has proven itself, too. // spec: NDL-2.5
    pub(super) fn note_met(&mut self, node: NodeAddress, place: Place) {
        let Some(member) = self.members.get(&node) else { return };
        if self.proves_peers() && !self.is_proven(node) {
            return;
        }
        let routes: Vec<_> = member.routes.places().map(|route| unscoped(route.there)).collect();
        self.memory.met(node, unscoped(place.there), &routes);
    }

    /// The same of each place where it answers.
    pub(super) fn note_all_met(&mut self, node: NodeAddress) {
        let places = self.members.get(&node).map(|member| member.routes.places().collect::<Vec<_>>());
        places.into_iter().flatten().for_each(|place| self.note_met(node, place));
    }

    /// A node is found at `from`. Of the other places where it was remembered it is asked at those that it announces, as at any that it
    /// announces; at the others it is not any more. Returns the former.
    pub(super) fn settle_remembered(&mut self, from: Place, found: &Announcement) -> Vec<Place> {
        if !self.memory.has(found.node) {
            return Vec::new();
        }
        let is_its = |(place, contact): &(&Place, &Contact)| {
            **place != from && contact.is_remembered_alone() && contact.is_former_of(found.node)
        };
        let places: Vec<_> = self.contacts.iter().filter(is_its).map(|(place, _)| *place).collect();
        let (announced, others): (Vec<_>, Vec<_>) =
            places.into_iter().partition(|place| found.has_ndl_at(place.there));
        for place in others {
            self.contacts.remove(&place);
        }
        for place in &announced {
            if let Some(contact) = self.contacts.get_mut(place) {
                contact.role = Role::Candidate { asked: 0 };
            }
        }
        announced
    }

    /// A start counts once, when it has lasted for a while and somebody is there: where nobody answers at all this node is cut off, and knows
    /// nothing of others. // spec: NDL-2.5
    pub(super) fn count_start(&mut self, now: Time) {
        let has_lasted = |recalled: Time| now.since(recalled) >= COUNTS_AFTER;
        if self.memory.has_counted || self.members.is_empty() || !self.memory.recalled.is_some_and(has_lasted)
        {
            return;
        }
        self.memory.has_counted = true;
        let answers = |peer: &RememberedPeer| {
            let member = self.members.get(&peer.node);
            member.is_some_and(|member| {
                member.routes.places().any(|place| unscoped(place.there) == peer.address)
            })
        };
        let mut forgotten = Vec::new();
        for entry in &mut self.memory.entries {
            if entry.is_sought && !answers(&entry.peer) {
                entry.peer.unanswered += 1;
                self.memory.changes += 1;
                if entry.peer.unanswered >= UNANSWERED_MAX {
                    forgotten.push(entry.peer.address);
                }
            }
        }
        self.memory.entries.retain(|entry| !forgotten.contains(&entry.peer.address));
        self.contacts.retain(|place, contact| {
            !contact.is_remembered_alone() || !forgotten.contains(&unscoped(place.there))
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(last: u8) -> SocketAddr {
        ([10, 0, 0, last], 6911).into()
    }

    fn node(last: u8) -> NodeAddress {
        NodeAddress::from([10, 0, 0, last])
    }

    fn peer(last: u8, unanswered: u32) -> RememberedPeer {
        RememberedPeer { address: at(last), node: node(last), unanswered }
    }

    fn kept(memory: &Memory) -> Vec<SocketAddr> {
        memory.entries.iter().map(|entry| entry.peer.address).collect()
    }

    #[test]
    fn the_one_that_was_met_longest_ago_makes_room() {
        let mut memory = Memory::default();
        (1..=64).for_each(|last| memory.met(node(last), at(last), &[at(last)]));
        memory.met(node(1), at(1), &[at(1)]);
        memory.met(node(65), at(65), &[at(65)]);
        let kept = kept(&memory);
        assert_eq!(kept.len(), REMEMBERED_MAX);
        assert!(kept.contains(&at(1)) && !kept.contains(&at(2)) && kept.contains(&at(65)));
    }

    #[test]
    fn one_node_with_many_addresses_leaves_room_for_others_and_keeps_those_where_it_answers() {
        let mut memory = Memory::default();
        let routes: Vec<_> = (1..=8).map(at).collect();
        (1..=8).for_each(|last| memory.met(node(1), at(last), &routes));
        assert_eq!(kept(&memory), [at(1), at(2)]);
        let before = memory.changes;
        memory.met(node(1), at(3), &routes);
        assert_eq!(memory.changes, before, "nothing was kept, so nothing has changed");
        // It is elsewhere now.
        memory.met(node(1), at(9), &[at(9), at(2)]);
        assert_eq!(kept(&memory), [at(2), at(9)]);
    }

    #[test]
    fn what_this_life_has_met_goes_before_what_earlier_ones_did() {
        let mut memory = Memory::default();
        memory.met(node(1), at(1), &[at(1)]);
        memory.recall(Time::ZERO, (1..=80).map(|last| peer(last, 3)).collect());
        let kept = kept(&memory);
        assert_eq!((kept.len(), kept.last()), (REMEMBERED_MAX, Some(&at(1))));
        assert_eq!(kept[0], at(18), "the newest of the earlier ones are kept");
        assert_eq!(memory.entries.last().map(|entry| entry.peer), Some(peer(1, 0)));
    }

    #[test]
    fn only_what_is_to_be_kept_counts_as_a_change() {
        let mut memory = Memory::default();
        memory.recall(Time::ZERO, vec![peer(1, 0), peer(2, 3)]);
        assert_eq!(memory.changes, 0);
        memory.met(node(1), at(1), &[at(1)]);
        assert_eq!(memory.changes, 0, "it was there already");
        memory.met(node(2), at(2), &[at(2)]);
        assert_eq!(memory.changes, 1, "it answers again");
        memory.met(node(3), at(2), &[at(2)]);
        assert_eq!(memory.changes, 2, "another node has its address");
    }
}
