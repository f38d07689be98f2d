//! Nodes that are gone: their last lives, which no former one follows, and where they are asked, for they may be back.

use std::{net::SocketAddr, time::Duration};

use sinew_runtime::{
    tid::{Incarnation, NodeAddress},
    time::Time,
};

use super::{
    Core, Member, Place,
    contact::{Contact, Role},
};
use crate::ndl::{LossReason, datagram::Announcement};

/// How long a life has given no sign.
#[derive(Clone, Copy, Debug)]
pub(super) struct Silence {
    pub(super) lasts: Duration,
    /// Within how much of that a loss is known.
    pub(super) bound: Duration,
}

impl Silence {
    /// As events say it: how long it lasts, and its bound, in microseconds.
    pub(super) fn micros(self) -> (u64, u64) {
        let micros = |time: Duration| u64::try_from(time.as_micros()).unwrap_or(u64::MAX);
        (micros(self.lasts), micros(self.bound))
    }
}

/// The last life of a node that is gone.
#[derive(Debug)]
pub(super) struct Gone {
    pub(super) since: Time,
    /// Its last sign of life.
    heard: Time,
    /// Time after that within which its loss was to be known.
    bound: Duration,
    /// It said so, and is asked no more.
    pub(super) has_left: bool,
    /// Where it was asked.
    pub(super) places: Vec<Place>,
    pub(super) incarnation: Incarnation,
    pub(super) boot_nonce: u64,
}

impl Gone {
    /// How long it has given no sign, before its end and since.
    pub(super) const fn silence(&self, now: Time) -> Silence {
        Silence { lasts: now.since(self.heard), bound: self.bound }
    }

    /// Whether it is asked there because it is gone.
    pub(super) fn is_asked_at(&self, place: &Place) -> bool {
        !self.has_left && self.places.contains(place)
    }
}

impl Core {
    /// How long a member has given no sign.
    pub(super) fn silence(&self, now: Time, member: &Member) -> Silence {
        Silence { lasts: now.since(member.heard), bound: self.paces[member.pace].bound() }
    }

    /// Keeps the last life of a lost node, so that a former one never comes back. // spec: NDL-7.1
    pub(super) fn remember(&mut self, now: Time, member: &Member, why: &LossReason) {
        if self.gone.len() >= self.nodes_max
            && let Some(node) = self.gone.iter().min_by_key(|(_, gone)| gone.since).map(|(node, _)| *node)
            && let Some(oldest) = self.gone.remove(&node)
        {
            self.asked_for(node, &oldest).into_iter().for_each(|place| self.forget_former(place));
        }
        let Announcement { node, incarnation, boot_nonce, .. } = member.announcement;
        let mut places: Vec<_> = member.routes.places().collect();
        if places.is_empty() {
            places.push(member.routes.best());
        }
        let has_left = why.is_announced();
        let (heard, bound) = (member.heard, self.paces[member.pace].bound());
        self.gone.insert(node, Gone { since: now, heard, bound, has_left, places, incarnation, boot_nonce });
    }

    /// Who was lost may be in reach from an address that we did not have; who has left is looked for nowhere.
    pub(super) fn look_for_the_gone(&mut self, now: Time, new: &[SocketAddr]) {
        let lost = self.gone.iter().filter(|(_, gone)| !gone.has_left);
        let lost: Vec<_> = lost.map(|(node, gone)| (*node, gone.places.clone())).collect();
        for (node, places) in lost {
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
        let is_asked = self.contacts.get(&place).is_some_and(|contact| contact.is_former_of(node));
        let Some(gone) = self.gone.get(&node) else { return false };
        let is_it = (gone.incarnation, gone.boot_nonce) == (incarnation, boot_nonce);
        // It says goodbye on each of its routes, and may have had one that this node did not.
        let is_announced = announcement.has_ndl_at(place.there)
            && gone.places.iter().any(|known| announcement.has_ndl_at(known.there));
        is_it && (is_asked || is_announced)
    }

    /// A node that was gone is back, and answers at `from`. Where else it was asked for that, it is asked as a member if it says that it is
    /// there, as what it is asked already may make a route, and else no more. Returns where it is. // spec: NDL-2.1
    pub(super) fn settle_gone(&mut self, gone: &Gone, from: Place, back: &Announcement) -> Vec<Place> {
        let others = self.asked_for(back.node, gone).into_iter().filter(|place| *place != from);
        let (announced, former): (Vec<_>, Vec<_>) = others.partition(|place| back.has_ndl_at(place.there));
        former.into_iter().for_each(|place| self.forget_former(place));
        for place in &announced {
            if let Some(mut contact) = self.contacts.get_mut(place) {
                contact.role = Role::Candidate { asked: 0 };
                contact.sources.clear();
            }
        }
        announced
    }

    /// Where a node is asked because it is gone: where it was, and the same from addresses of ours that came since. Where it is only
    /// remembered it is asked for that.
    fn asked_for(&self, node: NodeAddress, gone: &Gone) -> Vec<Place> {
        let is_asked = |(place, contact): &(&Place, &Contact)| {
            contact.is_former_of(node) && (gone.is_asked_at(place) || !contact.is_remembered_alone())
        };
        self.contacts.iter().filter(is_asked).map(|(place, _)| *place).collect()
    }

    /// Nobody is asked for at `place` any more; a seed still is.
    fn forget_former(&mut self, place: Place) {
        if self.contacts.get(&place).is_some_and(|contact| !contact.is_seed) {
            self.contacts.remove(&place);
        }
    }
}
