//! How fast what guests send is read: of all of them together so much in a second, of one user half of that. Pure.
//!
//! The thread that reads it carries the messages of the robot's own, too, and layers behind it work for both. What comes faster stays in the
//! guest's own ring or socket, where it fills nothing but that.
//!
//! The generic cell rate algorithm (ITU-T I.371, annex A, as virtual scheduling): each piece that was read moves the time forward at which the
//! next one is due, and who is ahead of that by more than what may be saved up waits.

use std::{collections::BTreeMap, time::Duration};

use sinew_runtime::time::Time;

/// Bytes of a frame that are read as one piece: a longer frame counts as so many as begin in it.
const PIECE: usize = 16 * 1024;
/// For so long what was not used is saved up.
const SAVED: Duration = Duration::from_millis(10);
/// Of all pieces one user has this part at most: none keeps all others out alone.
const USERS: u32 = 2;
/// Users that are told apart. Those beyond have the pace of one, together.
const USERS_MAX: usize = 64;

/// What was read of guests.
#[derive(Debug)]
pub(super) struct GuestPace {
    /// Time for a piece, of all.
    piece: Duration,
    all: Due,
    users: BTreeMap<u32, Due>,
    /// Of those who are not told apart.
    others: Due,
}

/// When the next piece is due.
#[derive(Clone, Copy, Debug)]
struct Due(Time);

impl Due {
    fn read(&mut self, cost: Duration, now: Time) {
        self.0 = self.0.max(now) + cost;
    }

    fn rest(self, now: Time) -> Duration {
        self.0.since(now).saturating_sub(SAVED)
    }
}

impl GuestPace {
    /// Nothing was read yet. Of all guests together so many pieces may be in a second, one at least.
    pub(super) fn new(pieces_per_s: usize) -> Self {
        let pieces_per_s = u32::try_from(pieces_per_s).unwrap_or(u32::MAX).max(1);
        let due = Due(Time::ZERO);
        Self { piece: Duration::from_secs(1) / pieces_per_s, all: due, users: BTreeMap::new(), others: due }
    }

    /// A frame of this user with so many bytes was read. Returns how long nothing more is to be read of that connection.
    pub(super) fn read(&mut self, uid: u32, bytes: usize, now: Time) -> Option<Duration> {
        let pieces = u32::try_from(bytes.div_ceil(PIECE)).unwrap_or(u32::MAX).max(1);
        let cost = self.piece.saturating_mul(pieces);
        self.all.read(cost, now);
        let of_user = self.due_of(uid, now);
        of_user.read(cost.saturating_mul(USERS), now);
        let rest = of_user.rest(now).max(self.all.rest(now));
        (!rest.is_zero()).then_some(rest)
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

    fn at(time: Duration) -> Time {
        Time::ZERO + SECOND + time
    }

    /// Connections of these users send without end for so long. Returns how much was read of each user: frames of so many bytes.
    fn flood(
        pace: &mut GuestPace,
        (begin, lasts): (Time, Duration),
        users: &[u32],
        bytes: usize,
    ) -> Vec<u64> {
        let end = begin + lasts;
        let (mut read, mut wake) = (vec![0; users.len()], vec![begin; users.len()]);
        while let Some((which, now)) = wake.iter().copied().enumerate().min_by_key(|(_, at)| *at)
            && now < end
        {
            read[which] += 1;
            // Reading takes a microsecond, and the timer no less than a millisecond.
            let rest = pace.read(users[which], bytes, now).unwrap_or_default();
            let rest = Duration::from_millis(rest.as_nanos().div_ceil(1_000_000) as u64);
            wake[which] = now + rest + Duration::from_micros(1);
        }
        read
    }

    #[test]
    fn one_user_is_read_at_half_the_pace_and_what_was_saved_up_however_many_connections_it_has() {
        for connections in [1, 8, 64] {
            let mut pace = GuestPace::new(PER_S);
            let users = vec![GUEST; connections];
            let read: u64 = flood(&mut pace, (at(Duration::ZERO), SECOND), &users, 64).iter().sum();
            let (rate, saved) = (PER_S as u64 / 2, 100);
            assert!((rate * 9 / 10..=rate + saved + connections as u64).contains(&read), "{read}");
        }
    }

    #[test]
    fn many_users_together_have_the_pace_and_one_that_is_slow_waits_for_nobody_but_when_all_is_used_up() {
        let users: Vec<u32> = (0..8).map(|number| GUEST + number).collect();
        let mut pace = GuestPace::new(PER_S);
        let read: u64 = flood(&mut pace, (at(Duration::ZERO), SECOND), &users, 64).iter().sum();
        assert!((PER_S as u64 * 9 / 10..=PER_S as u64 + 208).contains(&read), "{read}");
        // One user that sends without end leaves the other half.
        let mut pace = GuestPace::new(PER_S);
        for millis in 0..1_000 {
            let now = at(Duration::from_millis(millis));
            while pace.read(GUEST, 64, now).is_none() {}
            assert_eq!(pace.read(GUEST + 1, 64, now), None, "at {millis} ms");
        }
    }

    #[test]
    fn a_long_frame_counts_as_its_pieces() {
        let mut pace = GuestPace::new(PER_S);
        let read: u64 = flood(&mut pace, (at(Duration::ZERO), SECOND), &[GUEST], 4 * PIECE).iter().sum();
        assert!((PER_S as u64 / 8 * 9 / 10..=PER_S as u64 / 8 + 26).contains(&read), "{read}");
    }

    #[test]
    fn whoever_was_quiet_has_saved_up_no_more_than_may_be() {
        let mut pace = GuestPace::new(PER_S);
        let burst =
            |pace: &mut GuestPace, now| (0..).take_while(|_| pace.read(GUEST, 64, now).is_none()).count();
        let first = burst(&mut pace, at(Duration::ZERO));
        assert_eq!(first, 100);
        assert_eq!(burst(&mut pace, at(SECOND * 3_600)), first);
    }

    #[test]
    fn of_many_users_no_more_are_remembered_than_are_told_apart() {
        let mut pace = GuestPace::new(PER_S);
        let told_apart = u32::try_from(USERS_MAX).unwrap();
        (0..2 * told_apart).for_each(|uid| _ = pace.read(uid, 64, at(Duration::ZERO)));
        assert_eq!(pace.users.len(), USERS_MAX);
        pace.read(9_999, 64, at(SECOND));
        assert_eq!(pace.users.len(), 1, "who has all saved up makes room");
    }
}
