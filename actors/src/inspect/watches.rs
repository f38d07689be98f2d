//! Who watches which application, and what they have not fetched yet.
//!
//! ```text
//!  a sender's thread ── router ── Eyes ──► queue of each watch (bounded; full: counted) ◄── the thread that answers, when it is asked
//! ```
//!
//! A watch lives as long as it is asked for: each question renews its lease. Without one there is no [`Eyes`] in the routing table.

use std::{
    collections::{BTreeMap, VecDeque},
    sync::{
        Arc, Mutex, MutexGuard, TryLockError,
        atomic::{AtomicU64, Ordering},
    },
    time::Duration,
};

use sinew_runtime::{
    router::tap::{Passage, Tap, Way},
    tid::Tid,
    time::Time,
    wire::Header,
};

use super::reports::{SEEN_BYTES_MAX, SEEN_MAX};

/// Watches at once at most, of all watchers together.
pub(super) const WATCHES_MAX: usize = 8;
/// Of these guests have so many at most, together: the rest is there for the robot's own, and for watchers on other nodes.
pub(super) const GUESTS_WATCHES_MAX: usize = WATCHES_MAX / 2;
/// After so long without a question a watch is over.
pub(super) const LEASE: Duration = Duration::from_secs(3);
/// Messages that one watch keeps until they are fetched, at most; further ones are counted.
const KEPT_MAX: usize = 2_048;
/// Bytes of their payloads, at most; further ones are counted.
const KEPT_BYTES_MAX: usize = 1 << 20;
/// A sender looks so often whether it may put a message down; then it goes on, and the message is counted. Well below 10 us.
const TRIES: u32 = 32;

/// What was seen of a message.
#[derive(Debug)]
pub(super) struct Sight {
    pub(super) at: Time,
    pub(super) way: Way,
    pub(super) header: Header,
    /// Length of its payload.
    pub(super) length: usize,
    /// The payload; nothing of a longer one than is shown.
    pub(super) payload: Vec<u8>,
    pub(super) refused: Option<sinew_runtime::outcome::Rejection>,
}

/// What one watcher has not fetched yet of one application.
struct Watch {
    app: Tid,
    ways: Ways,
    queue: Mutex<Queue>,
    /// Since it was fetched last.
    dropped: AtomicU64,
}

/// Which ways somebody watches.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Ways {
    pub(super) received: bool,
    pub(super) sent: bool,
}

#[derive(Default)]
struct Queue {
    sights: VecDeque<Sight>,
    bytes: usize,
}

impl Watch {
    /// Puts a message down, if there is room and nobody else is just doing so. Never waits.
    fn put(&self, passage: &Passage<'_>) {
        let payload = if passage.payload.len() <= SEEN_BYTES_MAX { &passage.payload[..] } else { &[] };
        let Some(mut queue) = self.try_queue() else { return self.drop_one() };
        if queue.sights.len() >= KEPT_MAX || queue.bytes + payload.len() > KEPT_BYTES_MAX {
            drop(queue);
            return self.drop_one();
        }
        queue.bytes += payload.len();
        queue.sights.push_back(Sight {
            at: Time::now(),
            way: passage.way,
            header: *passage.header,
            length: passage.payload.len(),
            payload: payload.to_vec(),
            refused: passage.refused,
        });
    }

    fn drop_one(&self) {
        // SYNC: Relaxed; a count, read by nobody who concludes anything else from it.
        self.dropped.fetch_add(1, Ordering::Relaxed);
    }

    /// Whoever has the lock has it for less than a microsecond, unless its thread is given no CPU: nobody waits for that.
    fn try_queue(&self) -> Option<MutexGuard<'_, Queue>> {
        for _ in 0..TRIES {
            match self.queue.try_lock() {
                Ok(queue) => return Some(queue),
                Err(TryLockError::Poisoned(poisoned)) => return Some(poisoned.into_inner()),
                Err(TryLockError::WouldBlock) => std::hint::spin_loop(),
            }
        }
        None
    }

    /// The oldest ones, up to these bounds; the lock is given back between any two, so that no sender finds it taken for long.
    fn fetch(&self, bytes_max: usize) -> Fetched {
        let mut fetched = Fetched { sights: Vec::new(), dropped: 0, more: false };
        let mut bytes = 0;
        while fetched.sights.len() < SEEN_MAX && bytes < bytes_max {
            let Some(sight) = self.try_queue().and_then(|mut queue| {
                let sight = queue.sights.pop_front()?;
                queue.bytes -= sight.payload.len();
                Some(sight)
            }) else {
                break;
            };
            bytes += sight.payload.len();
            fetched.sights.push(sight);
        }
        fetched.more = self.try_queue().is_none_or(|queue| !queue.sights.is_empty());
        fetched.dropped = self.dropped.swap(0, Ordering::Relaxed);
        fetched
    }
}

/// What a watcher gets.
#[derive(Debug)]
pub(super) struct Fetched {
    pub(super) sights: Vec<Sight>,
    /// Further ones that had no room, since it was fetched last.
    pub(super) dropped: u64,
    /// Whether more wait.
    pub(super) more: bool,
}

/// What stands in the routing table while anybody watches.
struct Eyes(Vec<Arc<Watch>>);

impl Tap for Eyes {
    fn watches(&self, app: Tid) -> bool {
        self.0.iter().any(|watch| watch.app == app)
    }

    fn saw(&self, app: Tid, passage: &Passage<'_>) {
        let wants = |watch: &&Arc<Watch>| {
            let way = match passage.way {
                Way::In => watch.ways.received,
                Way::Out => watch.ways.sent,
            };
            watch.app == app && way
        };
        self.0.iter().filter(wants).for_each(|watch| watch.put(passage));
    }
}

/// All watches of a node; the thread that answers has them.
#[derive(Default)]
pub(super) struct Watches(BTreeMap<(Tid, Tid), (Arc<Watch>, Time)>);

/// What stands in the routing table from now on, if that changes.
pub(super) type NewTap = Option<Option<Arc<dyn Tap>>>;

impl Watches {
    /// What `watcher` has not fetched yet of `app`; begins the watch, or goes on with it. `None` if there are as many as may be.
    pub(super) fn fetch(
        &mut self,
        now: Time,
        (watcher, app): (Tid, Tid),
        ways: Ways,
        bytes_max: usize,
    ) -> (Option<Fetched>, NewTap) {
        let until = now + LEASE;
        let key = (watcher, app);
        if let Some((watch, lease)) = self.0.get_mut(&key).filter(|(watch, _)| watch.ways == ways) {
            *lease = until;
            return (Some(watch.fetch(bytes_max)), None);
        }
        if self.0.len() >= WATCHES_MAX && !self.0.contains_key(&key) {
            return (None, None);
        }
        let watch = Watch { app, ways, queue: Mutex::default(), dropped: AtomicU64::new(0) };
        self.0.insert(key, (Arc::new(watch), until));
        (Some(Fetched { sights: Vec::new(), dropped: 0, more: false }), Some(self.tap()))
    }

    /// Whether guests leave enough to others if this watcher watches this application. Who does already goes on.
    pub(super) fn leaves_room(&self, key: (Tid, Tid), is_guest: impl Fn(Tid) -> bool) -> bool {
        let of_guests = || self.0.keys().filter(|(watcher, _)| is_guest(*watcher)).count();
        self.0.contains_key(&key) || !is_guest(key.0) || of_guests() < GUESTS_WATCHES_MAX
    }

    /// Ends those that nobody has asked for.
    pub(super) fn expire(&mut self, now: Time) -> NewTap {
        let before = self.0.len();
        self.0.retain(|_, (_, until)| *until > now);
        (self.0.len() < before).then(|| self.tap())
    }

    /// When the next one ends, if nobody asks for it.
    pub(super) fn next_end(&self) -> Option<Time> {
        self.0.values().map(|(_, until)| *until).min()
    }

    fn tap(&self) -> Option<Arc<dyn Tap>> {
        let eyes: Vec<_> = self.0.values().map(|(watch, _)| watch.clone()).collect();
        (!eyes.is_empty()).then(|| Arc::new(Eyes(eyes)) as Arc<dyn Tap>)
    }
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;
    use sinew_runtime::{
        tid::{AppAddress, NodeAddress},
        wire::Kind,
    };

    use super::*;

    const BOTH: Ways = Ways { received: true, sent: true };

    fn tid(app: u32) -> Tid {
        Tid::new(NodeAddress::from([127, 0, 0, 1]), AppAddress::new(app))
    }

    fn show(tap: &dyn Tap, way: Way, payload: &Bytes) {
        let header = Header::new(Kind::named("test.any"), tid(0x1001), tid(0x1002));
        tap.saw(tid(0x1001), &Passage { way, header: &header, payload, refused: None });
    }

    /// A watch of 0x1001 by 0x1fff, and its tap.
    fn watch(watches: &mut Watches, ways: Ways) -> Arc<dyn Tap> {
        let (fetched, tap) = watches.fetch(Time::ZERO, (tid(0x1fff), tid(0x1001)), ways, usize::MAX);
        assert!(fetched.is_some_and(|fetched| fetched.sights.is_empty()));
        tap.expect("a new one").expect("somebody watches")
    }

    fn fetch(watches: &mut Watches, bytes_max: usize) -> Fetched {
        watches.fetch(Time::ZERO, (tid(0x1fff), tid(0x1001)), BOTH, bytes_max).0.expect("it is there")
    }

    #[test]
    fn what_has_no_room_is_counted_once_and_the_rest_comes_in_order() {
        // Given
        let mut watches = Watches::default();
        let tap = watch(&mut watches, BOTH);
        for number in 0..KEPT_MAX as u32 + 3 {
            show(&*tap, Way::In, &Bytes::copy_from_slice(&number.to_le_bytes()));
        }
        // When
        let mut got = Vec::new();
        let first = fetch(&mut watches, usize::MAX);
        assert!(first.more && first.sights.len() == SEEN_MAX && first.dropped == 3, "{}", first.dropped);
        got.extend(first.sights);
        loop {
            let next = fetch(&mut watches, usize::MAX);
            assert_eq!(next.dropped, 0, "it was said already");
            got.extend(next.sights);
            if !next.more {
                break;
            }
        }
        // Then
        let numbers: Vec<_> =
            got.iter().map(|s| u32::from_le_bytes(s.payload[..].try_into().unwrap())).collect();
        assert_eq!(numbers, (0..KEPT_MAX as u32).collect::<Vec<_>>());
        // And: there is room again
        show(&*tap, Way::In, &Bytes::new());
        assert_eq!(fetch(&mut watches, usize::MAX).sights.len(), 1);
    }

    #[test]
    fn payloads_are_bounded_in_bytes_and_a_long_one_is_shown_without() {
        let mut watches = Watches::default();
        let tap = watch(&mut watches, BOTH);
        let longest = Bytes::from(vec![0; SEEN_BYTES_MAX]);
        let kept = KEPT_BYTES_MAX / SEEN_BYTES_MAX;
        (0..=kept).for_each(|_| show(&*tap, Way::In, &longest));
        show(&*tap, Way::In, &Bytes::from(vec![0; SEEN_BYTES_MAX + 1]));
        let first = fetch(&mut watches, SEEN_BYTES_MAX + 1);
        assert_eq!((first.sights.len(), first.dropped, first.more), (2, 1, true));
        let mut last = first.sights;
        while let fetched = fetch(&mut watches, usize::MAX)
            && !fetched.sights.is_empty()
        {
            last = fetched.sights;
        }
        let last = last.last().expect("the long one");
        assert_eq!((last.length, last.payload.len()), (SEEN_BYTES_MAX + 1, 0));
    }

    #[test]
    fn a_sender_does_not_wait_for_one_that_stands_still_while_it_puts_its_message_down() {
        let mut watches = Watches::default();
        let tap = watch(&mut watches, BOTH);
        let held = watches.0.values().next().expect("the watch").0.clone();
        let lock = held.queue.lock().expect("nobody has it");
        // Returns, though the lock is taken.
        show(&*tap, Way::In, &Bytes::new());
        drop(lock);
        let fetched = fetch(&mut watches, usize::MAX);
        assert_eq!((fetched.sights.len(), fetched.dropped), (0, 1));
    }

    #[test]
    fn only_the_ways_that_were_asked_for_are_seen() {
        let mut watches = Watches::default();
        let tap = watch(&mut watches, Ways { received: true, sent: false });
        assert!(tap.watches(tid(0x1001)) && !tap.watches(tid(0x1002)));
        show(&*tap, Way::Out, &Bytes::new());
        show(&*tap, Way::In, &Bytes::new());
        let ways = Ways { received: true, sent: false };
        let fetched = watches.fetch(Time::ZERO, (tid(0x1fff), tid(0x1001)), ways, usize::MAX).0;
        let ways: Vec<_> = fetched.expect("it is there").sights.iter().map(|sight| sight.way).collect();
        assert_eq!(ways, [Way::In]);
    }

    #[test]
    fn a_watch_that_nobody_asks_for_is_over_and_there_are_not_more_than_may_be() {
        // Given: as many as may be, of which one is asked for again
        let mut watches = Watches::default();
        let begin = |watches: &mut Watches, now, app| watches.fetch(now, (tid(0x1fff), tid(app)), BOTH, 1);
        let apps = 0x1000..0x1000 + WATCHES_MAX as u32;
        for app in apps {
            assert!(matches!(begin(&mut watches, Time::ZERO, app), (Some(_), Some(Some(_)))));
        }
        assert!(matches!(begin(&mut watches, Time::ZERO, 0x2000), (None, None)));
        let later = Time::ZERO + LEASE / 2;
        assert!(matches!(begin(&mut watches, later, 0x1000), (Some(_), None)));
        assert_eq!(watches.next_end(), Some(Time::ZERO + LEASE));
        // When, then: the others are over first
        let tap = watches.expire(Time::ZERO + LEASE).expect("it changes").expect("one is left");
        assert!(tap.watches(tid(0x1000)) && !tap.watches(tid(0x1001)));
        assert!(watches.expire(Time::ZERO + LEASE).is_none(), "nothing changes");
        assert!(matches!(watches.expire(later + LEASE), Some(None)));
        assert_eq!(watches.next_end(), None);
    }

    // spec: INSPECT-6
    #[test]
    fn guests_leave_half_of_the_watches_to_others_and_go_on_with_those_that_they_have() {
        // Given
        let (own, first, second) = (0x1ffd, 0x1ffe, 0x1fff);
        let is_guest = |watcher: Tid| watcher != tid(own);
        let begin = |watches: &mut Watches, watcher: u32, app: u32| {
            let key = (tid(watcher), tid(app));
            watches.leaves_room(key, is_guest) && watches.fetch(Time::ZERO, key, BOTH, 1).0.is_some()
        };
        let begin_all = |watches: &mut Watches, watcher| {
            let apps = 0x1000..0x1000 + WATCHES_MAX as u32;
            apps.filter(|app| begin(watches, watcher, *app)).count()
        };
        let mut watches = Watches::default();
        // When, then: one leaves what guests have to the other, and both the rest to the robot's own
        assert!(begin(&mut watches, first, 0x1000));
        assert_eq!(begin_all(&mut watches, second), GUESTS_WATCHES_MAX - 1);
        assert!(!begin(&mut watches, first, 0x1001));
        assert_eq!(begin_all(&mut watches, own), WATCHES_MAX - GUESTS_WATCHES_MAX);
        // And: who watches goes on
        assert!(begin(&mut watches, first, 0x1000) && begin(&mut watches, second, 0x1000));
        // And: what is over is there for others
        watches.expire(Time::ZERO + LEASE);
        assert_eq!(begin_all(&mut watches, first), GUESTS_WATCHES_MAX);
    }
}
