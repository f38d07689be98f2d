//! The nodes that answer.

use std::{
    collections::BTreeMap,
    net::SocketAddr,
    ops::{Deref, DerefMut},
    time::Duration,
};

use sinew_model::facts::NodeEvent;
use sinew_runtime::{
    tid::{Incarnation, NodeAddress},
    time::Time,
};

use super::{
    Member, Output, Place,
    local_addresses::LocalAddresses,
    paces::{Pace, Paces},
    troubles::stalled,
};
use crate::datagram::Announcement;

/// The sender of a datagram, if it is not forged.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Sender {
    /// A member's incarnation, on a known route to it.
    MemberOnRoute,
    /// A member's incarnation, at another address that it announces.
    MemberAtAnnounced,
    /// Any other sender.
    Stranger,
}

/// The members by their node addresses, `most` at most. They can be read and changed as the map.
#[derive(Debug)]
pub(super) struct Members {
    all: BTreeMap<NodeAddress, Member>,
    most: usize,
}

impl Members {
    /// Creates an empty table for `most` members.
    pub(super) const fn new(most: usize) -> Self {
        Self { all: BTreeMap::new(), most }
    }

    pub(super) fn is_full(&self) -> bool {
        self.len() >= self.most
    }

    /// Returns the member at `node`, if it has this incarnation.
    pub(super) fn incarnation_mut(
        &mut self,
        node: NodeAddress,
        incarnation: Incarnation,
    ) -> Option<&mut Member> {
        self.get_mut(&node).filter(|member| member.announcement.incarnation == incarnation)
    }

    /// Returns the members at the pace with this index.
    pub(super) fn at_pace(&mut self, at: usize) -> impl Iterator<Item = (NodeAddress, &mut Member)> {
        let members = self.iter_mut().filter(move |(_, member)| member.pace == at);
        members.map(|(node, member)| (*node, member))
    }

    /// Returns the sender of a message received at `from`. It may receive from this node on fewer routes than
    /// this node receives from it.
    pub(super) fn sender(&self, from: Place, announcement: &Announcement) -> Sender {
        let member = self.get(&announcement.node);
        match member.filter(|member| member.announcement.is_same_incarnation(announcement)) {
            Some(member) if member.routes.has(from) => Sender::MemberOnRoute,
            Some(member) if member.announces(from) => Sender::MemberAtAnnounced,
            Some(_) | None => Sender::Stranger,
        }
    }

    /// Voids pending queries after a time without a receiver. Datagrams missed meanwhile are not the peers' fault.
    pub(super) fn forgive(&mut self, paces: &Paces) {
        for member in self.values_mut() {
            member.is_awaited = false;
            member.routes.forgive();
            member.missed = member.missed.min(paces.of(member).missed_max - 1);
        }
    }

    /// Counts the missed answers at the end of a cycle.
    pub(super) fn count_missed(&mut self, now: Time, at: usize, period: Duration) {
        for (_, member) in self.at_pace(at) {
            member.routes.count_missed(now, period);
            member.missed += u32::from(member.is_awaited);
        }
    }

    /// Returns the members at a pace that count as lost for their silence.
    pub(super) fn silent(
        &self,
        now: Time,
        (at, pace): (usize, &Pace),
        local: &LocalAddresses,
    ) -> Vec<NodeAddress> {
        let is_silent = |member: &Member| member.pace == at && member.is_silent(now, pace, local);
        self.iter().filter(|(_, member)| is_silent(member)).map(|(node, _)| *node).collect()
    }

    /// Returns the probes of the hosts of members that missed an answer, so that the reason is known when the
    /// member is lost. // spec: NDL-4.6
    pub(super) fn probes(
        &self,
        now: Time,
        (at, pace): (usize, &Pace),
        local: &LocalAddresses,
    ) -> impl Iterator<Item = Output> {
        // A result after the next check of the timer may be too late.
        let within = pace.period * 3 / 4;
        let suspected = self.iter().filter(move |(_, member)| member.pace == at && member.missed > 0);
        suspected.map(move |(node, member)| Output::Probe {
            node: *node,
            incarnation: member.announcement.incarnation,
            to: member.probed_addresses(local),
            within,
            requested: now,
        })
    }

    /// Records that all members at a pace are queried in this cycle. That includes members that cannot be
    /// queried because no local address leads to them any more.
    pub(super) fn await_all(&mut self, at: usize) {
        self.at_pace(at).for_each(|(_, member)| member.is_awaited = true);
    }

    /// Records that the members at a pace are queried in this cycle, and returns their places. Returns `None`
    /// if there are no members.
    pub(super) fn query_all(&mut self, now: Time, at: usize) -> Option<Vec<Place>> {
        let mut all = None;
        for (_, member) in self.at_pace(at) {
            member.is_awaited = true;
            for place in member.routes.places().collect::<Vec<_>>() {
                member.routes.queried(now, place);
                all.get_or_insert_with(Vec::new).push(place);
            }
            all.get_or_insert_with(Vec::new);
        }
        all
    }

    /// Removes the routes from local addresses that are not in use any more.
    pub(super) fn use_paths(&mut self, paths: &[SocketAddr]) {
        for member in self.values_mut() {
            member.routes.keep(|route| paths.contains(&route.place.here));
        }
    }

    /// Removes the routes that the members at a pace no longer announce and on which they do not answer.
    /// Returns their places.
    pub(super) fn drop_former_routes(&mut self, at: usize, missed_max: u32) -> Vec<Place> {
        let answering = self.at_pace(at).filter(|(_, member)| member.missed == 0);
        answering.flat_map(|(_, member)| member.drop_former_routes(missed_max)).collect()
    }

    /// Returns the reports to GNCL of members with changed listening addresses.
    pub(super) fn moves(&mut self, now: Time, local: &LocalAddresses) -> impl Iterator<Item = Output> {
        self.iter_mut().filter_map(move |(node, member)| {
            let gncl = member.take_move(now, local)?;
            Some(Output::Moved { node: *node, incarnation: member.announcement.incarnation, gncl })
        })
    }

    /// Records that the connections that `is_connected` denies have ended. Returns their members.
    pub(super) fn check_links(
        &mut self,
        now: Time,
        is_connected: impl Fn(NodeAddress, Incarnation) -> bool,
    ) -> Vec<NodeAddress> {
        let mut broken = Vec::new();
        for (node, member) in &mut self.all {
            if member.is_linked() && !is_connected(*node, member.announcement.incarnation) {
                member.link_ended(now);
                broken.push(*node);
            }
        }
        broken
    }

    /// Returns the events that notify a new subscriber of the present members and of their stalled parts.
    pub(super) fn events(&self) -> impl Iterator<Item = NodeEvent> {
        self.values().flat_map(|member| {
            let Announcement { node, incarnation, ref name, .. } = member.announcement;
            let found = NodeEvent::NodeFound { node, incarnation, name: name.clone() };
            let troubles = member.troubles.parts().map(|part| stalled(&member.announcement, part));
            std::iter::once(found).chain(troubles)
        })
    }

    /// Returns the leaves to send to each member.
    pub(super) fn leaves(&self) -> impl Iterator<Item = Output> {
        self.iter()
            .flat_map(|(node, member)| member.routes.places().map(|to| Output::SendLeave { to, node: *node }))
    }
}

impl Deref for Members {
    type Target = BTreeMap<NodeAddress, Member>;

    fn deref(&self) -> &Self::Target {
        &self.all
    }
}

impl DerefMut for Members {
    fn deref_mut(&mut self) -> &mut Self::Target {
        &mut self.all
    }
}
