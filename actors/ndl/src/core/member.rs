//! The state of a node that answers.

use std::{
    net::{Ipv4Addr, SocketAddr},
    time::Duration,
};

use sinew_model::{address::is_same_host, limits::PATHS_MAX, progress::Progress};
use sinew_runtime::{tid::Incarnation, time::Time};

use super::{
    Host,
    clock::PeerClock,
    local_addresses::LocalAddresses,
    paces::Pace,
    routes::{Place, Routes},
    troubles::Troubles,
};
use crate::datagram::Announcement;

/// Maximum number of addresses at which a silent member's host is probed: the maximum number of routes.
const PROBED_MAX: usize = PATHS_MAX;

/// Time in which a broken connection may be restored at another address.
const LINK_GRACE: Duration = Duration::from_secs(1);

/// A node that answers.
#[derive(Debug)]
pub(super) struct Member {
    pub(super) announcement: Announcement,
    /// Address of the first answer.
    pub(super) found_at: SocketAddr,
    /// Routes on which the member answers.
    pub(super) routes: Routes,
    /// The listening addresses last sent to GNCL, and the time of that.
    pub(super) gncl_reported: (Vec<SocketAddr>, Time),
    /// Time of its last sign of life.
    pub(super) last_seen: Time,
    /// Time of its last query or of GNCL's last receipt from it, as far as known. Initially the time at which
    /// it became a member.
    pub(super) last_hint: Time,
    /// Index of the pace at which it is queried.
    pub(super) pace: usize,
    /// Number of consecutive missed answers.
    pub(super) missed: u32,
    /// Result of the probes of its host since the first missed answer.
    pub(super) host: Option<Host>,
    /// Last report of the member's stalled parts.
    pub(super) progress: Progress,
    /// The stalled parts that applications were notified of.
    pub(super) troubles: Troubles,
    /// The last query of the cycle is not answered yet.
    pub(super) is_awaited: bool,
    pub(super) clock: PeerClock,
    /// Latest send time of a query that it answered.
    pub(super) answered: Time,
    /// Time at which its connection ended, if it was not restored since. Or the time at which a connection
    /// was refused although the member answered.
    pub(super) link_broke: Option<Time>,
    /// Time until which its connection is established, or is being restored.
    pub(super) link_until: Time,
    /// Time at which its connection was last made, or at which it became a member.
    pub(super) linked_at: Time,
    /// Time since which it has been a member.
    pub(super) since: Time,
    /// The previous incarnation, after its known end. Neither this one nor an earlier one returns.
    pub(super) fence: Option<Incarnation>,
}

impl Member {
    /// Creates a member that has just answered at `place`, and is queried at the `pace` with this index.
    pub(super) fn new(now: Time, announcement: Announcement, place: Place, pace: usize) -> Self {
        Self {
            announcement,
            found_at: place.there,
            routes: Routes::new(place),
            gncl_reported: (Vec::new(), now),
            last_seen: now,
            last_hint: now,
            pace,
            missed: 0,
            host: None,
            progress: Progress::default(),
            troubles: Troubles::default(),
            is_awaited: false,
            clock: PeerClock::default(),
            answered: Time::ZERO,
            link_broke: None,
            link_until: Time::ZERO,
            linked_at: now,
            since: now,
            fence: None,
        }
    }

    /// Records an answer at `place` to a query sent at `queried`.
    pub(super) fn answers(&mut self, now: Time, place: Place, queried: Time, round_trip: Option<Duration>) {
        (self.last_seen, self.missed, self.host, self.is_awaited) = (now, 0, None, false);
        self.answered = self.answered.max(queried);
        self.routes.answered(place, round_trip);
    }

    /// Records that its connection was made. It was alive just now, so its host no longer refuses
    /// connections. // spec: NDL-4.7
    pub(super) const fn link_made(&mut self, now: Time) {
        (self.link_broke, self.link_until, self.host) = (None, Time::MAX, None);
        (self.last_hint, self.last_seen, self.linked_at) = (now, now, now);
    }

    /// Records that its connection ended.
    pub(super) fn link_ended(&mut self, now: Time) {
        (self.link_broke, self.link_until) = (Some(now), now + LINK_GRACE);
    }

    /// Returns whether it has had a connection.
    pub(super) const fn has_been_linked(&self) -> bool {
        !matches!(self.link_until, Time::ZERO)
    }

    /// Records the result of its host's probe. A result from before its last connection was made says nothing
    /// about later events.
    pub(super) fn host_probed(&mut self, host: Host, requested: Time) {
        if self.missed > 0 && requested >= self.linked_at {
            self.host = Some(host);
        }
    }

    /// Returns whether the member answers from this host.
    fn is_here(&self, local: &LocalAddresses) -> bool {
        self.routes.places().any(|place| local.has(place.there))
    }

    /// Returns whether `address` can lead to the member. An address that this host has, too, leads to this host.
    fn may_be_at(&self, local: &LocalAddresses, address: SocketAddr) -> bool {
        !local.has(address) || self.is_here(local)
    }

    /// Returns the addresses at which its GNCL can be reached, the preferred one first. Addresses that lead
    /// to this host instead are omitted. They are kept if there are no others, because they may be forwarded
    /// to the member on purpose. // spec: NDL-3.6
    pub(super) fn gncl_addresses(&self, local: &LocalAddresses) -> Vec<SocketAddr> {
        let (its, ours): (Vec<_>, Vec<_>) =
            self.announced_gncl().into_iter().partition(|at| self.may_be_at(local, *at));
        if its.is_empty() { ours } else { its }
    }

    fn announced_gncl(&self) -> Vec<SocketAddr> {
        let routes = self.routes.places().map(|place| (place.here, place.there));
        self.announcement.gncl_addresses(Some(self.found_at), routes)
    }

    /// Returns the addresses at which its host is probed when it is silent: those of its last answering
    /// routes, since its host was there. The other addresses, which may be another host's, are only used if
    /// its GNCL listens at none of the former. // spec: NDL-4.6
    pub(super) fn probed_addresses(&self, local: &LocalAddresses) -> Vec<SocketAddr> {
        // A route that failed before the others says nothing about the present.
        let missed = self.routes.iter().map(|route| route.missed).min();
        let last = || self.routes.iter().filter(|route| Some(route.missed) == missed);
        let has_answered = |at: &SocketAddr| last().any(|route| is_same_host(route.place.there, *at));
        let (answering, others): (Vec<_>, Vec<_>) = self.announced_gncl().into_iter().partition(has_answered);
        let mut tried = answering;
        if tried.is_empty() {
            tried = others;
            tried.retain(|at| self.may_be_at(local, *at));
        }
        tried.truncate(PROBED_MAX);
        tried
    }

    /// Returns whether it counts as lost for its silence. A member with several addresses that is queried at
    /// only one of them may just be unreachable there. While its connection is established, it is present.
    /// spec: NDL-4.1, NDL-4.5, NDL-4.7
    pub(super) fn is_silent(&self, now: Time, pace: &Pace, local: &LocalAddresses) -> bool {
        let Announcement { gncl_further, ndl, ndl6, .. } = &self.announcement;
        let is_another_way =
            |(ip, port): &(_, u16)| self.may_be_at(local, (Ipv4Addr::from(*ip), *port).into());
        let has_another_way = || {
            ndl.is_empty()
                && ndl6.is_empty()
                && now < self.link_until
                && gncl_further.iter().any(is_another_way)
        };
        self.missed >= pace.missed_max && !has_another_way() && !self.is_hinted_alive(now, pace)
    }
}
