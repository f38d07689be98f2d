//! The routes to one member, each from a local address to one of the member's, and the selection of the best one.
//!
//! A member is lost when none of its routes answers. A failed route is replaced by one that is known to work.
//! An answer in a member's name from another place makes no route by itself. A new route is added where the
//! member announces it, on an existing route, or when no route answers any more.

use std::{
    cmp::Reverse,
    net::{IpAddr, SocketAddr},
    time::Duration,
};

use sinew_model::{
    address::{is_link_local, seen_from},
    limits::PATHS_MAX,
};
use sinew_runtime::time::Time;

use super::{Member, contact::Contact, contacts::Contacts, local_addresses::LocalAddresses};
use crate::datagram::Announcement;

/// Maximum number of queried routes to one member.
const ROUTES_MAX: usize = PATHS_MAX;
/// Maximum number of places of one member that are queried at once and have not answered.
const SOUGHT_MAX: usize = 2 * PATHS_MAX;
/// Minimum time between two notifications of GNCL that a member listens at other addresses.
const MOVE_GAP: Duration = Duration::from_secs(1);
/// Factor by which another route's round trip must be shorter to replace a route that answers. A smaller
/// difference is noise.
const MUCH_SHORTER: u32 = 2;
/// Weight of the previous round trip, against a weight of one for the newest.
const SMOOTHING: u32 = 7;

/// A pair of a local and a remote address.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Place {
    /// Remote address.
    pub there: SocketAddr,
    /// Local address: that of the socket that receives from `there`.
    pub here: SocketAddr,
}

impl Place {
    /// Returns whether packets can be sent on this place. A loopback address is only reachable on its host. A
    /// link-local address is not used together with another kind of address, because that address of the same
    /// host is another route.
    pub(super) fn is_usable(&self) -> bool {
        self.here.is_ipv4() == self.there.is_ipv4()
            && self.here.ip().is_loopback() == self.there.ip().is_loopback()
            && is_link_local(self.here.ip()) == is_link_local(self.there.ip())
            && seen_from(self.here, self.there) == self.there
    }

    /// Returns the place between a local address and a received one, with the scope as seen from the local address.
    pub(super) fn between(here: SocketAddr, there: SocketAddr) -> Self {
        Self { there: seen_from(here, there), here }
    }

    /// Returns the number of leading bits that both addresses share. The more, the more likely they are in
    /// one network without a router between them.
    pub(super) fn closeness(&self) -> u32 {
        match (self.here.ip(), self.there.ip()) {
            (IpAddr::V4(here), IpAddr::V4(there)) => (here.to_bits() ^ there.to_bits()).leading_zeros(),
            // The lower half is the host's own. Two addresses with one upper half are on one link, as close
            // as two IPv4 addresses can be. All others are less close than two IPv4 addresses in a network of
            // 65,534 hosts. The networks of a site differ in the last bits of the upper half.
            (IpAddr::V6(here), IpAddr::V6(there)) => {
                let shared = (here.to_bits() ^ there.to_bits()).leading_zeros();
                if shared >= 64 { 32 } else { shared / 4 }
            }
            (IpAddr::V4(_), IpAddr::V6(_)) | (IpAddr::V6(_), IpAddr::V4(_)) => 0,
        }
    }
}

/// A place where a member answers, or did.
#[derive(Clone, Debug)]
pub(super) struct Route {
    pub(super) place: Place,
    /// Number of consecutive rounds of queries that were not answered there.
    pub(super) missed: u32,
    /// Send time of the query that is neither answered nor counted as missed.
    awaited: Option<Time>,
    /// Smoothed round trip of the last answers.
    pub(super) round_trip: Option<Duration>,
}

/// All routes to one member.
#[derive(Debug)]
pub(super) struct Routes {
    /// The first route is the used one. If empty, each of them began at an address that this node does not
    /// have any more.
    all: Vec<Route>,
    /// The place that was used last.
    last: Place,
}

impl Routes {
    pub(super) fn new(place: Place) -> Self {
        Self { all: vec![Route::new(place)], last: place }
    }

    /// Returns the place that is used, or was used last.
    pub(super) fn best(&self) -> Place {
        self.all.first().map_or(self.last, |route| route.place)
    }

    pub(super) fn iter(&self) -> impl Iterator<Item = &Route> {
        self.all.iter()
    }

    pub(super) fn places(&self) -> impl Iterator<Item = Place> {
        self.all.iter().map(|route| route.place)
    }

    pub(super) fn has(&self, place: Place) -> bool {
        self.places().any(|known| known == place)
    }

    pub(super) fn is_only(&self, place: Place) -> bool {
        self.has(place) && self.all.len() == 1
    }

    /// Returns whether each route missed its last query.
    pub(super) fn have_all_missed(&self) -> bool {
        self.all.iter().all(|route| route.missed > 0)
    }

    pub(super) const fn is_full(&self) -> bool {
        self.all.len() >= ROUTES_MAX
    }

    /// Adds a route, which is used if no other one answers.
    pub(super) fn add(&mut self, place: Place) {
        if !self.has(place) && !self.is_full() {
            self.all.push(Route::new(place));
        }
    }

    /// Returns the route that is replaced by a new one. While there is room, none is. Otherwise it is a route
    /// that does not answer, or one with more networks on its path than the new one has. So the remaining
    /// routes lead through as many different networks as there are.
    pub(super) fn replaced_by(&self, place: Place) -> Replacement {
        if !self.is_full() {
            return Replacement::None;
        }
        let worst = self.all.iter().max_by_key(|route| (route.missed, Reverse(route.place.closeness())));
        let worst = worst.filter(|worst| worst.missed > 0 || worst.place.closeness() < place.closeness());
        worst.map_or(Replacement::Rejected, |worst| Replacement::Route(worst.place))
    }

    /// Returns whether only this place has answered recently: each other route missed `missed_max` consecutive queries.
    pub(super) fn answers_alone_at(&self, place: Place, missed_max: u32) -> bool {
        self.all.iter().all(|route| route.place == place || route.missed >= missed_max)
    }

    /// Keeps the `wanted` routes, and returns the places of the others.
    pub(super) fn keep(&mut self, wanted: impl Fn(&Route) -> bool) -> Vec<Place> {
        self.last = self.best();
        let (kept, dropped): (Vec<_>, Vec<_>) = self.all.drain(..).partition(wanted);
        self.all = kept;
        dropped.into_iter().map(|route| route.place).collect()
    }

    /// Records that a query of the cycle is sent there.
    pub(super) fn queried(&mut self, now: Time, place: Place) {
        if let Some(route) = self.all.iter_mut().find(|route| route.place == place) {
            route.awaited = Some(now);
        }
    }

    /// Counts each query as missed at most once, after half a `period` without an answer. The rounds of
    /// queries may differ from the rounds that are counted.
    pub(super) fn count_missed(&mut self, now: Time, period: Duration) {
        for route in &mut self.all {
            if route.awaited.take_if(|queried| now.since(*queried) >= period / 2).is_some() {
                route.missed = route.missed.saturating_add(1);
            }
        }
    }

    /// Discards the pending queries after a time without a receiver, so that they do not count as missed.
    pub(super) fn forgive(&mut self) {
        self.all.iter_mut().for_each(|route| route.awaited = None);
    }

    /// Records an answer there.
    pub(super) fn answered(&mut self, place: Place, round_trip: Option<Duration>) {
        let Some(at) = self.all.iter().position(|route| route.place == place) else { return };
        let route = &mut self.all[at];
        (route.missed, route.awaited) = (0, None);
        route.round_trip = match (route.round_trip, round_trip) {
            (Some(known), Some(new)) => Some((known * SMOOTHING + new) / (SMOOTHING + 1)),
            (known, new) => new.or(known),
        };
        let (used, other) = (&self.all[0], &self.all[at]);
        let is_better = at != 0 && (used.missed > 0 || other.is_much_shorter_than(used));
        if is_better {
            self.all.swap(0, at);
            self.last = place;
        }
    }
}

/// The route that makes room for a new one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Replacement {
    /// There is room.
    None,
    /// This route is removed.
    Route(Place),
    /// All other routes are better, and the new one is not added.
    Rejected,
}

/// Whether a member has a route at a place where it answered.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Routed {
    Already,
    Added,
    Rejected,
}

impl Route {
    const fn new(place: Place) -> Self {
        Self { place, missed: 0, awaited: None, round_trip: None }
    }

    fn is_much_shorter_than(&self, other: &Self) -> bool {
        self.round_trip.zip(other.round_trip).is_some_and(|(this, other)| this * MUCH_SHORTER < other)
    }
}

impl Member {
    /// Returns whether this incarnation itself announces that it answers there.
    pub(super) fn announces(&self, place: Place) -> bool {
        self.announcement.has_ndl_at(place.there)
    }

    /// Returns whether an incarnation that answers there has replaced this one: no two processes have one
    /// socket address. If the member has other routes and did not announce this address, another node may be
    /// there. // spec: NDL-5.3
    pub(super) fn is_followed_at(&self, place: Place) -> bool {
        self.routes.is_only(place) || self.routes.has(place) && self.announces(place)
    }

    /// Returns whether a place where the member's incarnation answers becomes a route to it. // spec: NDL-3.3
    fn becomes_route(&self, place: Place) -> bool {
        self.announces(place) && self.routes.replaced_by(place) != Replacement::Rejected
            || self.routes.have_all_missed()
    }

    /// Returns whether an announcement of addresses at this place is trusted as the member's own. The member
    /// announced the place before, or does not answer anywhere else any more, or has only this place. Another
    /// node may have taken a place while the member answered nowhere. // spec: NDL-3.3
    fn is_trusted_at(&self, place: Place, missed_max: u32) -> bool {
        self.announces(place) || self.routes.answers_alone_at(place, missed_max)
    }

    /// Adds a route at a place where the member's incarnation answered, if it gets one. The places of routes
    /// that make room for it are added to `dropped`.
    pub(super) fn route_at(&mut self, place: Place, dropped: &mut Vec<Place>) -> Routed {
        if self.routes.has(place) {
            return Routed::Already;
        }
        if !self.becomes_route(place) {
            return Routed::Rejected;
        }
        if !self.announces(place) {
            // The member has moved: addresses that it does not announce are obsolete.
            dropped.extend(self.drop_unannounced_routes());
            let crowded: Vec<_> = self.routes.places().skip(ROUTES_MAX - 1).collect();
            dropped.extend(self.routes.keep(|route| !crowded.contains(&route.place)));
        }
        match self.routes.replaced_by(place) {
            Replacement::None => {}
            Replacement::Route(former) => dropped.extend(self.routes.keep(|route| route.place != former)),
            Replacement::Rejected => return Routed::Rejected,
        }
        self.routes.add(place);
        Routed::Added
    }

    /// Removes the routes that the member does not announce, and returns their places.
    pub(super) fn drop_unannounced_routes(&mut self) -> Vec<Place> {
        let announcement = &self.announcement;
        self.routes.keep(|route| announcement.has_ndl_at(route.place.there))
    }

    /// Removes the routes that the member no longer announces and on which it does not answer, and returns
    /// their places.
    pub(super) fn drop_former_routes(&mut self, missed_max: u32) -> Vec<Place> {
        let announcement = &self.announcement;
        self.routes.keep(|route| route.missed < missed_max || announcement.has_ndl_at(route.place.there))
    }

    /// Updates the addresses from an announcement received on a route. Returns whether they have changed.
    /// spec: NDL-3.3
    pub(super) fn announces_anew(&mut self, place: Place, received: &Announcement, missed_max: u32) -> bool {
        self.is_trusted_at(place, missed_max) && self.announcement.note_addresses(received)
    }

    /// Returns the listening addresses if GNCL is to be notified that they have changed, at most once a second.
    pub(super) fn take_move(&mut self, now: Time, local: &LocalAddresses) -> Option<Vec<SocketAddr>> {
        let (reported, at) = &self.gncl_reported;
        let gncl = self.gncl_addresses(local);
        // If none of its addresses is known, the last known ones may still be valid.
        let is_due = *reported != gncl && !gncl.is_empty() && now.since(*at) >= MOVE_GAP;
        if !is_due {
            return None;
        }
        self.gncl_reported = (gncl.clone(), now);
        Some(gncl)
    }

    /// Returns further places to query for the member. If it announces many, they are queried in turn, not all
    /// at once.
    pub(super) fn unknown_places(&self, local: &LocalAddresses, contacts: &Contacts) -> Vec<Place> {
        // A member that announces no addresses was at its last place before the local address was removed.
        let last = Some(self.routes.best().there).filter(|_| self.routes.iter().next().is_none());
        let pairs = self.announcement.ndl_addresses().chain(last).flat_map(|there| {
            let place = move |here: &SocketAddr| Place::between(*here, there);
            local.paths().iter().map(place)
        });
        let (known, mut unknown): (Vec<_>, Vec<_>) =
            pairs.filter(Place::is_usable).partition(|place| contacts.contains_key(place));
        let is_sought = |place: &&Place| contacts.get(place).is_some_and(Contact::is_announced_only);
        let room = SOUGHT_MAX.saturating_sub(known.iter().filter(is_sought).count());
        if unknown.len() > room {
            let turn = contacts.turn(unknown.len());
            unknown.rotate_left(turn);
            unknown.truncate(room);
        }
        unknown
    }
}
