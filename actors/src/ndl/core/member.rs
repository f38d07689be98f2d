//! What is known of a node that answers.

use std::net::{Ipv4Addr, SocketAddr};

use sinew_runtime::{tid::Incarnation, time::Time};

use super::{Host, clock::PeerClock, own::Own, pace::Pace, routes::Routes, troubles::Troubles};
use crate::ndl::{
    Progress,
    address::is_same_host,
    datagram::{Announcement, PATHS_MAX},
};

/// Addresses at which a silent member's host is tried, at most: as many as it has routes.
const PROBED_MAX: usize = PATHS_MAX;

/// A node that answers.
#[derive(Debug)]
pub(super) struct Member {
    pub(super) announcement: Announcement,
    /// Where it answered first.
    pub(super) met: SocketAddr,
    /// Where it answers.
    pub(super) routes: Routes,
    /// Where GNCL was told that its listener is, and when.
    pub(super) gncl_told: (Vec<SocketAddr>, Time),
    /// Its last sign of life.
    pub(super) heard: Time,
    /// When it asked us last, or GNCL heard of it last, as far as that was asked; or since when it has been a member.
    pub(super) sign: Time,
    /// Which of the paces it is asked at.
    pub(super) pace: usize,
    /// Answers missed in a row.
    pub(super) missed: u32,
    /// What its host said since it missed the first of them.
    pub(super) host: Option<Host>,
    /// What of it does not get on, as it said last.
    pub(super) progress: Progress,
    /// What of that applications were told.
    pub(super) troubles: Troubles,
    /// The last query of the cycle is not answered yet.
    pub(super) is_awaited: bool,
    pub(super) clock: PeerClock,
    /// When the question was asked that it answered, the latest of them.
    pub(super) answered: Time,
    /// Its connection ended and did not come back yet: then, or it was refused then and answered all the same.
    pub(super) link_broke: Option<Time>,
    /// Until then its connection stands, or is being made again.
    pub(super) link_until: Time,
    /// When its connection was made last, or since when it has been a member.
    pub(super) linked: Time,
    /// Since when it has been a member.
    pub(super) since: Time,
    /// The life before this one whose end is known: neither that one nor one before it comes back.
    pub(super) fence: Option<Incarnation>,
}

impl Member {
    /// Where its GNCL can be reached, the address that it prefers first: at none that leads to this host instead. One that says no other
    /// ones may have set up that they lead to it. // spec: NDL-3.6
    pub(super) fn gncl_addresses(&self, own: &Own) -> Vec<SocketAddr> {
        let (its, ours): (Vec<_>, Vec<_>) =
            self.announced_gncl().into_iter().partition(|at| self.may_be_at(own, *at));
        if its.is_empty() { ours } else { its }
    }

    fn announced_gncl(&self) -> Vec<SocketAddr> {
        let routes = self.routes.places().map(|place| (place.here, place.there));
        self.announcement.gncl_addresses(Some(self.met), routes)
    }

    /// Where its host is tried when it is silent: where its NDL answered last, as its host was there; only where its GNCL is nowhere there at
    /// the others, which may be another host's. // spec: NDL-4.6
    pub(super) fn probed_addresses(&self, own: &Own) -> Vec<SocketAddr> {
        // A route that failed before the others did says nothing of what has happened now.
        let missed = self.routes.iter().map(|route| route.missed).min();
        let last = || self.routes.iter().filter(|route| Some(route.missed) == missed);
        let has_answered = |at: &SocketAddr| last().any(|route| is_same_host(route.place.there, *at));
        let (proven, others): (Vec<_>, Vec<_>) = self.announced_gncl().into_iter().partition(has_answered);
        let mut tried = proven;
        if tried.is_empty() {
            tried = others;
            tried.retain(|at| self.may_be_at(own, *at));
        }
        tried.truncate(PROBED_MAX);
        tried
    }

    /// Whether it is to be counted as lost for its silence. One with several addresses that is asked at one of them alone may only be out
    /// of reach there; as long as its connection stands, it is there. // spec: NDL-4.1, NDL-4.5, NDL-4.7
    pub(super) fn is_silent(&self, now: Time, pace: &Pace, own: &Own) -> bool {
        let Announcement { gncl_further, ndl, ndl6, .. } = &self.announcement;
        let is_another_way = |(ip, port): &(_, u16)| self.may_be_at(own, (Ipv4Addr::from(*ip), *port).into());
        let has_another_way = || {
            ndl.is_empty()
                && ndl6.is_empty()
                && now < self.link_until
                && gncl_further.iter().any(is_another_way)
        };
        self.missed >= pace.missed_max && !has_another_way() && !self.has_given_a_sign(now, pace)
    }
}
