//! Open requests of this node's applications. A reply to such a request is delivered regardless of the rules.
//!
//! The first reply to a request consumes its entry. A message with the reply flag but without an entry is treated as
//! any other message. Otherwise the flag would bypass the list.
//!
//! Guests (users admitted by the access list) have quotas separate from those of the robot's own applications. Neither
//! evicts entries of the other.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::Mutex,
    time::Duration,
};

use sinew_runtime::{
    lock,
    tid::{AppAddress, Tid},
    time::Time,
    wire::Header,
};

/// Shards of the table, each with its own lock. Concurrent requests seldom contend for a lock.
const PARTS: usize = 16;
/// Maximum number of entries of the robot's own applications in one shard. On overflow, the entries that expire first
/// are evicted.
const PART_MAX: usize = 4_096;
/// Maximum number of entries of all guests in one shard, in addition to [`PART_MAX`]. On overflow, the guests' entries
/// that expire first are evicted. It is half of [`PART_MAX`], as guests get half of the application slots.
const GUESTS_MAX: usize = PART_MAX / 2;
/// Maximum number of entries of one own application, and in one shard of all applications of one guest user. On
/// overflow, its own entries that expire first are evicted. An application with a mailbox of the default size cannot
/// wait for more replies.
const EACH_MAX: usize = 1_024;
/// Timeout of an entry if its request has no time to live: the maximum of the field in the header, 71 minutes.
const LONGEST: Duration = Duration::from_micros(u32::MAX as u64);

/// Open requests of this node's applications.
#[derive(Debug, Default)]
pub(super) struct PendingRequests([Mutex<Part>; PARTS]);

#[derive(Debug, Default)]
struct Part {
    /// The guests' applications and their users. The registration limit bounds this map. It is read when an entry is
    /// added, under the lock that is held in any case.
    guests: BTreeMap<AppAddress, u32>,
    of_own: Entries,
    of_guests: Entries,
}

/// A set of entries with its own quota.
#[derive(Debug, Default)]
struct Entries {
    by_requester: BTreeMap<Requester, Quota>,
    by_end: BTreeSet<(Time, Requester, PendingRequest)>,
}

/// The owner of a share of the entries.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Requester {
    /// One of the robot's own applications.
    App(AppAddress),
    /// All applications of this guest user.
    User(u32),
}

#[derive(Debug, Default)]
struct Quota {
    until: BTreeMap<PendingRequest, Time>,
    by_end: BTreeSet<(Time, PendingRequest)>,
}

/// The key of a request. The order by `source` keeps one application's requests adjacent.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct PendingRequest {
    source: AppAddress,
    /// The target of the request.
    target: Tid,
    /// The number of the request.
    number: u64,
}

impl PendingRequests {
    fn part(&self, source: AppAddress) -> &Mutex<Part> {
        &self.0[source.bits() as usize % PARTS]
    }

    /// Adds an entry for a request of an application of this node.
    pub(super) fn note(&self, now: Time, request: &Header) {
        let lasts = match request.time_to_live_us {
            0 => LONGEST,
            micros => Duration::from_micros(u64::from(micros)),
        };
        let (source, target, number) = (request.source.app, request.destination, request.correlation);
        lock(self.part(source)).note(now, PendingRequest { source, target, number }, now + lasts);
    }

    /// Returns whether `reply` answers a request of the application at `target`, and removes the entry. A second reply
    /// does not match.
    pub(super) fn take(&self, now: Time, reply: &Header, target: AppAddress) -> bool {
        let request = PendingRequest { source: target, target: reply.source, number: reply.correlation };
        let until = lock(self.part(target)).remove(request);
        until.is_some_and(|until| now <= until)
    }

    /// Registers a guest of `uid` at this address. Called before the guest can send any request.
    pub(super) fn add_guest(&self, source: AppAddress, uid: u32) {
        let mut part = lock(self.part(source));
        part.forget(source);
        part.guests.insert(source, uid);
    }

    /// Removes the entries of the application at `source` and its guest status. The next application at this address
    /// starts without both.
    pub(super) fn forget(&self, source: AppAddress) {
        let mut part = lock(self.part(source));
        part.forget(source);
        part.guests.remove(&source);
    }
}

impl Part {
    /// Returns the entries that this application's requests belong to, their owner, and the maximum number of entries
    /// there.
    fn share_of(&mut self, source: AppAddress) -> (&mut Entries, Requester, usize) {
        match self.guests.get(&source) {
            Some(uid) => (&mut self.of_guests, Requester::User(*uid), GUESTS_MAX),
            None => (&mut self.of_own, Requester::App(source), PART_MAX),
        }
    }

    fn note(&mut self, now: Time, request: PendingRequest, until: Time) {
        let (entries, requester, max) = self.share_of(request.source);
        entries.remove(requester, request);
        entries.make_room(now, requester, max);
        entries.insert(requester, request, until);
    }

    fn remove(&mut self, request: PendingRequest) -> Option<Time> {
        let (entries, requester, _) = self.share_of(request.source);
        entries.remove(requester, request)
    }

    fn forget(&mut self, source: AppAddress) {
        let (entries, requester, _) = self.share_of(source);
        entries.forget(requester, source);
    }
}

impl Entries {
    /// Evicts the oldest entry of `requester` if it has [`EACH_MAX`], and the oldest of all if there are
    /// `max`.
    fn make_room(&mut self, now: Time, requester: Requester, max: usize) {
        let share = self.by_requester.get(&requester).filter(|share| share.until.len() >= EACH_MAX);
        if let Some((_, first)) = share.and_then(|share| share.by_end.first().copied()) {
            self.remove(requester, first);
        }
        while let Some((end, of, which)) = self.by_end.first().copied()
            && (end < now || self.by_end.len() >= max)
        {
            self.remove(of, which);
        }
    }

    fn insert(&mut self, requester: Requester, request: PendingRequest, until: Time) {
        let share = self.by_requester.entry(requester).or_default();
        share.until.insert(request, until);
        share.by_end.insert((until, request));
        self.by_end.insert((until, requester, request));
    }

    fn remove(&mut self, requester: Requester, request: PendingRequest) -> Option<Time> {
        let share = self.by_requester.get_mut(&requester)?;
        let until = share.until.remove(&request)?;
        share.by_end.remove(&(until, request));
        if share.until.is_empty() {
            self.by_requester.remove(&requester);
        }
        self.by_end.remove(&(until, requester, request));
        Some(until)
    }

    /// Removes the entries of `source` from a share that may also contain entries of other applications.
    fn forget(&mut self, requester: Requester, source: AppAddress) {
        let Some(share) = self.by_requester.get(&requester) else { return };
        let first = PendingRequest { source, target: Tid::from_bits(0), number: 0 };
        let of_source = share.until.range(first..).map(|(request, _)| *request);
        let asked: Vec<_> = of_source.take_while(|request| request.source == source).collect();
        for request in asked {
            self.remove(requester, request);
        }
    }
}

#[cfg(test)]
mod tests {
    use sinew_runtime::{tid::NodeAddress, wire::Kind};

    use super::*;

    const HERE: NodeAddress = NodeAddress::new(0x0a00_0002);
    const THERE: NodeAddress = NodeAddress::new(0x0a00_0004);

    fn request(from: u32, correlation: u64, lasts_us: u32) -> Header {
        let tid = |node, app| Tid::new(node, AppAddress::new(app));
        let mut header = Header::new(Kind::named("test"), tid(HERE, from), tid(THERE, 0x1001));
        (header.correlation, header.time_to_live_us) = (correlation, lasts_us);
        header
    }

    fn is_answered(asked: &PendingRequests, now: Time, request: &Header) -> bool {
        let mut reply = Header::new(request.kind, request.destination, request.source);
        reply.correlation = request.correlation;
        asked.take(now, &reply, request.source.app)
    }

    #[test]
    fn reply_matches_once_from_its_target_before_expiry() {
        let (asked, end) = (PendingRequests::default(), Time::from_nanos(5_000));
        for (number, lasts) in [(1, 5), (2, 5), (3, 0), (4, 5)] {
            asked.note(Time::ZERO, &request(0x1000, number, lasts));
        }
        assert!(is_answered(&asked, end, &request(0x1000, 1, 0)));
        assert!(!is_answered(&asked, end, &request(0x1000, 1, 0)), "the second one");
        assert!(!is_answered(&asked, end + Duration::from_nanos(1), &request(0x1000, 2, 0)), "too late");
        assert!(is_answered(&asked, Time::ZERO + LONGEST, &request(0x1000, 3, 0)));
        let mut other = request(0x1000, 4, 0);
        other.destination.app = AppAddress::new(0x1002);
        assert!(!is_answered(&asked, end, &other), "another application was asked");
        asked.forget(AppAddress::new(0x1000));
        assert!(!is_answered(&asked, end, &request(0x1000, 4, 0)), "the application has ended");
    }

    #[test]
    fn excess_requests_evict_only_their_own_application() {
        let asked = PendingRequests::default();
        asked.note(Time::ZERO, &request(0x1000, 1, 1_000));
        // The application is in the same shard, and sends far more requests than its quota.
        (0..20_000).for_each(|number| asked.note(Time::ZERO, &request(0x1010, number, 2_000)));
        let part = lock(asked.part(AppAddress::new(0x1000)));
        assert_eq!(part.of_own.by_end.len(), 1 + EACH_MAX);
        drop(part);
        assert!(is_answered(&asked, Time::ZERO, &request(0x1000, 1, 0)));
        // Many such applications in that shard are bounded together, too.
        (0..10_u32).for_each(|app| {
            (0..2_000).for_each(|number| asked.note(Time::ZERO, &request(0x1020 + 16 * app, number, 0)));
        });
        let part = lock(asked.part(AppAddress::new(0x1000)));
        assert_eq!(counts(&part.of_own), [PART_MAX; 3]);
    }

    /// Numbers of entries: per requester, by their ends, and per requester by their ends.
    fn counts(entries: &Entries) -> [usize; 3] {
        let of_each =
            |count: fn(&Quota) -> usize| -> usize { entries.by_requester.values().map(count).sum() };
        [of_each(|share| share.until.len()), entries.by_end.len(), of_each(|share| share.by_end.len())]
    }

    /// Applications in the shard of 0x1000, and their users.
    const GUESTS: [(u32, u32); 6] =
        [(0x1010, 1), (0x1020, 2), (0x1030, 3), (0x1040, 4), (0x1050, 5), (0x1060, 5)];

    fn with_guests() -> PendingRequests {
        let asked = PendingRequests::default();
        GUESTS.into_iter().for_each(|(app, uid)| asked.add_guest(AppAddress::new(app), uid));
        asked
    }

    /// The application sends `count` requests that expire later than all others.
    fn asks_without_end(asked: &PendingRequests, app: u32, count: u64) {
        (1_000..1_000 + count).for_each(|number| asked.note(Time::ZERO, &request(app, number, 2_000_000)));
    }

    #[test]
    fn guest_requests_do_not_evict_those_of_own_applications() {
        // Given: a request of the robot's own application, which expires before all others
        let asked = with_guests();
        asked.note(Time::ZERO, &request(0x1000, 1, 1_000));
        // When: five guest users send more requests than fit into the shard
        GUESTS.into_iter().for_each(|(app, _)| asks_without_end(&asked, app, 2_000));
        // Then: its reply matches, and so does that to the next request
        asked.note(Time::ZERO, &request(0x1000, 2, 1_000));
        assert_eq!(counts(&lock(asked.part(AppAddress::new(0x1000))).of_guests), [GUESTS_MAX; 3]);
        let is_answered = |number| is_answered(&asked, Time::ZERO, &request(0x1000, number, 0));
        assert!(is_answered(1) && is_answered(2));
    }

    #[test]
    fn own_requests_do_not_evict_those_of_guests() {
        // Given
        let asked = with_guests();
        asked.note(Time::ZERO, &request(GUESTS[0].0, 1, 1_000));
        // When: five of the robot's own applications send more requests than fit into the shard
        (0..5).for_each(|app| asks_without_end(&asked, 0x2000 + 16 * app, 2_000));
        // Then: the guest's reply matches, and so does that to the next request
        asked.note(Time::ZERO, &request(GUESTS[0].0, 2, 1_000));
        assert_eq!(counts(&lock(asked.part(AppAddress::new(0x1000))).of_own), [PART_MAX; 3]);
        let is_answered = |number| is_answered(&asked, Time::ZERO, &request(GUESTS[0].0, number, 0));
        assert!(is_answered(1) && is_answered(2));
    }

    #[test]
    fn applications_of_one_guest_user_share_one_quota() {
        // Given: a request of another user, and one request each of two applications of one user, all in one shard
        let asked = with_guests();
        [GUESTS[0].0, 0x1050, 0x1060].into_iter().for_each(|app| {
            asked.note(Time::ZERO, &request(app, 1, 1_000));
        });
        // When: one of these two sends as many requests as its user may
        asks_without_end(&asked, 0x1050, EACH_MAX as u64);
        // Then: that evicts the earlier requests of its user, and no others
        let is_answered = |app, number| is_answered(&asked, Time::ZERO, &request(app, number, 0));
        assert_eq!(counts(&lock(asked.part(AppAddress::new(0x1000))).of_guests), [EACH_MAX + 1; 3]);
        assert!(is_answered(GUESTS[0].0, 1) && !is_answered(0x1050, 1) && !is_answered(0x1060, 1));
    }

    #[test]
    fn departed_guest_loses_its_requests_and_guest_status() {
        // Given: two applications of one guest user
        let asked = with_guests();
        [0x1050, 0x1060].into_iter().for_each(|app| asks_without_end(&asked, app, 2));
        // When
        asked.forget(AppAddress::new(0x1050));
        // Then: replies to the other application match, although both share one quota
        let is_answered = |app, number| is_answered(&asked, Time::ZERO, &request(app, number, 0));
        assert!(!is_answered(0x1050, 1_000) && is_answered(0x1060, 1_000));
        // And: the next holder of the address is the robot's own, unless it is registered as a guest
        asks_without_end(&asked, 0x1050, 3);
        assert_eq!(counts(&lock(asked.part(AppAddress::new(0x1000))).of_own), [3; 3]);
        asked.add_guest(AppAddress::new(0x1050), 5);
        assert!(!is_answered(0x1050, 1_000), "a guest receives no reply to its predecessor");
        GUESTS.into_iter().for_each(|(app, _)| asked.forget(AppAddress::new(app)));
        let part = lock(asked.part(AppAddress::new(0x1000)));
        assert_eq!((part.guests.len(), counts(&part.of_own), counts(&part.of_guests)), (0, [0; 3], [0; 3]));
    }
}
