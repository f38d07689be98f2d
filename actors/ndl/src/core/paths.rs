//! The use of local addresses: which places are queried when one is added or removed.

use std::{collections::BTreeMap, net::SocketAddr};

use sinew_runtime::{tid::NodeAddress, time::Time};

use super::{Core, contact::Contact};

impl Core {
    /// Sets the local addresses for queries. The first one is known to other nodes by other means. Queries
    /// from removed addresses can no longer be answered.
    pub fn use_paths(&mut self, now: Time, paths: &[SocketAddr]) {
        let new = self.local_addresses.use_paths(paths);
        let paths = self.local_addresses.paths();
        self.local_node.announcement.announce_ndl(paths);
        self.contacts.retain(|place, _| paths.contains(&place.here));
        self.members.use_paths(paths);
        self.conflicts.use_paths(paths);
        if new.is_empty() || self.paces.rest().due().is_none() {
            return;
        }
        // One of these seeds may have a usable local address now.
        self.contacts.drop_unroutable();
        self.add_seeds(now);
        if self.local_addresses.take_moved() {
            // A node that left and returned queries this node at an address that this node no longer has.
            // spec: NDL-2.5
            self.seek_remembered(now);
        } else {
            let (remembered, present, (contacts, _)) = self.remembered_parts();
            remembered.add_contacts(now, &present, contacts);
        }
        for (place, node) in self.departed.places_from(&new) {
            self.contacts.get_or_insert_with(place, || Contact::former(now, node));
        }
        let members: Vec<_> = self.members.keys().copied().collect();
        members.into_iter().for_each(|node| self.seek(now, node));
        let queried: Vec<_> =
            self.contacts.keys().copied().filter(|place| new.contains(&place.here)).collect();
        queried.into_iter().for_each(|place| self.query_on_receipt(now, place));
        self.query_group(now);
    }

    /// Sets the addresses of this host, used or not.
    pub fn use_local_addresses(&mut self, all: &[SocketAddr]) {
        self.local_addresses.use_all(all);
    }

    /// Sets the interface name of each of these addresses. It decides nothing.
    pub fn use_interface_names(&mut self, names: BTreeMap<SocketAddr, String>) {
        self.local_addresses.use_names(names);
    }

    /// Returns whether exactly these addresses are known as this host's.
    pub fn has_local_addresses(&self, all: &[SocketAddr]) -> bool {
        self.local_addresses.are(all)
    }

    /// Replaces the seeds. A former seed is no longer queried as one.
    pub fn use_seeds(&mut self, now: Time, seeds: Vec<SocketAddr>) {
        if !self.local_addresses.use_seeds(seeds) {
            return;
        }
        self.contacts.change_all(|contact| contact.is_seed = false);
        if self.paces.rest().due().is_some() {
            self.add_seeds(now);
        }
    }

    /// Returns whether these are the seeds already.
    pub fn has_seeds(&self, seeds: &[SocketAddr]) -> bool {
        self.local_addresses.has_seeds(seeds)
    }

    /// Creates contacts for the seeds, from each local address.
    pub(super) fn add_seeds(&mut self, now: Time) {
        for place in self.local_addresses.seed_places() {
            self.contacts.get_or_insert_with(place, || Contact::seed(now)).is_seed = true;
        }
    }

    /// Creates contacts for all remembered addresses without a member.
    pub(super) fn seek_remembered(&mut self, now: Time) {
        let (remembered, present, (contacts, _)) = self.remembered_parts();
        remembered.start(now, &present, contacts);
    }

    /// Queries a member at each announced place that has not answered.
    pub(super) fn seek(&mut self, now: Time, node: NodeAddress) {
        let Some(member) = self.members.get(&node) else { return };
        for place in member.unknown_places(&self.local_addresses, &self.contacts) {
            self.contacts.insert(place, Contact::announced(now));
            self.query_on_receipt(now, place);
        }
    }
}
