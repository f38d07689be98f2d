//! All addresses that NDL exchanges datagrams with, the queries to them, and the budgets of received datagrams.
//!
//! A newly named address needs room among the candidates. When 1,000 nodes start at once there are a million
//! such requests. So candidates are counted when contacts are added, removed and changed, and only here. Each
//! change of a contact uses a [`ContactMut`], which checks the contact before and after the change.

use std::{
    collections::{BTreeMap, btree_map::Entry},
    net::SocketAddr,
    ops::{Deref, DerefMut},
    time::Duration,
};

use sinew_model::config::NdlConfig;
use sinew_runtime::{tid::NodeAddress, time::Time};

use super::{
    Output, Place, Source,
    budget::UnknownAddressLimits,
    contact::{Contact, Role},
    departed::DepartedNode,
    queries::{Correlations, SentQueries, SentQuery},
};
use crate::datagram::{Announcement, peek_answer};

/// Minimum time between two queries to one address caused by received datagrams, so that a sender cannot make
/// this node flood a third one.
const QUERY_GAP: Duration = Duration::from_millis(10);
/// Maximum number of cycles between two queries to the address of a departed node.
const FORMER_WAIT_MAX: u32 = 16;

/// The contacts by their places. They can be read as the map.
#[derive(Debug)]
pub(super) struct Contacts {
    all: BTreeMap<Place, Contact>,
    /// Number of candidates among the contacts.
    candidates: usize,
    candidates_max: usize,
    /// Limits of datagrams from other addresses.
    unknown_limits: UnknownAddressLimits,
    correlations: Correlations,
    /// The queries to the multicast group. `None` if the group is not used.
    group: Option<SentQueries>,
}

/// Whether an address is queried in this cycle.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Due {
    Now,
    Later,
    /// The address belongs to this member. The pace of the member decides.
    Member(NodeAddress),
}

impl Contacts {
    /// Creates an empty table. `secret` is random and never sent.
    pub(super) fn new(config: &NdlConfig, secret: u128) -> Self {
        Self {
            all: BTreeMap::new(),
            candidates: 0,
            candidates_max: config.nodes_max,
            unknown_limits: UnknownAddressLimits::new(),
            correlations: Correlations::new(secret),
            group: config.multicast.map(|_| SentQueries::default()),
        }
    }

    /// Returns the number of contacts that [are candidates](Contact::is_candidate).
    pub(super) fn candidates(&self) -> usize {
        debug_assert_eq!(self.candidates, self.counted(), "every change is counted");
        self.candidates
    }

    /// Removes all contacts, and voids all queries.
    #[cfg(test)]
    pub(super) fn clear(&mut self) {
        (self.all, self.candidates) = (BTreeMap::new(), 0);
        self.group.iter_mut().for_each(SentQueries::clear);
    }

    fn counted(&self) -> usize {
        self.all.values().filter(|contact| contact.is_candidate()).count()
    }

    /// Returns the contact at `place` for a change.
    pub(super) fn get_mut(&mut self, place: &Place) -> Option<ContactMut<'_>> {
        let contact = self.all.get_mut(place)?;
        Some(ContactMut::of(contact, &mut self.candidates))
    }

    /// Returns the contact at `place`, or adds the result of `make`.
    pub(super) fn get_or_insert_with(
        &mut self,
        place: Place,
        make: impl FnOnce() -> Contact,
    ) -> ContactMut<'_> {
        let candidates = &mut self.candidates;
        match self.all.entry(place) {
            Entry::Occupied(there) => ContactMut::of(there.into_mut(), candidates),
            // The contact is counted after the change.
            Entry::Vacant(free) => {
                ContactMut { contact: free.insert(make()), was_candidate: false, candidates }
            }
        }
    }

    /// Adds a contact, and replaces the one at that place.
    pub(super) fn insert(&mut self, place: Place, contact: Contact) {
        self.candidates += usize::from(contact.is_candidate());
        let former = self.all.insert(place, contact);
        self.candidates -= usize::from(former.is_some_and(|former| former.is_candidate()));
    }

    pub(super) fn remove(&mut self, place: &Place) -> Option<Contact> {
        let contact = self.all.remove(place)?;
        self.candidates -= usize::from(contact.is_candidate());
        Some(contact)
    }

    /// Keeps the `wanted` contacts.
    pub(super) fn retain(&mut self, mut wanted: impl FnMut(&Place, &Contact) -> bool) {
        self.all.retain(|place, contact| {
            let is_kept = wanted(place, contact);
            self.candidates -= usize::from(!is_kept && contact.is_candidate());
            is_kept
        });
    }

    /// Changes each contact.
    pub(super) fn change_all(&mut self, change: impl Fn(&mut Contact)) {
        self.all.values_mut().for_each(|contact| change(&mut ContactMut::of(contact, &mut self.candidates)));
    }
}

impl Contacts {
    /// Returns whether the budget of its source allows a datagram. // spec: NDL-7.2
    pub(super) fn admit(&mut self, now: Time, from: Place, bytes: &[u8]) -> bool {
        if let Some(mut contact) = self.get_mut(&from) {
            let is_expected = peek_answer(bytes).is_some_and(|id| contact.queries.has(id));
            // Expected answers have a separate budget, so that noise with a member's source address does not
            // block its answers.
            if is_expected && contact.answers.try_take(now) {
                return true;
            }
            if contact.has_own_budget() {
                return contact.budget.try_take(now);
            }
        }
        self.unknown_limits.admit(now, from.there.ip())
    }

    /// Returns whether the budget of unknown addresses allows an input other than a datagram.
    pub(super) fn admit_any(&mut self, now: Time) -> bool {
        self.unknown_limits.admit_any(now)
    }

    /// Returns the order to query `to`, if there is a contact. `answerable` is the number of its last queries
    /// that may be answered.
    pub(super) fn query(&mut self, now: Time, to: Place, answerable: usize) -> Option<Output> {
        let correlation = self.correlations.draw();
        let mut contact = self.get_mut(&to)?;
        contact.queries.push(SentQuery { correlation, sent: now }, answerable);
        Some(Output::SendQuery { to, correlation })
    }

    /// Returns the order to query the multicast group from these local addresses, if the group is used.
    pub(super) fn query_group(
        &mut self,
        now: Time,
        from: &[SocketAddr],
        answerable: usize,
    ) -> Option<Output> {
        let group = self.group.as_mut()?;
        let correlation = self.correlations.draw();
        group.push(SentQuery { correlation, sent: now }, answerable);
        Some(Output::SendMulticastQuery { from: from.to_vec(), correlation })
    }

    /// Removes and returns the query to `from` that `correlation` answers.
    pub(super) fn take_query(&mut self, from: Place, correlation: u64) -> Option<SentQuery> {
        self.get_mut(&from)?.queries.take(correlation)
    }

    /// Returns whether `correlation` answers a query to the group.
    pub(super) fn has_group_query(&self, correlation: u64) -> bool {
        self.group.as_ref().is_some_and(|group| group.has(correlation))
    }

    /// Returns an index into `count` things that are taken in turn.
    pub(super) fn turn(&self, count: usize) -> usize {
        usize::try_from(self.correlations.drawn() % count.max(1) as u64).unwrap_or(0)
    }

    /// Records that `source` names `place`. A new contact may evict the oldest candidate, which is returned.
    pub(super) fn named(&mut self, now: Time, place: Place, source: Source) -> Option<Place> {
        let evicted = if self.contains_key(&place) { None } else { self.make_room_for_a_candidate() };
        self.get_or_insert_with(place, || Contact::new(now, source)).named_by(now, source);
        evicted
    }

    /// Evicts the oldest candidate if there is no room. A live candidate answers within milliseconds. // spec: NDL-7.1
    fn make_room_for_a_candidate(&mut self) -> Option<Place> {
        if self.candidates() < self.candidates_max {
            return None;
        }
        let candidates = self.iter().filter(|(_, contact)| contact.is_candidate());
        let oldest = candidates.min_by_key(|(_, contact)| contact.since).map(|(place, _)| *place)?;
        self.remove(&oldest);
        Some(oldest)
    }

    /// Returns whether a received datagram causes a query to `place`, and counts that query.
    pub(super) fn may_query_on_receipt(&mut self, now: Time, place: Place) -> bool {
        let Some(mut contact) = self.get_mut(&place) else { return false };
        // Queries of the cycle do not count, nor do missed answers: a pending answer may be from an
        // incarnation that has ended, and this datagram announces a new one.
        let may = contact.queried_on_receipt.is_none_or(|at| now.since(at) >= QUERY_GAP);
        if may {
            contact.queried_on_receipt = Some(now);
        }
        may
    }

    /// Returns whether `place` is queried in this cycle. A candidate that missed `missed_max` queries is dropped.
    pub(super) fn next_cycle(&mut self, place: Place, missed_max: u32) -> Due {
        if self.get(&place).is_some_and(|contact| contact.has_missed(missed_max)) {
            self.remove(&place);
            return Due::Later;
        }
        let Some(mut contact) = self.get_mut(&place) else { return Due::Later };
        let Contact { role, is_seed, .. } = &mut *contact;
        match role {
            Role::Candidate { queried } => *queried = queried.saturating_add(1),
            Role::Member(node) => return Due::Member(*node),
            Role::Former { left, .. } if *left > 0 && !*is_seed => {
                *left -= 1;
                return Due::Later;
            }
            Role::Former { wait, left, .. } => {
                *left = *wait;
                *wait = (*wait * 2).min(FORMER_WAIT_MAX);
            }
        }
        Due::Now
    }

    pub(super) fn role_at(&self, place: &Place) -> Option<Role> {
        self.get(place).map(|contact| contact.role)
    }

    /// Returns the contact at `place`, where a node answers or did.
    pub(super) fn answering(&mut self, now: Time, place: Place) -> ContactMut<'_> {
        self.get_or_insert_with(place, || Contact::new(now, Source::Query))
    }

    /// Voids the queries to addresses that an ended node announced: their answers would be too late.
    pub(super) fn void_queries(&mut self, now: Time, of: &Announcement) {
        let is_its = |contact: &Contact| match contact.role {
            Role::Candidate { .. } => true,
            Role::Former { node, .. } => node == of.node,
            Role::Member(_) => false,
        };
        let places = self.iter().filter(|(place, contact)| of.has_ndl_at(place.there) && is_its(contact));
        let places: Vec<_> = places.map(|(place, _)| *place).collect();
        places.into_iter().for_each(|place| self.release(now, place));
    }

    /// Removes the contact at `place`, where no known node is any more. A seed is still queried.
    pub(super) fn release(&mut self, now: Time, place: Place) {
        let Some(contact) = self.remove(&place) else { return };
        if contact.is_seed {
            self.insert(place, Contact::seed(now));
        }
    }

    /// Removes IPv6 seeds that had no usable local address.
    pub(super) fn drop_unroutable(&mut self) {
        self.retain(|place, contact| {
            let is_candidate = matches!(contact.role, Role::Candidate { .. });
            !(place.there.is_ipv6() && !place.is_usable() && is_candidate)
        });
    }

    /// Handles the return of a departed node that answers at `from`. The other places where it was queried
    /// are queried as a member's if it announces them, since a pending answer may make a route. Otherwise
    /// they are dropped. Returns the announced places. // spec: NDL-2.1
    pub(super) fn returned(&mut self, former: &DepartedNode, from: Place, back: &Announcement) -> Vec<Place> {
        let others = self.places_of_departed(back.node, former).into_iter().filter(|place| *place != from);
        let (announced, former): (Vec<_>, Vec<_>) = others.partition(|place| back.has_ndl_at(place.there));
        former.into_iter().for_each(|place| self.drop_former(place));
        for place in &announced {
            if let Some(mut contact) = self.get_mut(place) {
                contact.role = Role::Candidate { queried: 0 };
                contact.sources.clear();
            }
        }
        announced
    }

    /// Stops the queries for a departed node.
    pub(super) fn drop_departed(&mut self, node: NodeAddress, former: &DepartedNode) {
        self.places_of_departed(node, former).into_iter().for_each(|place| self.drop_former(place));
    }

    /// Returns the places that are queried because the node has departed: its last places, and the same from newer
    /// local addresses. A place that is only remembered is queried for that reason instead.
    fn places_of_departed(&self, node: NodeAddress, former: &DepartedNode) -> Vec<Place> {
        let is_queried = |(place, contact): &(&Place, &Contact)| {
            contact.is_former_of(node) && (former.is_queried_at(place) || !contact.is_remembered_alone())
        };
        self.iter().filter(is_queried).map(|(place, _)| *place).collect()
    }

    /// Stops querying `place` for a departed node. A seed is still queried.
    fn drop_former(&mut self, place: Place) {
        if self.get(&place).is_some_and(|contact| !contact.is_seed) {
            self.remove(&place);
        }
    }
}

impl Deref for Contacts {
    type Target = BTreeMap<Place, Contact>;

    fn deref(&self) -> &Self::Target {
        &self.all
    }
}

/// A contact that may be changed. Its new state is counted when this guard is dropped.
#[derive(Debug)]
pub(super) struct ContactMut<'a> {
    contact: &'a mut Contact,
    /// The state with which the contact is counted.
    was_candidate: bool,
    candidates: &'a mut usize,
}

impl<'a> ContactMut<'a> {
    fn of(contact: &'a mut Contact, candidates: &'a mut usize) -> Self {
        Self { was_candidate: contact.is_candidate(), contact, candidates }
    }
}

impl Deref for ContactMut<'_> {
    type Target = Contact;

    fn deref(&self) -> &Contact {
        self.contact
    }
}

impl DerefMut for ContactMut<'_> {
    fn deref_mut(&mut self) -> &mut Contact {
        self.contact
    }
}

impl Drop for ContactMut<'_> {
    fn drop(&mut self) {
        *self.candidates += usize::from(self.contact.is_candidate());
        *self.candidates -= usize::from(self.was_candidate);
    }
}

#[cfg(test)]
mod tests {
    use sinew_model::config::NodeConfig;

    use super::*;

    const NOW: Time = Time::from_nanos(1_000_000_000);

    fn place(last: u8) -> Place {
        Place { there: ([10, 0, 0, last], 1).into(), here: ([10, 0, 0, 1], 1).into() }
    }

    fn candidate() -> Contact {
        Contact::new(NOW, Source::Multicast)
    }

    /// Three candidates, and a contact that only a member announces.
    fn four() -> Contacts {
        let mut contacts = Contacts::new(&NodeConfig::new("hip").ndl, 0);
        (2..5).for_each(|last| contacts.insert(place(last), candidate()));
        contacts.insert(place(5), Contact::announced(NOW));
        assert_eq!((contacts.candidates(), contacts.len()), (3, 4));
        contacts
    }

    #[test]
    fn candidates_are_counted_as_they_come_and_go() {
        let mut contacts = four();
        contacts.insert(place(2), candidate());
        assert_eq!(contacts.candidates(), 3, "one in the place of another");
        contacts.insert(place(2), Contact::seed(NOW));
        assert_eq!(contacts.candidates(), 2);
        contacts.get_or_insert_with(place(6), candidate);
        contacts.get_or_insert_with(place(7), || Contact::former(NOW, NodeAddress::new(7)));
        contacts.get_or_insert_with(place(2), candidate);
        assert_eq!((contacts.candidates(), contacts.len()), (3, 6));
        assert!(contacts.remove(&place(3)).is_some() && contacts.remove(&place(5)).is_some());
        assert!(contacts.remove(&place(9)).is_none());
        assert_eq!(contacts.candidates(), 2);
        contacts.retain(|at, _| *at != place(4) && *at != place(7));
        assert_eq!((contacts.candidates(), contacts.len()), (1, 2));
    }

    #[test]
    fn candidate_count_follows_every_kind_of_change() {
        let mut contacts = four();
        let mut change = |last, change: &dyn Fn(&mut Contact)| {
            change(&mut contacts.get_mut(&place(last)).expect("it is there"));
            contacts.candidates()
        };
        assert_eq!(change(2, &|contact| contact.role = Role::Member(NodeAddress::new(2))), 2);
        assert_eq!(change(3, &|contact| contact.is_seed = true), 1);
        let receive = |contact: &mut Contact| {
            contact.sources.insert(Source::Query, NOW);
        };
        assert_eq!(change(5, &receive), 2);
        assert_eq!(change(2, &|contact| contact.role = Role::Candidate { queried: 0 }), 3);
        assert_eq!(change(4, &|contact| contact.sources.clear()), 2);
        contacts.change_all(|contact| contact.is_seed = false);
        assert_eq!(contacts.candidates(), 3);
        contacts.get_or_insert_with(place(6), candidate).role = Role::Member(NodeAddress::new(6));
        assert_eq!((contacts.candidates(), contacts.len()), (3, 5));
    }
}
