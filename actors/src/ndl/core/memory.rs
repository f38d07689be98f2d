//! Where members answered, kept so that they are asked there again after a restart: of the process, where the shell keeps it in a file,
//! and of this layer in any case.
//!
//! A remembered address is a hint, as a seed is: only an answer makes a member. It is asked as that of a lost node is, ever more seldom.

use std::{
    collections::{BTreeMap, BTreeSet},
    net::SocketAddr,
    time::Duration,
};

use sinew_runtime::{
    tid::{Incarnation, NodeAddress},
    time::Time,
};

use super::{
    Core, Member, Place, Source,
    contact::{Contact, Role},
};
use crate::ndl::address::unscoped;

/// Addresses that are remembered; the one at which a node was met longest ago makes room, and none where a member answers.
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
    /// Nobody has become a member there since it was read, or was one when this layer was started anew.
    is_sought: bool,
}

/// Where the node of a remembered address is now; who stands first makes room first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Standing {
    /// It is no member.
    Gone,
    /// It is a member that does not answer there now.
    Elsewhere,
    /// It is a member, and answers there.
    Here,
}

fn standing(members: &BTreeMap<NodeAddress, Member>, peer: &RememberedPeer) -> Standing {
    let Some(member) = members.get(&peer.node) else { return Standing::Gone };
    let answers = member.routes.places().any(|place| unscoped(place.there) == peer.address);
    if answers { Standing::Here } else { Standing::Elsewhere }
}

/// All that is remembered so.
#[derive(Debug, Default)]
pub(super) struct Memory {
    /// The one that was met longest ago first, as far as it is no member.
    entries: Vec<Entry>,
    /// When what earlier lives remembered was taken in.
    recalled: Option<Time>,
    has_counted: bool,
    /// Changes so far of what is to be kept.
    changes: u64,
    /// Where nobody is remembered any more who was sought, since that was taken out last.
    forgotten: Vec<SocketAddr>,
}

impl Memory {
    /// A member answers there. How each of those that are remembered stands now decides which makes room, if one must.
    fn met(
        &mut self,
        node: NodeAddress,
        address: SocketAddr,
        standing: impl Fn(&RememberedPeer) -> Standing,
    ) {
        let known = self.entries.iter().position(|entry| entry.peer.address == address);
        let is_its = known.is_some_and(|at| self.entries[at].peer.node == node);
        let known = known.map(|at| if is_its { self.entries.remove(at).peer } else { self.forget(at) });
        if !is_its && !self.makes_room(node, standing) {
            self.changes += u64::from(known.is_some());
            return;
        }
        self.changes += u64::from(known.is_none_or(|peer| !is_its || peer.unanswered > 0));
        self.entries.push(Entry { peer: RememberedPeer { address, node, unanswered: 0 }, is_sought: false });
    }

    /// Whether there is room for one more of this node. Where a node has all its places, one of its own makes it; where a member answers,
    /// none does, but for the second one of a node where this one has none.
    fn makes_room(&mut self, node: NodeAddress, standing: impl Fn(&RememberedPeer) -> Standing) -> bool {
        let is_own = |entry: &Entry| entry.peer.node == node;
        let has_all = self.entries.iter().filter(|entry| is_own(entry)).count() >= OF_ONE_MAX;
        if !has_all && self.entries.len() < REMEMBERED_MAX {
            return true;
        }
        // Of those that stand alike the first one: that which was met longest ago.
        let leaves = self.entries.iter().enumerate().filter(|(_, entry)| !has_all || is_own(entry));
        let leaves = leaves.map(|(at, entry)| (standing(&entry.peer), at)).min();
        let left = leaves.filter(|(standing, _)| *standing != Standing::Here).map(|(_, at)| at);
        let given = || if self.has(node) { None } else { self.second_of_one() };
        let Some(at) = left.or_else(given) else { return false };
        self.forget(at);
        true
    }

    /// One entry less.
    fn forget(&mut self, at: usize) -> RememberedPeer {
        let Entry { peer, is_sought } = self.entries.remove(at);
        if is_sought {
            self.forgotten.push(peer.address);
        }
        peer
    }

    /// Where the second address of any node is.
    fn second_of_one(&self) -> Option<usize> {
        let mut firsts = BTreeSet::new();
        self.entries.iter().position(|entry| !firsts.insert(entry.peer.node))
    }

    /// A node was a member until now: it was met last at this moment, not when it came.
    pub(super) fn parted(&mut self, node: NodeAddress) {
        self.entries.sort_by_key(|entry| entry.peer.node == node);
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

    /// This layer is started anew: all are asked again but those where members answer, who say goodbye when they leave.
    fn seek_all(&mut self, standing: impl Fn(&RememberedPeer) -> Standing) {
        for entry in &mut self.entries {
            entry.is_sought |= standing(&entry.peer) != Standing::Here;
        }
    }

    /// A node has said goodbye at each of its addresses: it is at none of them.
    fn left(&mut self, node: NodeAddress, is_its: impl Fn(SocketAddr) -> bool) {
        let entries = self.entries.iter_mut().filter(|entry| entry.peer.node == node);
        for entry in entries.filter(|entry| is_its(entry.peer.address)) {
            entry.is_sought = false;
        }
    }

    fn has(&self, node: NodeAddress) -> bool {
        self.entries.iter().any(|entry| entry.peer.node == node)
    }
}

impl Core {
    /// What is remembered, the one that was met longest ago first: members are met at this moment.
    pub(crate) fn remembered(&self) -> Vec<RememberedPeer> {
        let mut all: Vec<_> = self.memory.entries.iter().map(|entry| entry.peer).collect();
        all.sort_by_key(|peer| standing(&self.members, peer) != Standing::Gone);
        all
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

    /// A shell starts: where nobody is now is asked.
    pub(super) fn seek_remembered(&mut self, now: Time) {
        self.memory.seek_all(|peer| standing(&self.members, peer));
        self.meet_remembered(now);
    }

    /// Makes contacts of those that are sought, from every address of ours; returns where they are.
    pub(super) fn meet_remembered(&mut self, now: Time) -> Vec<Place> {
        let mut met = Vec::new();
        for (place, node) in self.sought_places() {
            let mut contact = self.contacts.get_or_insert_with(place, || Contact::remembered(now, node));
            match &mut contact.role {
                Role::Member(_) => continue,
                // Another source named it. When that one's time is over, it is met anew.
                Role::Candidate { .. } => {}
                Role::Former { wait, left, .. } => (*wait, *left) = (1, 0),
            }
            contact.sources.entry(Source::Remembered).or_insert(now);
            met.push(place);
        }
        met
    }

    /// The same of those that have none any more: other sources named them and nobody answered, too many others were named, or somebody
    /// answered there, or elsewhere in their node's name, and is gone. // spec: NDL-2.5
    pub(super) fn meet_remembered_again(&mut self, now: Time) {
        for (place, node) in self.sought_places() {
            self.contacts.get_or_insert_with(place, || Contact::remembered(now, node));
        }
    }

    /// Where those are asked that are sought. A member says itself where else it is, and is asked there as that, whoever is remembered there.
    fn sought_places(&self) -> Vec<(Place, NodeAddress)> {
        let sought = self.memory.entries.iter().filter(|entry| entry.is_sought).map(|entry| entry.peer);
        let sought = sought.filter(|peer| !self.is_believed(peer.node));
        let places = sought.flat_map(|RememberedPeer { address, node, .. }| {
            self.paths.iter().map(move |here| (Place::between(*here, address), node))
        });
        let is_announced = |place: Place, node: NodeAddress| {
            // One with a single address need not say it: it is asked where it was met as long as it has no route.
            let is_its = |member: &Member| {
                member.announces(place)
                    || member.routes.places().next().is_none() && member.routes.best().there == place.there
            };
            self.members.get(&node).is_some_and(is_its)
        };
        let places = places.filter(|(place, node)| place.is_a_way() && !is_announced(*place, *node));
        // An address that was another node's may be our own by now.
        places.filter(|(place, _)| !self.paths.contains(&place.there)).collect()
    }

    /// Whether a member is taken for what it says that it is: where nodes have keys, when it has proven itself, too. // spec: NDL-2.5
    fn is_believed(&self, node: NodeAddress) -> bool {
        self.members.contains_key(&node) && (!self.proves_peers() || self.is_proven(node))
    }

    /// A member answers there; it is remembered when it is believed.
    pub(super) fn note_met(&mut self, node: NodeAddress, place: Place) {
        if self.is_believed(node) {
            self.memory.met(node, unscoped(place.there), |peer| standing(&self.members, peer));
            self.drop_forgotten();
        }
    }

    /// Where nobody is remembered any more nobody is asked for that. One that was lost there is asked for that. // spec: NDL-2.5
    fn drop_forgotten(&mut self) {
        let forgotten = std::mem::take(&mut self.memory.forgotten);
        if forgotten.is_empty() {
            return;
        }
        let gone = &self.gone;
        let is_lost_there = |place: &Place, contact: &Contact| match contact.role {
            Role::Former { node, .. } => gone.get(&node).is_some_and(|gone| gone.is_asked_at(place)),
            Role::Candidate { .. } | Role::Member(_) => false,
        };
        self.contacts.retain(|place, contact| {
            let is_forgotten = contact.is_remembered_alone() && forgotten.contains(&unscoped(place.there));
            !is_forgotten || is_lost_there(place, contact)
        });
    }

    /// The same of each place where it answers.
    pub(super) fn note_all_met(&mut self, node: NodeAddress) {
        let places = self.members.get(&node).map(|member| member.routes.places().collect::<Vec<_>>());
        places.into_iter().flatten().for_each(|place| self.note_met(node, place));
    }

    /// This life of a node says goodbye, for all addresses that it announces. Where else it is remembered it may be all the same: somebody may
    /// have answered in its name. So may he have who says goodbye unproven where nodes have keys. // spec: NDL-2.5
    pub(super) fn note_goodbye(&mut self, node: NodeAddress, incarnation: Incarnation) {
        if let Some(member) = self.members.get(&node)
            && member.announcement.incarnation == incarnation
            && self.is_believed(node)
        {
            self.memory.left(node, |address| member.announcement.has_ndl_at(address));
        }
    }

    /// A node was a member until now. The room that it leaves is for those that were met while there was none.
    pub(super) fn note_parted(&mut self, node: NodeAddress) {
        self.memory.parted(node);
        if self.memory.has(node) {
            self.note_the_unnoted();
        }
    }

    /// Notes members of which no address is remembered, as long as there is room for one more. Of those that are lost together each gives
    /// its room to the next one, so no more are looked at than are noted.
    fn note_the_unnoted(&mut self) {
        for _ in 0..REMEMBERED_MAX {
            let unnoted = self.members.iter().find_map(|(node, member)| {
                let is_unnoted = !self.memory.has(*node) && self.is_believed(*node);
                member.routes.places().next().filter(|_| is_unnoted).map(|place| (*node, place))
            });
            let Some((node, place)) = unnoted else { return };
            self.note_met(node, place);
            if !self.memory.has(node) {
                return;
            }
        }
    }

    /// A node is found. Of the other places where it was remembered it is asked at those that it announces, as at any that it announces; at
    /// the others not any more, until it is lost. Returns the former.
    ///
    /// Anybody may have answered in its name. Where nodes have keys that leads away from none of the others before he has proven himself.
    /// Where they have none he is the node until he is lost, as wherever he is met; what is remembered of the others stays, and they are
    /// asked again then.
    pub(super) fn settle_remembered(&mut self, node: NodeAddress) -> Vec<Place> {
        let Some(found) = self.members.get(&node).map(|member| &member.announcement) else {
            return Vec::new();
        };
        if !self.memory.has(node) {
            return Vec::new();
        }
        let is_its =
            |(_, contact): &(&Place, &Contact)| contact.is_remembered_alone() && contact.is_former_of(node);
        let places = self.contacts.iter().filter(is_its).map(|(place, _)| *place);
        let (announced, others): (Vec<_>, Vec<_>) = places.partition(|place| found.has_ndl_at(place.there));
        if self.is_believed(node) {
            for place in others {
                self.contacts.remove(&place);
            }
        }
        for place in &announced {
            if let Some(mut contact) = self.contacts.get_mut(place) {
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
        let answers = |peer: &RememberedPeer| standing(&self.members, peer) == Standing::Here;
        for entry in &mut self.memory.entries {
            if entry.is_sought && !answers(&entry.peer) {
                entry.peer.unanswered += 1;
                self.memory.changes += 1;
            }
        }
        let before = self.memory.entries.len();
        let is_over = |entry: &Entry| entry.peer.unanswered >= UNANSWERED_MAX;
        while let Some(at) = self.memory.entries.iter().position(is_over) {
            self.memory.forget(at);
        }
        self.drop_forgotten();
        if self.memory.entries.len() < before {
            self.note_the_unnoted();
        }
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

    fn has(memory: &Memory, last: u8) -> bool {
        kept(memory).contains(&at(last))
    }

    fn here(_: &RememberedPeer) -> Standing {
        Standing::Here
    }

    fn gone(_: &RememberedPeer) -> Standing {
        Standing::Gone
    }

    #[test]
    fn the_one_that_was_met_longest_ago_makes_room() {
        let mut memory = Memory::default();
        (1..=64).for_each(|last| memory.met(node(last), at(last), here));
        memory.met(node(1), at(1), here);
        memory.met(node(65), at(65), gone);
        assert_eq!(kept(&memory).len(), REMEMBERED_MAX);
        assert!(has(&memory, 1) && !has(&memory, 2) && has(&memory, 65));
    }

    #[test]
    fn who_is_a_member_stays_and_of_the_others_the_one_that_was_a_member_longest_ago_goes() {
        let mut memory = Memory::default();
        (1..=64).for_each(|last| memory.met(node(last), at(last), here));
        // All but 1, 2 and 64 are members, 64 nowhere that it is remembered; 1 was one longer than 2.
        memory.parted(node(2));
        memory.parted(node(1));
        let standing = |peer: &RememberedPeer| match peer.node {
            other if [node(1), node(2)].contains(&other) => Standing::Gone,
            other if other == node(64) => Standing::Elsewhere,
            _ => Standing::Here,
        };
        for (last, left) in [(65, 2), (66, 1), (67, 64)] {
            assert!(has(&memory, left));
            memory.met(node(last), at(last), standing);
            assert!(!has(&memory, left) && has(&memory, last), "{left} makes room for {last}");
        }
        let (before, changes) = (kept(&memory), memory.changes);
        memory.met(node(68), at(68), standing);
        assert_eq!((kept(&memory), memory.changes), (before, changes), "a member answers at each");
    }

    #[test]
    fn one_node_with_many_addresses_leaves_room_for_others_and_keeps_those_where_it_answers() {
        let mut memory = Memory::default();
        (1..=8).for_each(|last| memory.met(node(1), at(last), here));
        assert_eq!(kept(&memory), [at(1), at(2)]);
        let before = memory.changes;
        memory.met(node(1), at(3), here);
        assert_eq!(memory.changes, before, "nothing was kept, so nothing has changed");
        // It is elsewhere now.
        let moved =
            |peer: &RememberedPeer| if peer.address == at(1) { Standing::Elsewhere } else { Standing::Here };
        memory.met(node(1), at(9), moved);
        assert_eq!(kept(&memory), [at(2), at(9)]);
    }

    #[test]
    fn the_second_address_of_a_node_makes_room_for_the_only_one_of_another_and_for_no_second() {
        let mut memory = Memory::default();
        for last in 1..=32 {
            memory.met(node(last), at(last), here);
            memory.met(node(last), at(last + 100), here);
        }
        memory.met(node(33), at(33), here);
        assert_eq!(kept(&memory).len(), REMEMBERED_MAX);
        assert!(has(&memory, 33) && has(&memory, 1) && !has(&memory, 101) && has(&memory, 102));
        let before = kept(&memory);
        memory.met(node(33), at(133), here);
        memory.met(node(1), at(101), here);
        assert_eq!(kept(&memory), before, "each has one");
    }

    #[test]
    fn what_this_life_has_met_goes_before_what_earlier_ones_did() {
        let mut memory = Memory::default();
        memory.met(node(1), at(1), here);
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
        memory.met(node(1), at(1), here);
        assert_eq!(memory.changes, 0, "it was there already");
        memory.met(node(2), at(2), here);
        assert_eq!(memory.changes, 1, "it answers again");
        memory.met(node(3), at(2), here);
        assert_eq!(memory.changes, 2, "another node has its address");
    }
}
