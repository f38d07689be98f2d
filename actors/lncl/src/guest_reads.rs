//! Rate limit on reads from guests: a rate for all guests together, half of which one user may use. Pure.
//!
//! The thread that reads guests also carries the messages of the node's own applications, and the layers
//! behind it serve both. Excess data stays in the guest's own ring or socket. Data that was already read, at
//! most one read's worth, waits in the node.
//!
//! A read is counted by its cost when it is over, and delays the next one. It may exceed the burst, at worst
//! by a long frame of each connection of a user. For such an excess, other users wait at most
//! [`BEHIND_OTHERS`], and the user's own connections at most [`BEHIND_OWN`].

use std::time::Duration;

use sinew_model::rate_limiter::{KeyedRateLimiter, Rate, RateLimiter, WhenFull};
use sinew_runtime::time::Time;

/// Bytes that cost as much as one frame.
const PIECE: u64 = 16 * 1024;
/// Number of local applications that cost as much as one frame, for a message to many. Access is checked for
/// each of them.
const APPS_PER_FRAME: u64 = 16;
/// Cost of a frame to another node, in frames. Links between nodes belong to the robot, and each class has
/// one queue for all.
const TO_A_NODE: u64 = 4;
/// Burst tolerance: unused capacity of this time is kept.
const SAVED: Duration = Duration::from_millis(10);
/// One user may use one part in this many of the total rate, so no user alone can lock out all others.
const USERS: u32 = 2;
/// Maximum number of users with a rate of their own. All further users share one.
const USERS_MAX: usize = 64;
/// Maximum delay of a frame by the excess of other users.
const BEHIND_OTHERS: Duration = Duration::from_millis(100);
/// Maximum delay of a frame by the excess of its own user.
const BEHIND_OWN: Duration = Duration::from_secs(1);

/// Cost items of one read.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Sent {
    /// Complete frames: one or none.
    pub(super) frames: usize,
    /// Payload bytes of the frame.
    pub(super) bytes: usize,
    /// Work without a frame, in bytes.
    pub(super) idle: usize,
    /// Local applications that receive it, if they are many.
    pub(super) here: usize,
    /// Other nodes that receive it.
    pub(super) elsewhere: usize,
}

/// The limit on the reads from all guests.
#[derive(Debug)]
pub(super) struct GuestReads {
    /// Nanoseconds per frame, for all guests.
    frame: u64,
    all: RateLimiter,
    users: KeyedRateLimiter<u32>,
}

impl GuestReads {
    /// Creates the limiter. All guests together may send `frames_per_s` frames per second, at least one.
    pub(super) fn new(frames_per_s: usize) -> Self {
        let frame = 1_000_000_000 / u64::try_from(frames_per_s).unwrap_or(u64::MAX).clamp(1, 1_000_000_000);
        let all = Rate { interval: Duration::from_nanos(frame), tolerance: SAVED };
        let of_user = Rate { interval: all.interval * USERS, ..all };
        let users = KeyedRateLimiter::new(of_user, USERS_MAX, WhenFull::Share);
        Self { frame, all: RateLimiter::new(all), users }
    }

    /// Counts a read from a connection of this user. Returns how long that connection must not be read.
    pub(super) fn on_read(&mut self, uid: u32, sent: Sent, now: Time) -> Option<Duration> {
        let cost = self.cost(sent);
        self.all.charge(now, cost, BEHIND_OTHERS);
        let user = self.users.of(&uid, now);
        user.charge(now, cost.saturating_mul(USERS), BEHIND_OWN);
        longer_delay(user, &self.all, now)
    }

    /// Returns how long a new connection of this user must not be read.
    pub(super) fn delay(&mut self, uid: u32, now: Time) -> Option<Duration> {
        longer_delay(self.users.of(&uid, now), &self.all, now)
    }

    fn cost(&self, Sent { frames, bytes, idle, here, elsewhere }: Sent) -> Duration {
        let [frames, bytes, idle, here, elsewhere] =
            [frames, bytes, idle, here, elsewhere].map(|count| count as u64);
        // Counted in parts of a frame, so that nothing is lost by rounding.
        let once = frames.saturating_mul(PIECE).saturating_add(bytes);
        let often = once.saturating_mul(elsewhere.saturating_mul(TO_A_NODE).max(1));
        let checked = frames.saturating_mul(here).saturating_mul(PIECE / APPS_PER_FRAME);
        let parts = often.saturating_add(checked).saturating_add(idle);
        Duration::from_nanos(parts.saturating_mul(self.frame) / PIECE)
    }
}

/// Returns the longer delay of two limiters, if there is one.
fn longer_delay(user: &RateLimiter, all: &RateLimiter, now: Time) -> Option<Duration> {
    let delay = user.delay(now).max(all.delay(now));
    (!delay.is_zero()).then_some(delay)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;

    const GUEST: u32 = 1_001;
    const PER_S: usize = 20_000;
    const SECOND: Duration = Duration::from_secs(1);
    const SHORT: Sent = Sent { frames: 1, bytes: 0, idle: 0, here: 0, elsewhere: 0 };
    /// The longest frame by default.
    const LONG: Sent = Sent { bytes: 1 << 20, ..SHORT };

    fn at(time: Duration) -> Time {
        Time::ZERO + SECOND + time
    }

    /// A connection that sends endlessly.
    #[derive(Clone, Copy)]
    struct Connection {
        uid: u32,
        sends: Sent,
        /// Time of its next read.
        next: Time,
        read: u64,
    }

    fn connections(count: usize, uid: u32, sends: Sent) -> Vec<Connection> {
        vec![Connection { uid, sends, next: at(Duration::ZERO), read: 0 }; count]
    }

    /// Lets the connections send for a second. Returns the reads per user.
    fn flood(reads: &mut GuestReads, mut connections: Vec<Connection>) -> BTreeMap<u32, u64> {
        while let Some(connection) = connections.iter_mut().min_by_key(|connection| connection.next)
            && connection.next < at(SECOND)
        {
            let now = connection.next;
            connection.read += 1;
            // A read takes a microsecond, and a timer at least a millisecond.
            let rest = reads.on_read(connection.uid, connection.sends, now).unwrap_or_default();
            let rest = Duration::from_millis(rest.as_nanos().div_ceil(1_000_000) as u64);
            connection.next = now + rest + Duration::from_micros(1);
        }
        let mut read = BTreeMap::new();
        for connection in connections {
            *read.entry(connection.uid).or_default() += connection.read;
        }
        read
    }

    /// Returns the reads in a second of one user's connection that sends this.
    fn rate(sends: Sent) -> u64 {
        flood(&mut GuestReads::new(PER_S), connections(1, GUEST, sends))[&GUEST]
    }

    #[test]
    fn one_user_is_read_at_half_the_pace() {
        for count in [1, 8, 64] {
            let read = flood(&mut GuestReads::new(PER_S), connections(count, GUEST, SHORT))[&GUEST];
            let (rate, saved) = (PER_S as u64 / 2, 100);
            assert!((rate * 9 / 10..=rate + saved + count as u64).contains(&read), "{read} of {count}");
        }
    }

    #[test]
    fn many_users_together_have_the_pace() {
        let all = (0..8).flat_map(|number| connections(1, GUEST + number, SHORT)).collect();
        let read: u64 = flood(&mut GuestReads::new(PER_S), all).values().sum();
        assert!((PER_S as u64 * 9 / 10..=PER_S as u64 + 208).contains(&read), "{read}");
    }

    #[test]
    fn endless_sender_leaves_the_other_half() {
        let mut reads = GuestReads::new(PER_S);
        for millis in 0..1_000 {
            let now = at(Duration::from_millis(millis));
            while reads.on_read(GUEST, SHORT, now).is_none() {}
            assert_eq!(reads.on_read(GUEST + 1, SHORT, now), None, "at {millis} ms");
        }
    }

    #[test]
    fn cost_follows_the_work_of_a_frame() {
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
    fn long_frames_delay_another_user_within_the_bound() {
        // Given: 64 long frames at once, more than 0.2 s of all guests' pace
        let mut reads = GuestReads::new(PER_S);
        (0..64).for_each(|_| _ = reads.on_read(GUEST, LONG, at(Duration::ZERO)));
        // Then:
        let waits = reads.on_read(GUEST + 1, SHORT, at(Duration::ZERO)).expect("it waits");
        assert!(waits <= BEHIND_OTHERS, "{waits:?}");
        let own = reads.delay(GUEST, at(Duration::ZERO)).expect("it waits");
        assert!(own > waits && own <= BEHIND_OWN, "{own:?}");
        // And: while it continues, the other user is read at its own pace
        let mut both = connections(64, GUEST, LONG);
        both.extend(connections(1, GUEST + 1, SHORT));
        let read = flood(&mut GuestReads::new(PER_S), both);
        assert!(read[&(GUEST + 1)] >= 1_000, "{read:?}");
        // Half of all reads, and a frame of each connection.
        assert!(read[&GUEST] <= PER_S as u64 / 2 / 65 + 2 * 64, "{read:?}");
    }

    #[test]
    fn delay_is_bounded_for_any_frame_length_and_pace() {
        let mut reads = GuestReads::new(100);
        let longest = Sent { bytes: 64 << 20, elsewhere: 1_000, ..SHORT };
        (0..1_000).for_each(|_| assert!(reads.on_read(GUEST, longest, at(SECOND)) <= Some(BEHIND_OWN)));
        assert!(reads.delay(GUEST + 1, at(SECOND)) <= Some(BEHIND_OTHERS));
        let absurd = Sent {
            frames: usize::MAX,
            bytes: usize::MAX,
            idle: usize::MAX,
            here: usize::MAX,
            elsewhere: usize::MAX,
        };
        assert!(reads.on_read(GUEST, absurd, at(SECOND)) <= Some(BEHIND_OWN));
    }

    #[test]
    fn quiet_user_saves_up_no_more_than_the_limit() {
        let mut reads = GuestReads::new(PER_S);
        let burst = |reads: &mut GuestReads, now| {
            (0..).take_while(|_| reads.on_read(GUEST, SHORT, now).is_none()).count()
        };
        let first = burst(&mut reads, at(Duration::ZERO));
        assert_eq!(first, 100);
        assert_eq!(burst(&mut reads, at(SECOND * 3_600)), first);
    }

    #[test]
    fn remembered_users_are_bounded() {
        let mut reads = GuestReads::new(PER_S);
        let tracked = u32::try_from(USERS_MAX).unwrap();
        (0..2 * tracked).for_each(|uid| _ = reads.on_read(uid, SHORT, at(Duration::ZERO)));
        assert_eq!(reads.users.len(), USERS_MAX);
        reads.on_read(9_999, SHORT, at(SECOND * 2));
        assert_eq!(reads.users.len(), 1, "an idle user makes room");
    }
}
