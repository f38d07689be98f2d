//! The watches on applications, and the messages that their watchers have not fetched yet.
//!
//! ```text
//!  a sender's thread ── router ── WatchTap ──► queue of each watch (bounded; full: counted) ◄── the thread that answers, when it is asked
//! ```
//!
//! A watch lives as long as its watcher asks: each question renews its lease. Without a watch there is no
//! [`WatchTap`] in the routing table.

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

/// Maximum number of watches, over all watchers.
pub(super) const WATCHES_MAX: usize = 8;
/// Maximum number of watches of guests together: the rest is reserved for the robot's own user and for
/// watchers on other nodes.
pub(super) const GUESTS_WATCHES_MAX: usize = WATCHES_MAX / 2;
/// Time without a question after which a watch ends.
pub(super) const LEASE: Duration = Duration::from_secs(3);
/// Maximum number of messages that one watch keeps until they are fetched; further ones are counted.
const KEPT_MAX: usize = 2_048;
/// Maximum bytes of their payloads; further ones are counted.
const KEPT_BYTES_MAX: usize = 1 << 20;
/// Number of attempts of a sender to record a message; after them it continues, and the message is counted.
/// Well below 10 us.
const ATTEMPTS_MAX: u32 = 32;

/// The recorded data of a message.
#[derive(Debug)]
pub(super) struct Observed {
    pub(super) at: Time,
    pub(super) way: Way,
    pub(super) header: Header,
    /// Length of its payload.
    pub(super) length: usize,
    /// The payload; empty if it is longer than the displayed maximum.
    pub(super) payload: Vec<u8>,
    pub(super) refused: Option<sinew_runtime::outcome::Rejection>,
}

/// The messages of one application that one watcher has not fetched yet.
struct TrafficWatch {
    app: Tid,
    directions: Directions,
    queue: Mutex<Queue>,
    /// Number of dropped messages since the last fetch.
    dropped: AtomicU64,
}

/// The directions that are watched.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Directions {
    pub(super) received: bool,
    pub(super) sent: bool,
}

#[derive(Default)]
struct Queue {
    messages: VecDeque<Observed>,
    bytes: usize,
}

impl TrafficWatch {
    /// Records a message, if there is room and no other thread is recording one. Never waits.
    fn put(&self, passage: &Passage<'_>) {
        let payload = if passage.payload.len() <= SEEN_BYTES_MAX { &passage.payload[..] } else { &[] };
        let Some(mut queue) = self.try_queue() else { return self.count_dropped(1) };
        if queue.messages.len() >= KEPT_MAX || queue.bytes + payload.len() > KEPT_BYTES_MAX {
            drop(queue);
            return self.count_dropped(1);
        }
        queue.bytes += payload.len();
        queue.messages.push_back(Observed {
            at: Time::now(),
            way: passage.way,
            header: *passage.header,
            length: passage.length,
            payload: payload.to_vec(),
            refused: passage.refused,
        });
    }

    fn count_dropped(&self, messages: u64) {
        // SYNC: Relaxed; a counter on which no other data depends.
        self.dropped.fetch_add(messages, Ordering::Relaxed);
    }

    /// Tries to take the lock. A thread holds it for less than a microsecond, unless it is preempted; no
    /// sender waits for that.
    fn try_queue(&self) -> Option<MutexGuard<'_, Queue>> {
        for _ in 0..ATTEMPTS_MAX {
            match self.queue.try_lock() {
                Ok(queue) => return Some(queue),
                Err(TryLockError::Poisoned(poisoned)) => return Some(poisoned.into_inner()),
                Err(TryLockError::WouldBlock) => std::hint::spin_loop(),
            }
        }
        None
    }

    /// Returns the oldest messages, up to these bounds. The lock is released between any two, so that no
    /// sender finds it taken for long.
    fn fetch(&self, bytes_max: usize) -> Fetched {
        let mut fetched = Fetched { messages: Vec::new(), dropped: 0, more: false };
        let mut bytes = 0;
        while fetched.messages.len() < SEEN_MAX && bytes < bytes_max {
            let Some(message) = self.try_queue().and_then(|mut queue| {
                let message = queue.messages.pop_front()?;
                queue.bytes -= message.payload.len();
                Some(message)
            }) else {
                break;
            };
            bytes += message.payload.len();
            fetched.messages.push(message);
        }
        fetched.more = self.try_queue().is_none_or(|queue| !queue.messages.is_empty());
        fetched.dropped = self.dropped.swap(0, Ordering::Relaxed);
        fetched
    }
}

/// The result of a fetch.
#[derive(Debug)]
pub(super) struct Fetched {
    pub(super) messages: Vec<Observed>,
    /// Further messages that had no room, since the last fetch.
    pub(super) dropped: u64,
    /// Whether more messages wait.
    pub(super) more: bool,
}

/// The entry of the routing table while there are watches.
struct WatchTap(Vec<Arc<TrafficWatch>>);

impl Tap for WatchTap {
    fn watches(&self, app: Tid) -> bool {
        self.0.iter().any(|watch| watch.app == app)
    }

    fn saw(&self, app: Tid, passage: &Passage<'_>) {
        let wants = |watch: &&Arc<TrafficWatch>| {
            let way = match passage.way {
                Way::In => watch.directions.received,
                Way::Out => watch.directions.sent,
            };
            watch.app == app && way
        };
        self.0.iter().filter(wants).for_each(|watch| watch.put(passage));
    }

    fn missed(&self, app: Tid, messages: u64) {
        self.0.iter().filter(|watch| watch.app == app).for_each(|watch| watch.count_dropped(messages));
    }
}

/// All watches of a node; owned by the answering thread.
#[derive(Default)]
pub(super) struct Watches(BTreeMap<(Tid, Tid), (Arc<TrafficWatch>, Time)>);

/// The new entry for the routing table, if it changes.
pub(super) type NewTap = Option<Option<Arc<dyn Tap>>>;

impl Watches {
    /// Returns the messages of `app` that `watcher` has not fetched yet; starts or renews the watch. `None`
    /// if the maximum number of watches exists.
    pub(super) fn fetch(
        &mut self,
        now: Time,
        (watcher, app): (Tid, Tid),
        directions: Directions,
        bytes_max: usize,
    ) -> (Option<Fetched>, NewTap) {
        let until = now + LEASE;
        let key = (watcher, app);
        if let Some((watch, lease)) = self.0.get_mut(&key).filter(|(watch, _)| watch.directions == directions)
        {
            *lease = until;
            return (Some(watch.fetch(bytes_max)), None);
        }
        if self.0.len() >= WATCHES_MAX && !self.0.contains_key(&key) {
            return (None, None);
        }
        let watch = TrafficWatch { app, directions, queue: Mutex::default(), dropped: AtomicU64::new(0) };
        self.0.insert(key, (Arc::new(watch), until));
        (Some(Fetched { messages: Vec::new(), dropped: 0, more: false }), Some(self.tap()))
    }

    /// Returns whether this watch leaves enough watches to others if a guest starts it. An existing watch may
    /// continue.
    pub(super) fn leaves_room(&self, key: (Tid, Tid), is_guest: impl Fn(Tid) -> bool) -> bool {
        let of_guests = || self.0.keys().filter(|(watcher, _)| is_guest(*watcher)).count();
        self.0.contains_key(&key) || !is_guest(key.0) || of_guests() < GUESTS_WATCHES_MAX
    }

    /// Ends the watches with expired leases.
    pub(super) fn expire(&mut self, now: Time) -> NewTap {
        let before = self.0.len();
        self.0.retain(|_, (_, until)| *until > now);
        (self.0.len() < before).then(|| self.tap())
    }

    /// Returns when the next lease ends.
    pub(super) fn next_end(&self) -> Option<Time> {
        self.0.values().map(|(_, until)| *until).min()
    }

    fn tap(&self) -> Option<Arc<dyn Tap>> {
        let watches: Vec<_> = self.0.values().map(|(watch, _)| watch.clone()).collect();
        (!watches.is_empty()).then(|| Arc::new(WatchTap(watches)) as Arc<dyn Tap>)
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

    const BOTH: Directions = Directions { received: true, sent: true };

    fn tid(app: u32) -> Tid {
        Tid::new(NodeAddress::from([127, 0, 0, 1]), AppAddress::new(app))
    }

    fn show(tap: &dyn Tap, way: Way, payload: &Bytes) {
        let header = Header::new(Kind::named("test.any"), tid(0x1001), tid(0x1002));
        let length = payload.len();
        tap.saw(tid(0x1001), &Passage { way, header: &header, payload, length, refused: None });
    }

    /// A watch of 0x1001 by 0x1fff, and its tap.
    fn watch(watches: &mut Watches, directions: Directions) -> Arc<dyn Tap> {
        let (fetched, tap) = watches.fetch(Time::ZERO, (tid(0x1fff), tid(0x1001)), directions, usize::MAX);
        assert!(fetched.is_some_and(|fetched| fetched.messages.is_empty()));
        tap.expect("a new one").expect("somebody watches")
    }

    fn fetch(watches: &mut Watches, bytes_max: usize) -> Fetched {
        watches.fetch(Time::ZERO, (tid(0x1fff), tid(0x1001)), BOTH, bytes_max).0.expect("it is there")
    }

    #[test]
    fn dropped_messages_are_counted_once_in_order() {
        // Given
        let mut watches = Watches::default();
        let tap = watch(&mut watches, BOTH);
        for number in 0..KEPT_MAX as u32 + 3 {
            show(&*tap, Way::In, &Bytes::copy_from_slice(&number.to_le_bytes()));
        }
        // When
        let mut got = Vec::new();
        let first = fetch(&mut watches, usize::MAX);
        assert!(first.more && first.messages.len() == SEEN_MAX && first.dropped == 3, "{}", first.dropped);
        got.extend(first.messages);
        loop {
            let next = fetch(&mut watches, usize::MAX);
            assert_eq!(next.dropped, 0, "it was reported already");
            got.extend(next.messages);
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
        assert_eq!(fetch(&mut watches, usize::MAX).messages.len(), 1);
    }

    #[test]
    fn payload_bytes_are_bounded_and_long_ones_omitted() {
        let mut watches = Watches::default();
        let tap = watch(&mut watches, BOTH);
        let longest = Bytes::from(vec![0; SEEN_BYTES_MAX]);
        let kept = KEPT_BYTES_MAX / SEEN_BYTES_MAX;
        (0..=kept).for_each(|_| show(&*tap, Way::In, &longest));
        show(&*tap, Way::In, &Bytes::from(vec![0; SEEN_BYTES_MAX + 1]));
        let first = fetch(&mut watches, SEEN_BYTES_MAX + 1);
        assert_eq!((first.messages.len(), first.dropped, first.more), (2, 1, true));
        let mut last = first.messages;
        while let fetched = fetch(&mut watches, usize::MAX)
            && !fetched.messages.is_empty()
        {
            last = fetched.messages;
        }
        let last = last.last().expect("the long one");
        assert_eq!((last.length, last.payload.len()), (SEEN_BYTES_MAX + 1, 0));
    }

    #[test]
    fn sender_does_not_wait_for_a_locked_watch() {
        let mut watches = Watches::default();
        let tap = watch(&mut watches, BOTH);
        let held = watches.0.values().next().expect("the watch").0.clone();
        let lock = held.queue.lock().expect("it is free");
        // Returns even though the lock is held.
        show(&*tap, Way::In, &Bytes::new());
        drop(lock);
        let fetched = fetch(&mut watches, usize::MAX);
        assert_eq!((fetched.messages.len(), fetched.dropped), (0, 1));
    }

    #[test]
    fn only_the_requested_directions_are_shown() {
        let mut watches = Watches::default();
        let tap = watch(&mut watches, Directions { received: true, sent: false });
        assert!(tap.watches(tid(0x1001)) && !tap.watches(tid(0x1002)));
        show(&*tap, Way::Out, &Bytes::new());
        show(&*tap, Way::In, &Bytes::new());
        let directions = Directions { received: true, sent: false };
        let fetched = watches.fetch(Time::ZERO, (tid(0x1fff), tid(0x1001)), directions, usize::MAX).0;
        let found: Vec<_> =
            fetched.expect("it is there").messages.iter().map(|message| message.way).collect();
        assert_eq!(found, [Way::In]);
    }

    #[test]
    fn unfetched_watch_expires_and_watches_are_bounded() {
        // Given: the maximum number of watches, one of them fetched again
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
        // When, then: the others expire first
        let tap = watches.expire(Time::ZERO + LEASE).expect("it changes").expect("one is left");
        assert!(tap.watches(tid(0x1000)) && !tap.watches(tid(0x1001)));
        assert!(watches.expire(Time::ZERO + LEASE).is_none(), "nothing changes");
        assert!(matches!(watches.expire(later + LEASE), Some(None)));
        assert_eq!(watches.next_end(), None);
    }

    // spec: INSPECT-6
    #[test]
    fn guests_get_half_of_the_watches_and_keep_theirs() {
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
        // When, then: the first guest leaves the rest of the guests' share to the second, and both leave the
        // other half to the robot's own
        assert!(begin(&mut watches, first, 0x1000));
        assert_eq!(begin_all(&mut watches, second), GUESTS_WATCHES_MAX - 1);
        assert!(!begin(&mut watches, first, 0x1001));
        assert_eq!(begin_all(&mut watches, own), WATCHES_MAX - GUESTS_WATCHES_MAX);
        // And: existing watches continue
        assert!(begin(&mut watches, first, 0x1000) && begin(&mut watches, second, 0x1000));
        // And: expired watches free their room
        watches.expire(Time::ZERO + LEASE);
        assert_eq!(begin_all(&mut watches, first), GUESTS_WATCHES_MAX);
    }
}
