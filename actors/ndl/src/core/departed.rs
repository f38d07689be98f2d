//! Departed nodes. Their last incarnations bar earlier ones, and their addresses are still queried,
//! because they may return.

use std::{collections::BTreeMap, net::SocketAddr, ops::Deref, time::Duration};

use sinew_model::facts::LossReason;
use sinew_runtime::{
    tid::{Incarnation, NodeAddress},
    time::Time,
};

use super::{Member, Place, contacts::Contacts};
use crate::datagram::Announcement;

/// Minimum time after the loss of an incarnation in which no earlier one replaces it.
const EARLIER_BARRED: Duration = Duration::from_secs(15);

/// The time for which an incarnation has been silent.
#[derive(Clone, Copy, Debug)]
pub(super) struct Silence {
    pub(super) lasts: Duration,
    /// Loss bound: time after the last sign of life within which a loss is known.
    pub(super) bound: Duration,
}

impl Silence {
    /// Returns the duration and the bound in microseconds, as events state them.
    pub(super) fn micros(self) -> (u64, u64) {
        let micros = |time: Duration| u64::try_from(time.as_micros()).unwrap_or(u64::MAX);
        (micros(self.lasts), micros(self.bound))
    }
}

/// The last incarnation of a departed node.
#[derive(Debug)]
pub(super) struct DepartedNode {
    since: Time,
    /// Time of the last sign of life.
    last_seen: Time,
    /// Time after `last_seen` within which its loss was to be known.
    bound: Duration,
    /// The node announced its end and is not queried any more.
    has_left: bool,
    /// Places at which it was queried.
    places: Vec<Place>,
    incarnation: Incarnation,
    boot_nonce: u64,
}

impl DepartedNode {
    /// Returns how long the node has been silent, before its end and since.
    pub(super) const fn silence(&self, now: Time) -> Silence {
        Silence { lasts: now.since(self.last_seen), bound: self.bound }
    }

    /// Returns whether `place` is queried because the node has departed.
    pub(super) fn is_queried_at(&self, place: &Place) -> bool {
        !self.has_left && self.places.contains(place)
    }

    fn is(&self, announcement: &Announcement) -> bool {
        (self.incarnation, self.boot_nonce) == (announcement.incarnation, announcement.boot_nonce)
    }
}

/// How an incarnation relates to the departed one of its node.
#[derive(Clone, Copy, Debug)]
pub(super) enum Return {
    /// The node is not known as departed, or is in the same incarnation.
    Same,
    /// The incarnation is later than this one.
    Later(Incarnation, Silence),
    /// The incarnation is earlier than this one, which does not bar it any more.
    Earlier(Incarnation, Silence),
    /// The incarnation is barred by this later one.
    Barred(Incarnation),
}

/// The departed nodes, `most` at most. The one that departed first is evicted.
#[derive(Debug)]
pub(super) struct Departed {
    all: BTreeMap<NodeAddress, DepartedNode>,
    most: usize,
}

impl Departed {
    /// Creates an empty table for `most` nodes.
    pub(super) const fn new(most: usize) -> Self {
        Self { all: BTreeMap::new(), most }
    }

    /// Keeps the last incarnation of a lost node, so that an earlier one never returns. Returns the evicted
    /// node, if any. // spec: NDL-7.1
    pub(super) fn insert(
        &mut self,
        now: Time,
        member: &Member,
        bound: Duration,
        why: &LossReason,
    ) -> Option<(NodeAddress, DepartedNode)> {
        let evicted = if self.len() >= self.most { self.take_oldest() } else { None };
        let Announcement { node, incarnation, boot_nonce, .. } = member.announcement;
        let mut places: Vec<_> = member.routes.places().collect();
        if places.is_empty() {
            places.push(member.routes.best());
        }
        let (since, last_seen, has_left) = (now, member.last_seen, why.is_announced());
        let departed = DepartedNode { since, last_seen, bound, has_left, places, incarnation, boot_nonce };
        self.all.insert(node, departed);
        evicted
    }

    fn take_oldest(&mut self) -> Option<(NodeAddress, DepartedNode)> {
        let oldest = self.all.iter().min_by_key(|(_, departed)| departed.since).map(|(node, _)| *node)?;
        self.all.remove_entry(&oldest)
    }

    pub(super) fn remove(&mut self, node: NodeAddress) -> Option<DepartedNode> {
        self.all.remove(&node)
    }

    /// Returns how an incarnation that answered relates to the departed one of its node. `bound` is the loss bound.
    ///
    /// An earlier incarnation is accepted after a while, since its host's clock may have restarted. By then a
    /// process that was only frozen or cut off has found a later one, if there is one (NDL-5.7).
    // spec: NDL-5.2
    pub(super) fn returns(&self, now: Time, claimed: &Announcement, bound: Duration) -> Return {
        let Some(departed) = self.get(&claimed.node) else { return Return::Same };
        let (last, silence) = (departed.incarnation, departed.silence(now));
        if claimed.incarnation > last {
            Return::Later(last, silence)
        } else if departed.is(claimed) {
            Return::Same
        } else if now.since(departed.since) >= EARLIER_BARRED.max(bound * 2) {
            Return::Earlier(last, silence)
        } else {
            Return::Barred(last)
        }
    }

    /// Returns the places to query for lost nodes from new local addresses, from which they may be reachable.
    /// Nodes that left are not searched for.
    pub(super) fn places_from(&self, new: &[SocketAddr]) -> Vec<(Place, NodeAddress)> {
        let lost = self.iter().filter(|(_, departed)| !departed.has_left);
        let at = lost.flat_map(|(node, departed)| departed.places.iter().map(|place| (*node, place.there)));
        let at =
            at.flat_map(|(node, there)| new.iter().map(move |here| (Place::between(*here, there), node)));
        at.filter(|(place, _)| place.is_usable()).collect()
    }

    /// Returns whether this is the last incarnation of a lost node, which is still queried at its place.
    pub(super) fn is_last_at(&self, place: Place, announcement: &Announcement, contacts: &Contacts) -> bool {
        let Some(departed) = self.get(&announcement.node) else { return false };
        let is_queried = contacts.get(&place).is_some_and(|contact| contact.is_former_of(announcement.node));
        // A node announces its leave on each of its routes. This node may not have known one of them.
        let is_announced = announcement.has_ndl_at(place.there)
            && departed.places.iter().any(|known| announcement.has_ndl_at(known.there));
        departed.is(announcement) && (is_queried || is_announced)
    }

    /// Stops the search for a lost node that announces its end.
    pub(super) fn left(&mut self, node: NodeAddress) {
        if let Some(departed) = self.all.get_mut(&node) {
            departed.has_left = true;
        }
    }
}

impl Deref for Departed {
    type Target = BTreeMap<NodeAddress, DepartedNode>;

    fn deref(&self) -> &Self::Target {
        &self.all
    }
}
