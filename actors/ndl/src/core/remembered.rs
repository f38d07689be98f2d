//! The addresses at which members answered, kept to query them first after a restart. The state survives a
//! restart of this layer in any case, and a restart of the process if the shell saves it to a file.
//!
//! A remembered address is a hint, as a seed is: only an answer makes a member. It is queried like a lost
//! node's address, with increasing intervals.

use std::{collections::BTreeSet, net::SocketAddr, time::Duration};

use sinew_model::address::unscoped;
use sinew_runtime::{
    tid::{Incarnation, NodeAddress},
    time::Time,
};

use super::{
    Member, Place, Source,
    authenticated::Authenticated,
    contact::{Contact, Role},
    contacts::Contacts,
    departed::Departed,
    local_addresses::LocalAddresses,
    members::Members,
};

/// Maximum number of remembered addresses. The one of the node met longest ago is evicted, but none where a member
/// answers.
pub(crate) const REMEMBERED_MAX: usize = 64;
/// Maximum number of addresses of one node. With two networks, the node is found when one of them fails.
const OF_ONE_MAX: usize = 2;
/// Number of consecutive starts without an answer after which an address is forgotten.
pub(crate) const UNANSWERED_MAX: u32 = 8;
/// Minimum duration of a start that counts, so that a process that fails repeatedly forgets no address. The
/// wall clock is not used: a robot may boot in 1970.
const COUNTS_AFTER: Duration = Duration::from_secs(60);

/// An address at which a member answered.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RememberedPeer {
    /// Address of the node's NDL. A link-local one has no interface, as interface numbers may change.
    pub address: SocketAddr,
    pub node: NodeAddress,
    /// Number of consecutive counted starts without an answer there.
    pub unanswered: u32,
}

#[derive(Debug)]
struct Entry {
    peer: RememberedPeer,
    /// No node has become a member there since the entry was read, or was one when this layer was restarted.
    is_sought: bool,
}

/// Presence of the node of a remembered address. The first in this order is evicted first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Presence {
    /// The node is not a member.
    Absent,
    /// The node is a member that does not answer there now.
    Elsewhere,
    /// The node is a member and answers there.
    Here,
}

/// The present nodes, and the local addresses from which others are queried.
#[derive(Clone, Copy, Debug)]
pub(super) struct Present<'a> {
    pub(super) members: &'a Members,
    pub(super) authenticated: &'a Authenticated,
    pub(super) local: &'a LocalAddresses,
}

impl Present<'_> {
    fn of(&self, peer: &RememberedPeer) -> Presence {
        let Some(member) = self.members.get(&peer.node) else { return Presence::Absent };
        let answers = member.routes.places().any(|place| unscoped(place.there) == peer.address);
        if answers { Presence::Here } else { Presence::Elsewhere }
    }

    fn is_trusted(&self, node: NodeAddress) -> bool {
        self.authenticated.trusts(self.members, node)
    }
}

/// The remembered addresses.
#[derive(Debug, Default)]
pub(super) struct Remembered {
    /// The entries. Those of nodes that are not members are ordered by the last contact, oldest first.
    entries: Vec<Entry>,
    /// Time at which the addresses of earlier incarnations were loaded.
    loaded: Option<Time>,
    has_counted: bool,
    /// Number of changes of the entries so far.
    changes: u64,
    /// Addresses of removed entries that were still queried, since this list was last taken.
    forgotten: Vec<SocketAddr>,
}

impl Remembered {
    /// Records that a member answers there. The present presence of each entry decides which one is evicted,
    /// if one must be.
    fn met(
        &mut self,
        node: NodeAddress,
        address: SocketAddr,
        presence: impl Fn(&RememberedPeer) -> Presence,
    ) {
        let known = self.entries.iter().position(|entry| entry.peer.address == address);
        let is_its = known.is_some_and(|at| self.entries[at].peer.node == node);
        let known = known.map(|at| if is_its { self.entries.remove(at).peer } else { self.forget(at) });
        if !is_its && !self.make_room(node, presence) {
            self.changes += u64::from(known.is_some());
            return;
        }
        self.changes += u64::from(known.is_none_or(|peer| !is_its || peer.unanswered > 0));
        self.entries.push(Entry { peer: RememberedPeer { address, node, unanswered: 0 }, is_sought: false });
    }

    /// Makes room for one more address of this node, and returns whether there is any. If the node has all
    /// its slots, one of its own entries is evicted. An entry where a member answers is not evicted, except
    /// the second one of a node in favour of a node that has none.
    fn make_room(&mut self, node: NodeAddress, presence: impl Fn(&RememberedPeer) -> Presence) -> bool {
        let is_own = |entry: &Entry| entry.peer.node == node;
        let has_all = self.entries.iter().filter(|entry| is_own(entry)).count() >= OF_ONE_MAX;
        if !has_all && self.entries.len() < REMEMBERED_MAX {
            return true;
        }
        // Among entries of equal presence the first is evicted, which was met longest ago.
        let leaves = self.entries.iter().enumerate().filter(|(_, entry)| !has_all || is_own(entry));
        let leaves = leaves.map(|(at, entry)| (presence(&entry.peer), at)).min();
        let left = leaves.filter(|(presence, _)| *presence != Presence::Here).map(|(_, at)| at);
        let given = || if self.has(node) { None } else { self.second_of_one() };
        let Some(at) = left.or_else(given) else { return false };
        self.forget(at);
        true
    }

    /// Removes an entry.
    fn forget(&mut self, at: usize) -> RememberedPeer {
        let Entry { peer, is_sought } = self.entries.remove(at);
        if is_sought {
            self.forgotten.push(peer.address);
        }
        peer
    }

    /// Returns the index of the first entry that is the second of its node.
    fn second_of_one(&self) -> Option<usize> {
        let mut firsts = BTreeSet::new();
        self.entries.iter().position(|entry| !firsts.insert(entry.peer.node))
    }

    /// Records that a node was a member until now. Its last contact is this moment, not the time at which it joined.
    fn refresh(&mut self, node: NodeAddress) {
        self.entries.sort_by_key(|entry| entry.peer.node == node);
    }

    /// Adds the addresses of earlier incarnations, ordered by the last contact, oldest first. Nodes met in
    /// this incarnation have priority.
    fn load(&mut self, now: Time, peers: Vec<RememberedPeer>) {
        self.loaded.get_or_insert(now);
        for peer in peers.into_iter().rev() {
            let is_known = self.entries.iter().any(|entry| entry.peer.address == peer.address);
            let of_one = self.entries.iter().filter(|entry| entry.peer.node == peer.node).count();
            if !is_known && of_one < OF_ONE_MAX && self.entries.len() < REMEMBERED_MAX {
                self.entries.insert(0, Entry { peer, is_sought: true });
            }
        }
    }

    /// Marks the entries to be queried again after a restart of this layer, except those where members
    /// answer. Members announce their leave.
    fn seek_all(&mut self, presence: impl Fn(&RememberedPeer) -> Presence) {
        for entry in &mut self.entries {
            entry.is_sought |= presence(&entry.peer) != Presence::Here;
        }
    }

    /// Stops the queries for a node that announced its leave at each of its addresses.
    fn stop_queries(&mut self, node: NodeAddress, is_its: impl Fn(SocketAddr) -> bool) {
        let entries = self.entries.iter_mut().filter(|entry| entry.peer.node == node);
        for entry in entries.filter(|entry| is_its(entry.peer.address)) {
            entry.is_sought = false;
        }
    }

    fn has(&self, node: NodeAddress) -> bool {
        self.entries.iter().any(|entry| entry.peer.node == node)
    }
}

/// Queries, by the contacts of remembered addresses.
impl Remembered {
    /// Returns the remembered addresses, ordered by the last contact, oldest first. Members count as met now.
    pub(super) fn peers(&self, present: &Present<'_>) -> Vec<RememberedPeer> {
        let mut all: Vec<_> = self.entries.iter().map(|entry| entry.peer).collect();
        all.sort_by_key(|peer| present.of(peer) != Presence::Absent);
        all
    }

    /// Returns the number of changes of the remembered addresses.
    pub(super) const fn changes(&self) -> u64 {
        self.changes
    }

    /// Returns whether the addresses of earlier incarnations have been loaded.
    pub(super) const fn is_loaded(&self) -> bool {
        self.loaded.is_some()
    }

    /// Loads the addresses of earlier incarnations of this node, and returns the places to query. // spec: NDL-2.5
    pub(super) fn handle(
        &mut self,
        now: Time,
        peers: Vec<RememberedPeer>,
        present: &Present<'_>,
        contacts: &mut Contacts,
    ) -> Vec<Place> {
        self.load(now, peers);
        self.add_contacts(now, present, contacts)
    }

    /// Creates contacts for all remembered addresses without a member at the start of a shell.
    pub(super) fn start(&mut self, now: Time, present: &Present<'_>, contacts: &mut Contacts) {
        self.seek_all(|peer| present.of(peer));
        self.add_contacts(now, present, contacts);
    }

    /// Creates contacts for the addresses to query, from each local address, and returns their places.
    pub(super) fn add_contacts(
        &self,
        now: Time,
        present: &Present<'_>,
        contacts: &mut Contacts,
    ) -> Vec<Place> {
        let mut added = Vec::new();
        for (place, node) in self.sought_places(present) {
            let mut contact = contacts.get_or_insert_with(place, || Contact::remembered(now, node));
            match &mut contact.role {
                Role::Member(_) => continue,
                // Another source named the place. It is met again when that source's time is over.
                Role::Candidate { .. } => {}
                Role::Former { wait, left, .. } => (*wait, *left) = (1, 0),
            }
            contact.sources.entry(Source::Remembered).or_insert(now);
            added.push(place);
        }
        added
    }

    /// Creates contacts for the addresses that lost theirs. Other sources named them and no node answered, or
    /// too many other addresses were named. Or a node answered there, or elsewhere in their node's name, and
    /// is gone. // spec: NDL-2.5
    pub(super) fn restore_contacts(&self, now: Time, present: &Present<'_>, contacts: &mut Contacts) {
        for (place, node) in self.sought_places(present) {
            contacts.get_or_insert_with(place, || Contact::remembered(now, node));
        }
    }

    /// Returns the places of the addresses to query. A place that a member announces is queried as the
    /// member's instead, even if another node is remembered there.
    fn sought_places(&self, present: &Present<'_>) -> Vec<(Place, NodeAddress)> {
        let paths = present.local.paths();
        let sought = self.entries.iter().filter(|entry| entry.is_sought).map(|entry| entry.peer);
        let sought = sought.filter(|peer| !present.is_trusted(peer.node));
        let places = sought.flat_map(|RememberedPeer { address, node, .. }| {
            paths.iter().map(move |here| (Place::between(*here, address), node))
        });
        let is_announced = |place: Place, node: NodeAddress| {
            // A member with a single address need not announce it. While it has no route, it is queried at
            // its last place.
            let is_its = |member: &Member| {
                member.announces(place)
                    || member.routes.places().next().is_none() && member.routes.best().there == place.there
            };
            present.members.get(&node).is_some_and(is_its)
        };
        let places = places.filter(|(place, node)| place.is_usable() && !is_announced(*place, *node));
        // An address of another node may be local by now.
        places.filter(|(place, _)| !paths.contains(&place.there)).collect()
    }

    /// Records that a member answers there. It is remembered once it is trusted.
    pub(super) fn answered(
        &mut self,
        node: NodeAddress,
        place: Place,
        present: &Present<'_>,
        queried: (&mut Contacts, &Departed),
    ) {
        if present.is_trusted(node) {
            self.met(node, unscoped(place.there), |peer| present.of(peer));
            self.drop_forgotten(queried);
        }
    }

    /// Stops queries to addresses that are no longer remembered. An address that a lost node had is still
    /// queried for that node.
    // spec: NDL-2.5
    fn drop_forgotten(&mut self, (contacts, departed): (&mut Contacts, &Departed)) {
        let forgotten = std::mem::take(&mut self.forgotten);
        if forgotten.is_empty() {
            return;
        }
        let is_lost_there = |place: &Place, contact: &Contact| match contact.role {
            Role::Former { node, .. } => departed.get(&node).is_some_and(|lost| lost.is_queried_at(place)),
            Role::Candidate { .. } | Role::Member(_) => false,
        };
        contacts.retain(|place, contact| {
            let is_forgotten = contact.is_remembered_alone() && forgotten.contains(&unscoped(place.there));
            !is_forgotten || is_lost_there(place, contact)
        });
    }

    /// Records each place where a member answers.
    pub(super) fn answered_everywhere(
        &mut self,
        node: NodeAddress,
        present: &Present<'_>,
        (contacts, departed): (&mut Contacts, &Departed),
    ) {
        let places = present.members.get(&node).map(|member| member.routes.places());
        for place in places.into_iter().flatten() {
            self.answered(node, place, present, (contacts, departed));
        }
    }

    /// Handles the leave of this incarnation of a node at all addresses that it announces. It may still be at
    /// other remembered addresses, as another node may have answered in its name. Where nodes have keys, an
    /// unauthenticated leave may also be another node's.
    // spec: NDL-2.5
    pub(super) fn left(&mut self, node: NodeAddress, incarnation: Incarnation, present: &Present<'_>) {
        if let Some(member) = present.members.get(&node)
            && member.announcement.incarnation == incarnation
            && present.is_trusted(node)
        {
            self.stop_queries(node, |address| member.announcement.has_ndl_at(address));
        }
    }

    /// Records that a node was a member until now. The freed room is for members met while there was none.
    pub(super) fn lost(
        &mut self,
        node: NodeAddress,
        present: &Present<'_>,
        queried: (&mut Contacts, &Departed),
    ) {
        self.refresh(node);
        if self.has(node) {
            self.add_members(present, queried);
        }
    }

    /// Adds members without a remembered address, as long as there is room. When several members are lost
    /// together, each frees room for the next one, so no more members are examined than are added.
    fn add_members(&mut self, present: &Present<'_>, (contacts, departed): (&mut Contacts, &Departed)) {
        for _ in 0..REMEMBERED_MAX {
            let missing = present.members.iter().find_map(|(node, member)| {
                let is_missing = !self.has(*node) && present.is_trusted(*node);
                member.routes.places().next().filter(|_| is_missing).map(|place| (*node, place))
            });
            let Some((node, place)) = missing else { return };
            self.answered(node, place, present, (contacts, departed));
            if !self.has(node) {
                return;
            }
        }
    }

    /// Updates the remembered places of a node that is found. Its other remembered places are queried as
    /// announced places if it announces them. The remaining ones are not queried until it is lost. Returns
    /// the announced ones.
    ///
    /// Another node may have answered in its name. Where nodes have keys, an answer has no effect on the
    /// other places before the node is authenticated. Without keys, the answer is trusted until the node is
    /// lost. The other remembered places are kept, and queried again then.
    pub(super) fn found(
        &self,
        node: NodeAddress,
        present: &Present<'_>,
        contacts: &mut Contacts,
    ) -> Vec<Place> {
        let member = present.members.get(&node).filter(|_| self.has(node));
        let Some(found) = member.map(|member| &member.announcement) else { return Vec::new() };
        let is_its =
            |(_, contact): &(&Place, &Contact)| contact.is_remembered_alone() && contact.is_former_of(node);
        let places = contacts.iter().filter(is_its).map(|(place, _)| *place);
        let (announced, others): (Vec<_>, Vec<_>) = places.partition(|place| found.has_ndl_at(place.there));
        if present.is_trusted(node) {
            for place in others {
                contacts.remove(&place);
            }
        }
        for place in &announced {
            if let Some(mut contact) = contacts.get_mut(place) {
                contact.role = Role::Candidate { queried: 0 };
            }
        }
        announced
    }

    /// Counts a start once, after it has lasted for a while and a member is present. If no node answers at
    /// all, this node is cut off and knows nothing about others. // spec: NDL-2.5
    pub(super) fn time_passed(
        &mut self,
        now: Time,
        present: &Present<'_>,
        (contacts, departed): (&mut Contacts, &Departed),
    ) {
        let has_lasted = |loaded: Time| now.since(loaded) >= COUNTS_AFTER;
        if self.has_counted || present.members.is_empty() || !self.loaded.is_some_and(has_lasted) {
            return;
        }
        self.has_counted = true;
        for entry in &mut self.entries {
            if entry.is_sought && present.of(&entry.peer) != Presence::Here {
                entry.peer.unanswered += 1;
                self.changes += 1;
            }
        }
        let before = self.entries.len();
        let is_over = |entry: &Entry| entry.peer.unanswered >= UNANSWERED_MAX;
        while let Some(at) = self.entries.iter().position(is_over) {
            self.forget(at);
        }
        self.drop_forgotten((contacts, departed));
        if self.entries.len() < before {
            self.add_members(present, (contacts, departed));
        }
    }
}

#[cfg(test)]
mod tests;
