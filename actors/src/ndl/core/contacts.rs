//! All addresses that NDL talks to, and how many of them are candidates.
//!
//! An address that is heard of anew needs room among the candidates: where 1,000 nodes start at once a million are. So candidates are counted
//! when they come, go and change, here and nowhere else: who changes a contact does so through a [`ContactMut`], which looks at it before and
//! after.

use std::{
    collections::{BTreeMap, btree_map::Entry},
    ops::{Deref, DerefMut},
};

use super::{Place, contact::Contact};

/// The contacts by where they are: to be read, the map that they are.
#[derive(Debug, Default)]
pub(super) struct Contacts {
    all: BTreeMap<Place, Contact>,
    /// How many of them are candidates.
    candidates: usize,
}

impl Contacts {
    /// How many of them [are candidates](Contact::is_candidate).
    pub(super) fn candidates(&self) -> usize {
        debug_assert_eq!(self.candidates, self.counted(), "every change is counted");
        self.candidates
    }

    fn counted(&self) -> usize {
        self.all.values().filter(|contact| contact.is_candidate()).count()
    }

    /// The one there, to be changed.
    pub(super) fn get_mut(&mut self, place: &Place) -> Option<ContactMut<'_>> {
        let contact = self.all.get_mut(place)?;
        Some(ContactMut::of(contact, &mut self.candidates))
    }

    /// The same; where there is none, what `make` makes.
    pub(super) fn get_or_insert_with(
        &mut self,
        place: Place,
        make: impl FnOnce() -> Contact,
    ) -> ContactMut<'_> {
        let candidates = &mut self.candidates;
        match self.all.entry(place) {
            Entry::Occupied(there) => ContactMut::of(there.into_mut(), candidates),
            // It is counted when it has been changed.
            Entry::Vacant(free) => {
                ContactMut { contact: free.insert(make()), was_candidate: false, candidates }
            }
        }
    }

    /// Puts one there, in the place of any that was there.
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

    /// Keeps those that are `wanted`.
    pub(super) fn retain(&mut self, mut wanted: impl FnMut(&Place, &Contact) -> bool) {
        self.all.retain(|place, contact| {
            let is_kept = wanted(place, contact);
            self.candidates -= usize::from(!is_kept && contact.is_candidate());
            is_kept
        });
    }

    /// Changes each of them.
    pub(super) fn change_all(&mut self, change: impl Fn(&mut Contact)) {
        self.all.values_mut().for_each(|contact| change(&mut ContactMut::of(contact, &mut self.candidates)));
    }
}

impl Deref for Contacts {
    type Target = BTreeMap<Place, Contact>;

    fn deref(&self) -> &Self::Target {
        &self.all
    }
}

/// A contact that may be changed. What it is then counts when this is dropped.
#[derive(Debug)]
pub(super) struct ContactMut<'a> {
    contact: &'a mut Contact,
    /// As what it is counted.
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
    use sinew_runtime::{tid::NodeAddress, time::Time};

    use super::{
        super::{Source, contact::Role},
        *,
    };

    const NOW: Time = Time::from_nanos(1_000_000_000);

    fn place(last: u8) -> Place {
        Place { there: ([10, 0, 0, last], 1).into(), here: ([10, 0, 0, 1], 1).into() }
    }

    fn candidate() -> Contact {
        Contact::new(NOW, Source::Multicast)
    }

    /// Three candidates, and one that only a member says.
    fn four() -> Contacts {
        let mut contacts = Contacts::default();
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
    fn who_becomes_a_candidate_or_is_one_no_more_is_counted_so_whatever_changed() {
        let mut contacts = four();
        let mut change = |last, change: &dyn Fn(&mut Contact)| {
            change(&mut contacts.get_mut(&place(last)).expect("it is there"));
            contacts.candidates()
        };
        assert_eq!(change(2, &|contact| contact.role = Role::Member(NodeAddress::new(2))), 2);
        assert_eq!(change(3, &|contact| contact.is_seed = true), 1);
        let hear = |contact: &mut Contact| {
            contact.sources.insert(Source::Query, NOW);
        };
        assert_eq!(change(5, &hear), 2);
        assert_eq!(change(2, &|contact| contact.role = Role::Candidate { asked: 0 }), 3);
        assert_eq!(change(4, &|contact| contact.sources.clear()), 2);
        contacts.change_all(|contact| contact.is_seed = false);
        assert_eq!(contacts.candidates(), 3);
        contacts.get_or_insert_with(place(6), candidate).role = Role::Member(NodeAddress::new(6));
        assert_eq!((contacts.candidates(), contacts.len()), (3, 5));
    }
}
