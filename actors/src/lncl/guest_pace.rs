//! How fast what guests send is read: of all of them together so much in a second, of one user half of that. Pure.
//!
//! The thread that reads it carries the messages of the robot's own, too, and layers behind it work for both. What comes faster stays in the
//! guest's own ring or socket; what was taken out of that already, a look's worth, waits in the node.
//!
//! The generic cell rate algorithm (ITU-T I.371, annex A, as virtual scheduling): what was read moves the time forward at which the next frame
//! is due, and who is ahead of that by more than what may be saved up waits. What one has read beyond that, a long frame of each of its
//! connections at worst, others wait for no longer than [`BEHIND_OTHERS`], and its own for no longer than [`BEHIND_OWN`].

use std::{collections::BTreeMap, time::Duration};

use sinew_runtime::time::Time;

/// Bytes that count as one frame more.
const PIECE: u64 = 16 * 1024;
/// Applications of the node that count as one frame more, where a message is for many: of each it is looked up whether it may have it.
const LOOKED_AT: u64 = 16;
/// What a frame to another node counts as: the links between nodes are the robot's, and a class has one queue for all.
const TO_A_NODE: u64 = 4;
/// For so long what was not used is saved up.
const SAVED: Duration = Duration::from_millis(10);
/// Of all that is read one user has this part at most: none keeps all others out alone.
const USERS: u32 = 2;
/// Users that are told apart. Those beyond have the pace of one, together.
const USERS_MAX: usize = 64;
/// How long a frame waits for what other users have sent, at most.
const BEHIND_OTHERS: Duration = Duration::from_millis(100);
/// And for what its own user has.
const BEHIND_OWN: Duration = Duration::from_secs(1);

/// What was read.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Sent {
    /// Whole frames: one, or none.
    pub(super) frames: usize,
    /// Bytes in it.
    pub(super) bytes: usize,
    /// Bytes' worth of work that no frame came of.
    pub(super) idle: usize,
    /// Applications of this node that it is for, where they are many.
    pub(super) here: usize,
    /// Other nodes that it is for.
    pub(super) elsewhere: usize,
}

/// What was read of guests.
#[derive(Debug)]
pub(super) struct GuestPace {
    /// Nanoseconds for a frame, of all.
    frame: u64,
    all: Due,
    users: BTreeMap<u32, Due>,
    /// Of those who are not told apart.
    others: Due,
}

/// When the next frame is due.
#[derive(Clone, Copy, Debug)]
struct Due(Time);

impl Due {
    fn read(&mut self, cost: Duration, now: Time, behind: Duration) {
        self.0 = (self.0.max(now) + cost).min(now + SAVED + behind);
    }

    fn rest(self, now: Time) -> Duration {
        self.0.since(now).saturating_sub(SAVED)
    }
}

impl GuestPace {
    /// Nothing was read yet. Of all guests together so many frames may be in a second, one at least.
    pub(super) fn new(frames_per_s: usize) -> Self {
        let frame = 1_000_000_000 / u64::try_from(frames_per_s).unwrap_or(u64::MAX).clamp(1, 1_000_000_000);
        let due = Due(Time::ZERO);
        Self { frame, all: due, users: BTreeMap::new(), others: due }
    }

    /// This was read of a connection of this user. Returns how long nothing more is to be read of that connection.
    pub(super) fn read(&mut self, uid: u32, sent: Sent, now: Time) -> Option<Duration> {
        let cost = self.cost(sent);
        self.all.read(cost, now, BEHIND_OTHERS);
        self.due_of(uid, now).read(cost.saturating_mul(USERS), now, BEHIND_OWN);
        self.rest(uid, now)
    }

    /// How long nothing is to be read of a further connection of this user.
    pub(super) fn rest(&mut self, uid: u32, now: Time) -> Option<Duration> {
        let rest = self.due_of(uid, now).rest(now).max(self.all.rest(now));
        (!rest.is_zero()).then_some(rest)
    }

    fn cost(&self, Sent { frames, bytes, idle, here, elsewhere }: Sent) -> Duration {
        let [frames, bytes, idle, here, elsewhere] =
            [frames, bytes, idle, here, elsewhere].map(|count| count as u64);
        // In parts of a frame, so that nothing is lost by rounding.
        let once = frames.saturating_mul(PIECE).saturating_add(bytes);
        let often = once.saturating_mul(elsewhere.saturating_mul(TO_A_NODE).max(1));
        let looked = frames.saturating_mul(here).saturating_mul(PIECE / LOOKED_AT);
        let parts = often.saturating_add(looked).saturating_add(idle);
        Duration::from_nanos(parts.saturating_mul(self.frame) / PIECE)
    }

    fn due_of(&mut self, uid: u32, now: Time) -> &mut Due {
        if self.users.len() >= USERS_MAX && !self.users.contains_key(&uid) {
            // Who has all saved up is as good as one who has never sent anything.
            self.users.retain(|_, due| due.0 > now);
            if self.users.len() >= USERS_MAX {
                return &mut self.others;
            }
        }
        self.users.entry(uid).or_insert(Due(now))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const GUEST: u32 = 1_001;
    const PER_S: usize = 20_000;
    const SECOND: Duration = Duration::from_secs(1);
    const SHORT: Sent = Sent { frames: 1, bytes: 0, idle: 0, here: 0, elsewhere: 0 };
    /// As long as one may be by default.
    const LONG: Sent = Sent { bytes: 1 << 20, ..SHORT };

    fn at(time: Duration) -> Time {
        Time::ZERO + SECOND + time
    }

    /// A connection that sends without end.
    #[derive(Clone, Copy)]
    struct Connection {
        uid: u32,
        sends: Sent,
        /// When it is read next.
        next: Time,
        read: u64,
    }

    fn connections(count: usize, uid: u32, sends: Sent) -> Vec<Connection> {
        vec![Connection { uid, sends, next: at(Duration::ZERO), read: 0 }; count]
    }

    /// They send for a second. Returns what was read of each user.
    fn flood(pace: &mut GuestPace, mut connections: Vec<Connection>) -> BTreeMap<u32, u64> {
        while let Some(connection) = connections.iter_mut().min_by_key(|connection| connection.next)
            && connection.next < at(SECOND)
        {
            let now = connection.next;
            connection.read += 1;
            // Reading takes a microsecond, and the timer no less than a millisecond.
            let rest = pace.read(connection.uid, connection.sends, now).unwrap_or_default();
            let rest = Duration::from_millis(rest.as_nanos().div_ceil(1_000_000) as u64);
            connection.next = now + rest + Duration::from_micros(1);
        }
        let mut read = BTreeMap::new();
        for connection in connections {
            *read.entry(connection.uid).or_default() += connection.read;
        }
        read
    }

    /// How often a connection of one user is read in a second that sends this.
    fn rate(sends: Sent) -> u64 {
        flood(&mut GuestPace::new(PER_S), connections(1, GUEST, sends))[&GUEST]
    }

    #[test]
    fn one_user_is_read_at_half_the_pace_and_what_was_saved_up_however_many_connections_it_has() {
        for count in [1, 8, 64] {
            let read = flood(&mut GuestPace::new(PER_S), connections(count, GUEST, SHORT))[&GUEST];
            let (rate, saved) = (PER_S as u64 / 2, 100);
            assert!((rate * 9 / 10..=rate + saved + count as u64).contains(&read), "{read} of {count}");
        }
    }

    #[test]
    fn many_users_together_have_the_pace() {
        let all = (0..8).flat_map(|number| connections(1, GUEST + number, SHORT)).collect();
        let read: u64 = flood(&mut GuestPace::new(PER_S), all).values().sum();
        assert!((PER_S as u64 * 9 / 10..=PER_S as u64 + 208).contains(&read), "{read}");
    }

    #[test]
    fn one_that_sends_without_end_leaves_the_other_half() {
        let mut pace = GuestPace::new(PER_S);
        for millis in 0..1_000 {
            let now = at(Duration::from_millis(millis));
            while pace.read(GUEST, SHORT, now).is_none() {}
            assert_eq!(pace.read(GUEST + 1, SHORT, now), None, "at {millis} ms");
        }
    }

    #[test]
    fn what_counts_is_the_work_a_long_frame_many_applications_other_nodes_and_what_no_frame_came_of() {
        let half = PER_S as u64 / 2;
        let is_about = |read: u64, expected: u64| read * 10 >= expected * 8 && read <= expected * 11 / 10 + 2;
        for (sends, counts) in [
            (Sent { bytes: 63 << 14, ..SHORT }, 64),
            (Sent { here: 1_024, ..SHORT }, 65),
            (Sent { elsewhere: 1, ..SHORT }, 4),
            (Sent { elsewhere: 20, bytes: 1 << 14, ..SHORT }, 160),
            (Sent { idle: 100 << 14, frames: 0, ..SHORT }, 100),
        ] {
            let read = rate(sends);
            assert!(is_about(read, half / counts), "{read} of {}: {sends:?}", half / counts);
        }
    }

    #[test]
    fn a_user_with_many_connections_that_send_long_frames_keeps_another_ones_frames_no_longer_than_said() {
        // Given: 64 long frames at once, more than 0.2 s' worth of all
        let mut pace = GuestPace::new(PER_S);
        (0..64).for_each(|_| _ = pace.read(GUEST, LONG, at(Duration::ZERO)));
        // Then:
        let waits = pace.read(GUEST + 1, SHORT, at(Duration::ZERO)).expect("it waits");
        assert!(waits <= BEHIND_OTHERS, "{waits:?}");
        let own = pace.rest(GUEST, at(Duration::ZERO)).expect("it waits");
        assert!(own > waits && own <= BEHIND_OWN, "{own:?}");
        // And: while it goes on, the other one is read, at its leisure
        let mut both = connections(64, GUEST, LONG);
        both.extend(connections(1, GUEST + 1, SHORT));
        let read = flood(&mut GuestPace::new(PER_S), both);
        assert!(read[&(GUEST + 1)] >= 1_000, "{read:?}");
        // Half of all that is read, and a frame of each connection.
        assert!(read[&GUEST] <= PER_S as u64 / 2 / 65 + 2 * 64, "{read:?}");
    }

    #[test]
    fn nobody_waits_longer_than_said_however_long_the_frames_and_slow_the_pace_are() {
        let mut pace = GuestPace::new(100);
        let longest = Sent { bytes: 64 << 20, elsewhere: 1_000, ..SHORT };
        (0..1_000).for_each(|_| assert!(pace.read(GUEST, longest, at(SECOND)) <= Some(BEHIND_OWN)));
        assert!(pace.rest(GUEST + 1, at(SECOND)) <= Some(BEHIND_OTHERS));
        let absurd = Sent {
            frames: usize::MAX,
            bytes: usize::MAX,
            idle: usize::MAX,
            here: usize::MAX,
            elsewhere: usize::MAX,
        };
        assert!(pace.read(GUEST, absurd, at(SECOND)) <= Some(BEHIND_OWN));
    }

    #[test]
    fn whoever_was_quiet_has_saved_up_no_more_than_may_be() {
        let mut pace = GuestPace::new(PER_S);
        let burst =
            |pace: &mut GuestPace, now| (0..).take_while(|_| pace.read(GUEST, SHORT, now).is_none()).count();
        let first = burst(&mut pace, at(Duration::ZERO));
        assert_eq!(first, 100);
        assert_eq!(burst(&mut pace, at(SECOND * 3_600)), first);
    }

    #[test]
    fn of_many_users_no_more_are_remembered_than_are_told_apart() {
        let mut pace = GuestPace::new(PER_S);
        let told_apart = u32::try_from(USERS_MAX).unwrap();
        (0..2 * told_apart).for_each(|uid| _ = pace.read(uid, SHORT, at(Duration::ZERO)));
        assert_eq!(pace.users.len(), USERS_MAX);
        pace.read(9_999, SHORT, at(SECOND * 2));
        assert_eq!(pace.users.len(), 1, "who has all saved up makes room");
    }
}
