//! How often users come in whom the access list lets in beside the node's own user and root: each of them so often. Pure.
//!
//! The thread that accepts carries messages, too, and all users come through one queue of the kernel's. So whoever comes too often is taken out
//! of that queue and refused, which costs little, and nobody waits for him: only after some such connections in a row there is a rest.

use std::{collections::BTreeMap, time::Duration};

use sinew_runtime::time::Time;

use crate::accept_pace::{IN_A_ROW_MAX, REST};

/// One connection of a user is saved up in each. Each registers once at most, so registrations have this pace, too.
pub(super) const EACH: Duration = Duration::from_millis(50);
/// Connections of a user that are saved up at most: a process with as many addresses as it may have by default starts, or comes back, at once.
pub(super) const SAVED_MAX: u32 = 64;
/// Users that are told apart. Those beyond have the pace of one, together.
const USERS_MAX: usize = 64;

/// A user has come too often. It is at fault.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "user {uid} has connected {SAVED_MAX} times at once, or for long more often than each {EACH:?}, which is the limit for a user whom only \
     the access list lets in; keep connections open, and connect again later"
)]
pub(super) struct TooOften {
    uid: u32,
}

/// What each of them has saved up.
#[derive(Debug)]
pub(super) struct Guests {
    users: BTreeMap<u32, Saved>,
    /// Of those who are not told apart.
    others: Saved,
}

impl Guests {
    /// Nobody has come yet.
    pub(super) const fn new(now: Time) -> Self {
        Self { users: BTreeMap::new(), others: Saved::all(now) }
    }

    /// Lets this user come in once.
    pub(super) fn admit(&mut self, uid: u32, now: Time) -> Result<(), TooOften> {
        if self.saved_of(uid, now).take_one(now) { Ok(()) } else { Err(TooOften { uid }) }
    }

    fn saved_of(&mut self, uid: u32, now: Time) -> &mut Saved {
        if self.users.len() >= USERS_MAX && !self.users.contains_key(&uid) {
            // Who has all saved up is as good as one who has never come.
            self.users.retain(|_, saved| saved.at(now) < SAVED_MAX);
            if self.users.len() >= USERS_MAX {
                return &mut self.others;
            }
        }
        self.users.entry(uid).or_insert_with(|| Saved::all(now))
    }
}

#[derive(Debug)]
struct Saved {
    count: u32,
    /// Until when it was saved up.
    as_of: Time,
}

impl Saved {
    const fn all(now: Time) -> Self {
        Self { count: SAVED_MAX, as_of: now }
    }

    fn at(&self, now: Time) -> u32 {
        self.count.saturating_add(self.periods(now)).min(SAVED_MAX)
    }

    fn periods(&self, now: Time) -> u32 {
        u32::try_from(now.since(self.as_of).as_nanos() / EACH.as_nanos()).unwrap_or(u32::MAX)
    }

    fn take_one(&mut self, now: Time) -> bool {
        let periods = self.periods(now);
        (self.count, self.as_of) = (self.at(now), self.as_of + EACH.saturating_mul(periods));
        let is_there = self.count > 0;
        self.count = self.count.saturating_sub(1);
        is_there
    }
}

/// Connections of all users but the node's own and root that were accepted without a rest, whatever became of them.
#[derive(Debug)]
pub(super) struct Row {
    count: u32,
    last: Time,
}

impl Row {
    /// None has come yet.
    pub(super) const fn new(now: Time) -> Self {
        Self { count: 0, last: now }
    }

    /// How long to wait before the next one is accepted, whoever it is from: that is not known before.
    pub(super) fn rest(&self, now: Time) -> Option<Duration> {
        let left = REST.saturating_sub(now.since(self.last));
        (self.count >= IN_A_ROW_MAX && !left.is_zero()).then_some(left)
    }

    /// One was accepted.
    pub(super) fn took_one(&mut self, now: Time) {
        if now.since(self.last) >= REST {
            self.count = 0;
        }
        (self.count, self.last) = (self.count.saturating_add(1), now);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const GUEST: u32 = 1_001;

    fn at(millis: u64) -> Time {
        Time::ZERO + Duration::from_secs(1) + Duration::from_millis(millis)
    }

    /// How often this user comes in who comes each millisecond.
    fn comes_in(guests: &mut Guests, uid: u32, (begin, end): (u64, u64)) -> u32 {
        (begin..end).map(|millis| u32::from(guests.admit(uid, at(millis)).is_ok())).sum()
    }

    #[test]
    fn who_comes_again_as_soon_as_he_is_gone_comes_in_as_often_as_was_saved_up_and_then_at_the_pace() {
        let mut guests = Guests::new(at(0));
        assert_eq!(comes_in(&mut guests, GUEST, (0, 10_000)), SAVED_MAX + 199);
        assert_eq!(guests.admit(GUEST, at(9_999)), Err(TooOften { uid: GUEST }));
        // And after a quiet time all at once again, and no more.
        assert_eq!(comes_in(&mut guests, GUEST, (100_000, 100_049)), 49);
        assert_eq!(comes_in(&mut guests, GUEST, (1_000_000, 1_000_100)), SAVED_MAX + 1);
    }

    #[test]
    fn what_one_uses_up_another_one_has_still() {
        let mut guests = Guests::new(at(0));
        comes_in(&mut guests, GUEST, (0, 1_000));
        assert_eq!(comes_in(&mut guests, GUEST + 1, (1_000, 1_040)), 40);
    }

    #[test]
    fn of_many_users_no_more_are_remembered_than_are_told_apart_and_the_others_have_one_pace() {
        // Given: as many as are told apart, none of whom has all saved up
        let (mut guests, told_apart) = (Guests::new(at(0)), u32::try_from(USERS_MAX).unwrap());
        (0..told_apart).for_each(|uid| assert_eq!(guests.admit(uid, at(0)), Ok(())));
        // When: as many again come, each as often as it could alone
        let others = told_apart..2 * told_apart;
        let came_in: u32 = others.map(|uid| comes_in(&mut guests, uid, (0, 40))).sum();
        // Then:
        assert_eq!(came_in, SAVED_MAX);
        assert_eq!(guests.users.len(), USERS_MAX);
        // Who has not come for long makes room.
        assert_eq!(guests.admit(9_999, at(1_000)), Ok(()));
        assert_eq!(guests.users.len(), 1);
    }

    #[test]
    fn after_some_in_a_row_there_is_a_rest_and_it_is_as_long_however_often_it_is_asked_for() {
        let mut row = Row::new(at(0));
        for _ in 0..IN_A_ROW_MAX {
            assert_eq!(row.rest(at(10)), None);
            row.took_one(at(10));
        }
        assert_eq!(row.rest(at(10)), Some(REST));
        let half = REST / 2;
        assert_eq!(row.rest(at(10) + half), Some(REST - half));
        assert_eq!(row.rest(at(10) + REST), None);
        row.took_one(at(11));
        assert_eq!(row.rest(at(11)), None);
    }
}
