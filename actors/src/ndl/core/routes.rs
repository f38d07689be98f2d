//! The ways to one member: from which of this node's addresses to which of the member's, and which of them works best.
//!
//! A member is lost when none of its routes answers; one that fails is replaced by one that is known to work. Who answers somewhere
//! else in a member's name has no route for that: a new one is taken where the member itself says that it is, on a route that there is
//! already, or where no route answers any more.

use std::{
    cmp::Reverse,
    net::{IpAddr, SocketAddr},
    time::Duration,
};

use sinew_runtime::{tid::NodeAddress, time::Time};

use super::{
    Core, Member, Output,
    contact::{Contact, Role},
};
use crate::ndl::{
    address::{is_link_local, seen_from},
    datagram::{Announcement, PATHS_MAX},
};

/// Routes to one member that are asked, at most.
const ROUTES_MAX: usize = PATHS_MAX;
/// Places of one member that are asked at once and have not answered, at most.
const SOUGHT_MAX: usize = 2 * PATHS_MAX;
/// Time between two words to GNCL that a member listens elsewhere.
const MOVE_GAP: Duration = Duration::from_secs(1);
/// How many times shorter the round trip of another route is that goes before one that answers: less is chance.
const MUCH_SHORTER: u32 = 2;
/// Weight of what was known of a round trip, against one of the newest.
const SMOOTHING: u32 = 7;

/// From where to where: an address of this node and one of somebody else.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Place {
    /// Theirs.
    pub(crate) there: SocketAddr,
    /// Ours: of the socket that hears what they send there.
    pub(crate) here: SocketAddr,
}

impl Place {
    /// Whether packets can go there at all: what has a loopback address stays on its host.
    /// What belongs to a link stays on it, and is no way between it and another address: that of the same host is another way.
    pub(super) fn is_a_way(&self) -> bool {
        self.here.is_ipv4() == self.there.is_ipv4()
            && self.here.ip().is_loopback() == self.there.ip().is_loopback()
            && is_link_local(self.here.ip()) == is_link_local(self.there.ip())
            && seen_from(self.here, self.there) == self.there
    }

    /// From an address of ours to one that somebody said, as it is reached from there.
    pub(super) fn between(here: SocketAddr, said: SocketAddr) -> Self {
        Self { there: seen_from(here, said), here }
    }

    /// How many leading bits both addresses share: the more, the likelier they are in one network, with no router between them.
    pub(super) fn kinship(&self) -> u32 {
        match (self.here.ip(), self.there.ip()) {
            (IpAddr::V4(here), IpAddr::V4(there)) => (here.to_bits() ^ there.to_bits()).leading_zeros(),
            // The lower half is the host's own: two with one upper half are on one link, as close as two of IPv4 can be; all others are
            // less so than two of IPv4 in a network of 65,534 hosts, as the networks of a site differ in the last bits of that half.
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
    /// Rounds of questions in a row that it did not answer.
    pub(super) missed: u32,
    /// When the question was asked there that is neither answered nor counted as missed.
    awaited: Option<Time>,
    /// Of the last answers, each weighed against those before it.
    pub(super) round_trip: Option<Duration>,
}

/// All routes to one member.
#[derive(Debug)]
pub(super) struct Routes {
    /// The first is the one that is used. None: each of them began at an address that this node does not have any more.
    all: Vec<Route>,
    /// The one that was used last.
    last: Place,
}

impl Routes {
    pub(super) fn new(place: Place) -> Self {
        Self { all: vec![Route::new(place)], last: place }
    }

    /// The one that is used, or was used last.
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

    /// Whether each of them failed to answer the last question there.
    pub(super) fn have_all_missed(&self) -> bool {
        self.all.iter().all(|route| route.missed > 0)
    }

    pub(super) const fn is_full(&self) -> bool {
        self.all.len() >= ROUTES_MAX
    }

    /// One more, which is used if none else answers.
    pub(super) fn add(&mut self, place: Place) {
        if !self.has(place) && !self.is_full() {
            self.all.push(Route::new(place));
        }
    }

    /// Which route makes way for one more: none while there is room; else one that does not answer, or that leads through more networks
    /// than the new one does, so that what is left leads through as many different ones as there are.
    pub(super) fn makes_way(&self, place: Place) -> MakesWay {
        if !self.is_full() {
            return MakesWay::Nobody;
        }
        let worst = self.all.iter().max_by_key(|route| (route.missed, Reverse(route.place.kinship())));
        let worst = worst.filter(|worst| worst.missed > 0 || worst.place.kinship() < place.kinship());
        worst.map_or(MakesWay::Not, |worst| MakesWay::Route(worst.place))
    }

    /// Whether none but this one has answered of late: each other one has missed so many questions in a row.
    pub(super) fn answers_alone_at(&self, place: Place, missed_max: u32) -> bool {
        self.all.iter().all(|route| route.place == place || route.missed >= missed_max)
    }

    /// Keeps those that are `wanted`; returns the others.
    pub(super) fn keep(&mut self, wanted: impl Fn(&Route) -> bool) -> Vec<Place> {
        self.last = self.best();
        let (kept, gone): (Vec<_>, Vec<_>) = self.all.drain(..).partition(wanted);
        self.all = kept;
        gone.into_iter().map(|route| route.place).collect()
    }

    /// A question of the cycle goes there.
    pub(super) fn asked(&mut self, now: Time, place: Place) {
        if let Some(route) = self.all.iter_mut().find(|route| route.place == place) {
            route.awaited = Some(now);
        }
    }

    /// Each question counts once, when it had half a `period` to be answered: the rounds in which it is asked may not be those that are
    /// counted.
    pub(super) fn count_missed(&mut self, now: Time, period: Duration) {
        for route in &mut self.all {
            if route.awaited.take_if(|asked| now.since(*asked) >= period / 2).is_some() {
                route.missed = route.missed.saturating_add(1);
            }
        }
    }

    /// What came while nobody listened was missed by nobody.
    pub(super) fn forgive(&mut self) {
        self.all.iter_mut().for_each(|route| route.awaited = None);
    }

    /// Somebody answered there.
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

/// What happens when there is one more route.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum MakesWay {
    /// There is room.
    Nobody,
    /// This one goes.
    Route(Place),
    /// All others are better: there is no further one.
    Not,
}

impl Route {
    const fn new(place: Place) -> Self {
        Self { place, missed: 0, awaited: None, round_trip: None }
    }

    fn is_much_shorter_than(&self, other: &Self) -> bool {
        self.round_trip.zip(other.round_trip).is_some_and(|(own, other)| own * MUCH_SHORTER < other)
    }
}

impl Member {
    /// Whether this life of it says itself that it answers there.
    pub(super) fn announces(&self, place: Place) -> bool {
        self.announcement.has_ndl_at(place.there)
    }

    /// Whether a later life that answers there has followed this one: no two processes have one socket address. Where the member did
    /// not say itself that it is there, and is asked elsewhere too, somebody else may be. // spec: NDL-5.3
    pub(super) fn is_followed_at(&self, place: Place) -> bool {
        self.routes.is_only(place) || self.routes.has(place) && self.announces(place)
    }

    /// Whether a place where its life answers becomes a route to it. // spec: NDL-3.3
    fn is_led_to(&self, place: Place) -> bool {
        self.announces(place) && self.routes.makes_way(place) != MakesWay::Not
            || self.routes.have_all_missed()
    }

    /// Whether what is said there of its addresses is its own word: it said before that it is there, or is nowhere else any more, or has
    /// one place alone. Somebody else may have taken a place in a moment in which it answered nowhere. // spec: NDL-3.3
    fn is_believed_at(&self, place: Place, missed_max: u32) -> bool {
        self.announces(place) || self.routes.answers_alone_at(place, missed_max)
    }
}

impl Core {
    /// This node has these addresses for queries now, from the first one of which it is known by other means; nothing that was asked
    /// from another one can be answered.
    pub(crate) fn use_paths(&mut self, now: Time, paths: &[SocketAddr]) {
        let paths = &paths[..paths.len().min(PATHS_MAX)];
        let new: Vec<_> = paths.iter().copied().filter(|path| !self.paths.contains(path)).collect();
        self.has_moved |= self.paths.iter().any(|path| !paths.contains(path));
        self.paths = paths.to_vec();
        self.own.use_paths(paths);
        self.me.announce_ndl(paths);
        self.contacts.retain(|place, _| paths.contains(&place.here));
        for member in self.members.values_mut() {
            member.routes.keep(|route| paths.contains(&route.place.here));
        }
        self.contests.retain(|_, contest| paths.contains(&contest.newcomer.from.here));
        if new.is_empty() || self.rest().due.is_none() {
            return;
        }
        // Where nothing could lead to a seed of IPv6, something may now.
        let is_vain = |place: &Place, contact: &Contact| {
            place.there.is_ipv6() && !place.is_a_way() && matches!(contact.role, Role::Candidate { .. })
        };
        self.contacts.retain(|place, contact| !is_vain(place, contact));
        self.meet_seeds(now);
        if std::mem::take(&mut self.has_moved) {
            // Who has left, and is back, asks for us where we are no more. // spec: NDL-2.5
            self.seek_remembered(now);
        } else {
            self.meet_remembered(now);
        }
        self.look_for_the_gone(now, &new);
        let members: Vec<_> = self.members.keys().copied().collect();
        members.into_iter().for_each(|node| self.seek(now, node));
        let asked: Vec<_> = self.contacts.keys().copied().filter(|place| new.contains(&place.here)).collect();
        asked.into_iter().for_each(|place| self.ask_unless_just_asked(now, place));
        self.ask_the_group(now);
    }

    /// These are asked in any case; what was asked only for being one of those before is not.
    pub(crate) fn use_seeds(&mut self, now: Time, seeds: Vec<SocketAddr>) {
        if self.has_seeds(&seeds) {
            return;
        }
        self.seeds = seeds;
        self.contacts.change_all(|contact| contact.is_seed = false);
        if self.rest().due.is_some() {
            self.meet_seeds(now);
        }
    }

    /// Whether these are the seeds already.
    pub(crate) fn has_seeds(&self, seeds: &[SocketAddr]) -> bool {
        self.seeds == seeds
    }

    /// Seeds are asked from every address of ours.
    pub(super) fn meet_seeds(&mut self, now: Time) {
        let is_own = |seed: &SocketAddr| self.paths.iter().any(|path| path == &seen_from(*path, *seed));
        let seeds: Vec<_> = self.seeds.iter().copied().filter(|seed| !is_own(seed)).collect();
        for seed in seeds {
            for place in self.places_of(seed) {
                self.contacts.get_or_insert_with(place, || Contact::seed(now)).is_seed = true;
            }
        }
    }

    /// From where to ask at an address: wherever packets can go from, and if they can from nowhere, at least so that the system says so.
    pub(super) fn places_of(&self, there: SocketAddr) -> Vec<Place> {
        // Of a link-local one whose link is known only what leads to that link.
        let is_meant = |here: &&SocketAddr| match there {
            SocketAddr::V6(there) if there.scope_id() != 0 => seen_from(**here, there.into()) == there.into(),
            SocketAddr::V4(_) | SocketAddr::V6(_) => true,
        };
        let places = || self.paths.iter().filter(is_meant).map(|here| Place::between(*here, there));
        let ways: Vec<_> = places().filter(Place::is_a_way).collect();
        if ways.is_empty() { places().collect() } else { ways }
    }

    /// Asks a member wherever it says that it is and has not answered.
    pub(super) fn seek(&mut self, now: Time, node: NodeAddress) {
        for place in self.unknown_places_of(node) {
            self.contacts.insert(place, Contact::announced(now));
            self.ask_unless_just_asked(now, place);
        }
    }

    /// The same of all members: who was not in reach may be now. They are asked with all others in this round.
    pub(super) fn seek_all(&mut self, now: Time) {
        let members: Vec<_> = self.members.keys().copied().collect();
        for place in members.into_iter().flat_map(|node| self.unknown_places_of(node)).collect::<Vec<_>>() {
            self.contacts.get_or_insert_with(place, || Contact::announced(now));
        }
    }

    /// Where else to look for a member: not everywhere at once, if it says much, but everywhere in turn.
    fn unknown_places_of(&self, node: NodeAddress) -> Vec<Place> {
        let Some(member) = self.members.get(&node) else { return Vec::new() };
        // One that says nothing of its addresses was somewhere, before our own address went.
        let last = Some(member.routes.best().there).filter(|_| member.routes.iter().next().is_none());
        let pairs = member.announcement.ndl_addresses().chain(last).flat_map(|there| {
            let place = move |here: &SocketAddr| Place::between(*here, there);
            self.paths.iter().map(place)
        });
        let (known, mut unknown): (Vec<_>, Vec<_>) =
            pairs.filter(Place::is_a_way).partition(|place| self.contacts.contains_key(place));
        let is_sought = |place: &&Place| self.contacts.get(place).is_some_and(Contact::is_announced_only);
        let room = SOUGHT_MAX.saturating_sub(known.iter().filter(is_sought).count());
        if unknown.len() > room {
            let turn = self.questions_asked % unknown.len() as u64;
            unknown.rotate_left(usize::try_from(turn).unwrap_or(0));
            unknown.truncate(room);
        }
        unknown
    }

    /// Whether the member's life, which answered there, has a route there, or is given one now.
    pub(super) fn is_routed(&mut self, now: Time, node: NodeAddress, place: Place) -> bool {
        let Some(member) = self.members.get_mut(&node) else { return false };
        if member.routes.has(place) {
            return true;
        }
        if !member.is_led_to(place) {
            return false;
        }
        if !member.announces(place) {
            // It has moved: where it does not say that it is, it is not any more.
            let (announcement, most) = (&member.announcement, ROUTES_MAX - 1);
            let former = member.routes.keep(|route| announcement.has_ndl_at(route.place.there));
            let crowded: Vec<_> = member.routes.places().skip(most).collect();
            member.routes.keep(|route| !crowded.contains(&route.place));
            former.into_iter().chain(crowded).for_each(|place| self.drop_contact(now, place));
        }
        let Some(member) = self.members.get_mut(&node) else { return false };
        match member.routes.makes_way(place) {
            MakesWay::Nobody => {}
            MakesWay::Route(former) => {
                member.routes.keep(|route| route.place != former);
                self.drop_contact(now, former);
            }
            MakesWay::Not => return false,
        }
        if let Some(member) = self.members.get_mut(&node) {
            member.routes.add(place);
        }
        self.contact_at(now, place).role = Role::Member(node);
        self.note_met(node, place);
        true
    }

    /// A member answers where it says that it is: where it does not, it was taken to be for want of anything better.
    pub(super) fn drop_unannounced_routes(&mut self, now: Time, node: NodeAddress, place: Place) {
        let Some(member) = self.members.get_mut(&node) else { return };
        if !member.announces(place) {
            return;
        }
        let announcement = &member.announcement;
        let dropped = member.routes.keep(|route| announcement.has_ndl_at(route.place.there));
        dropped.into_iter().for_each(|place| self.drop_contact(now, place));
    }

    /// What a member says of its addresses, on a route to it. // spec: NDL-3.3
    pub(super) fn note_addresses(&mut self, now: Time, node: NodeAddress, place: Place, said: &Announcement) {
        let Some(member) = self.members.get_mut(&node) else { return };
        if !member.is_believed_at(place, self.paces[member.pace].missed_max) {
            return;
        }
        if member.announcement.note_addresses(said) {
            self.seek(now, node);
        }
    }

    /// Tells GNCL where members listen now that said something else before; of one member once a second at most, whatever it says.
    pub(super) fn tell_moves(&mut self, now: Time) {
        for (node, member) in &mut self.members {
            let (told, at) = &member.gncl_told;
            let gncl = member.gncl_addresses(&self.own);
            // Where nothing of it is known at all, what was known last may still hold.
            if *told != gncl && !gncl.is_empty() && now.since(*at) >= MOVE_GAP {
                member.gncl_told = (gncl.clone(), now);
                let incarnation = member.announcement.incarnation;
                self.outputs.push_back(Output::Moved { node: *node, incarnation, gncl });
            }
        }
    }

    /// Routes that the member does not speak of any more, and does not answer on either, are no routes.
    pub(super) fn drop_former_routes(&mut self, now: Time, at: usize) {
        let missed_max = self.paces[at].missed_max;
        let mut dropped = Vec::new();
        for member in self.members.values_mut().filter(|member| member.pace == at && member.missed == 0) {
            let announcement = &member.announcement;
            let is_wanted =
                |route: &Route| route.missed < missed_max || announcement.has_ndl_at(route.place.there);
            dropped.extend(member.routes.keep(is_wanted));
        }
        dropped.into_iter().for_each(|place| self.drop_contact(now, place));
    }
}
