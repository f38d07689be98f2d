//! Connection rates of guests: users that only the access list admits, beside the node's own user and root.
//! Pure.
//!
//! The thread that accepts also carries messages, and all users share one queue of the kernel. So an excess
//! connection is taken from that queue and refused, which costs little and delays no other user. The thread
//! pauses only after several such connections in a row.

use std::time::Duration;

use sinew_model::rate_limiter::{KeyedRateLimiter, Rate, WhenFull};
use sinew_runtime::time::Time;

/// Time in which one more connection of a user becomes available. A connection registers at most once, so
/// registrations have this rate, too.
pub(super) const EACH: Duration = Duration::from_millis(50);
/// Maximum number of connections of a user at once. A process with its default number of addresses can start
/// or reconnect all of them at once.
pub(super) const BURST_MAX: u32 = 64;
/// Maximum number of users with a rate of their own. All further users share one.
const USERS_MAX: usize = 64;

/// The connection rate of a user exceeds its limit. That user is at fault.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "user {uid} has connected {BURST_MAX} times at once, or for long more often than each {EACH:?}, which is the limit for a user that only \
     the access list admits; keep connections open, and connect again later"
)]
pub(super) struct ConnectionRateError {
    uid: u32,
}

/// The connection rate of each guest.
#[derive(Debug)]
pub(super) struct GuestConnections(KeyedRateLimiter<u32>);

impl GuestConnections {
    /// Creates the rates; no user has connected yet.
    pub(super) const fn new() -> Self {
        Self(KeyedRateLimiter::new(Rate::new(EACH, BURST_MAX), USERS_MAX, WhenFull::Share))
    }

    /// Counts a connection of this user, if its rate permits that.
    pub(super) fn admit(&mut self, uid: u32, now: Time) -> Result<(), ConnectionRateError> {
        if self.0.of(&uid, now).try_take(now) { Ok(()) } else { Err(ConnectionRateError { uid }) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const GUEST: u32 = 1_001;

    fn at(millis: u64) -> Time {
        Time::ZERO + Duration::from_secs(1) + Duration::from_millis(millis)
    }

    /// Returns how often this user is admitted if it connects each millisecond.
    fn count_admitted(guests: &mut GuestConnections, uid: u32, (begin, end): (u64, u64)) -> u32 {
        (begin..end).map(|millis| u32::from(guests.admit(uid, at(millis)).is_ok())).sum()
    }

    #[test]
    fn frequent_reconnects_are_admitted_by_burst_then_by_pace() {
        let mut guests = GuestConnections::new();
        assert_eq!(count_admitted(&mut guests, GUEST, (0, 10_000)), BURST_MAX + 199);
        assert_eq!(guests.admit(GUEST, at(9_999)), Err(ConnectionRateError { uid: GUEST }));
        // And: after a quiet time the whole burst again, and no more.
        assert_eq!(count_admitted(&mut guests, GUEST, (100_000, 100_049)), 49);
        assert_eq!(count_admitted(&mut guests, GUEST, (1_000_000, 1_000_100)), BURST_MAX + 1);
    }

    #[test]
    fn users_have_separate_allowances() {
        let mut guests = GuestConnections::new();
        count_admitted(&mut guests, GUEST, (0, 1_000));
        assert_eq!(count_admitted(&mut guests, GUEST + 1, (1_000, 1_040)), 40);
    }

    #[test]
    fn remembered_users_are_bounded_and_others_share_one_pace() {
        // Given: the maximum number of distinguished users, none of them with a full allowance
        let (mut guests, tracked) = (GuestConnections::new(), u32::try_from(USERS_MAX).unwrap());
        (0..tracked).for_each(|uid| assert_eq!(guests.admit(uid, at(0)), Ok(())));
        // When: as many again connect, each as often as it could alone
        let others = tracked..2 * tracked;
        let admitted: u32 = others.map(|uid| count_admitted(&mut guests, uid, (0, 40))).sum();
        // Then:
        assert_eq!(admitted, BURST_MAX);
        assert_eq!(guests.0.len(), USERS_MAX);
        // A user that has not connected for long makes room.
        assert_eq!(guests.admit(9_999, at(1_000)), Ok(()));
        assert_eq!(guests.0.len(), 1);
    }
}
