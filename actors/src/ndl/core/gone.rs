//! Nodes that are gone: their last lives, which no former one follows, and where they are asked, for they may be back.

use std::net::SocketAddr;

use sinew_runtime::{
    tid::{Incarnation, NodeAddress},
    time::Time,
};

use super::{
    Core, Member, Place,
    contact::{Contact, Role},
};
use crate::ndl::datagram::Announcement;

/// The last life of a node that is gone.
#[derive(Debug)]
pub(super) struct Gone {
    pub(super) since: Time,
    /// Where it was asked.
    pub(super) places: Vec<Place>,
    pub(super) incarnation: Incarnation,
    pub(super) boot_nonce: u64,
}

impl Core {
    /// Keeps the last life of a lost node, so that a former one never comes back. // spec: NDL-7.1
    pub(super) fn remember(&mut self, now: Time, member: &Member) {
        if self.gone.len() >= self.nodes_max
            && let Some(node) = self.gone.iter().min_by_key(|(_, gone)| gone.since).map(|(node, _)| *node)
            && let Some(oldest) = self.gone.remove(&node)
        {
            oldest.places.into_iter().for_each(|place| self.forget_former(place, node));
        }
        let Announcement { node, incarnation, boot_nonce, .. } = member.announcement;
        let mut places: Vec<_> = member.routes.places().collect();
        if places.is_empty() {
            places.push(member.routes.best());
        }
        self.gone.insert(node, Gone { since: now, places, incarnation, boot_nonce });
    }

    /// Who was lost may be in reach from an address that we did not have.
    pub(super) fn look_for_the_gone(&mut self, now: Time, new: &[SocketAddr]) {
        let gone: Vec<_> = self.gone.iter().map(|(node, gone)| (*node, gone.places.clone())).collect();
        for (node, places) in gone {
            let there = places.iter().map(|place| place.there);
            let at = there.flat_map(|there| new.iter().map(move |here| Place::between(*here, there)));
            for place in at.filter(Place::is_a_way) {
                self.contacts.get_or_insert_with(place, || Contact::former(now, node));
            }
        }
    }

    /// Whether this is the last life of a lost node, which is still asked where it was.
    pub(super) fn is_former_at(&self, place: Place, announcement: &Announcement) -> bool {
        let Announcement { node, incarnation, boot_nonce, .. } = *announcement;
        let is_asked = self.contacts.get(&place).is_some_and(
            |contact| matches!(contact.role, Role::Former { node: former, .. } if former == node),
        );
        let Some(gone) = self.gone.get(&node) else { return false };
        let is_it = (gone.incarnation, gone.boot_nonce) == (incarnation, boot_nonce);
        // It says goodbye on each of its routes, and may have had one that this node did not.
        let is_announced = announcement.has_ndl_at(place.there)
            && gone.places.iter().any(|known| announcement.has_ndl_at(known.there));
        is_it && (is_asked || is_announced)
    }

    /// A node that is back says that it is also where it was asked last: what it is asked there already may make a route. Returns whether
    /// it is asked there.
    pub(super) fn seeks_former(&mut self, place: Place, node: NodeAddress) -> bool {
        let Some(mut contact) = self.contacts.get_mut(&place) else { return false };
        let is_its = matches!(contact.role, Role::Former { node: former, .. } if former == node);
        if is_its {
            contact.role = Role::Candidate { asked: 0 };
            contact.sources.clear();
        }
        is_its
    }

    pub(super) fn forget_former(&mut self, place: Place, node: NodeAddress) {
        if let Some(contact) = self.contacts.get(&place)
            && matches!(contact.role, Role::Former { node: former, .. } if former == node)
            && !contact.is_seed
        {
            self.contacts.remove(&place);
        }
    }
}
