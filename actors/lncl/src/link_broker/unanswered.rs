//! Unanswered link requests: bounded in all, per process, and in time. Pure.
//!
//! Each holds a descriptor. Without a bound over all clients, silent peers would use up the node's descriptors, and new
//! clients could not be served.

use std::{collections::BTreeMap, time::Duration};

use sinew_runtime::time::Time;

/// Maximum number of unanswered requests of all clients. Further ones are rejected with `QueueFull`.
pub(super) const ALL_MAX: usize = 64;
/// Maximum number of unanswered requests by the clients of one process, and likewise to them. Further ones are rejected
/// with `QueueFull`.
pub(super) const PROCESS_MAX: usize = 32;
/// Deadline of an answer. Then the request is abandoned, and the requester gets `QueueFull`; the requester
/// itself waits as long.
pub(super) const ANSWERED_WITHIN: Duration = Duration::from_secs(10);

/// The processes of both sides of a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Processes {
    pub(super) requester: u32,
    pub(super) peer: u32,
}

struct Waiting<T> {
    of: Processes,
    since: Time,
    what: T,
}

/// The waiting requests, by number.
pub(super) struct Unanswered<T>(BTreeMap<u64, Waiting<T>>);

impl<T> Default for Unanswered<T> {
    fn default() -> Self {
        Self(BTreeMap::new())
    }
}

impl<T> Unanswered<T> {
    /// Returns whether there is room for one more. The limit of one process does not apply to a process with an unknown
    /// pid (0).
    pub(super) fn has_room_for(&self, of: Processes) -> bool {
        let count = |is_same: fn(Processes, Processes) -> bool| {
            self.0.values().filter(|waiting| is_same(waiting.of, of)).count()
        };
        self.0.len() < ALL_MAX
            && count(|one, other| one.requester != 0 && one.requester == other.requester) < PROCESS_MAX
            && count(|one, other| one.peer != 0 && one.peer == other.peer) < PROCESS_MAX
    }

    /// Adds `what` at `now` as the request `number`, which is unique.
    pub(super) fn insert(&mut self, number: u64, of: Processes, what: T, now: Time) {
        self.0.insert(number, Waiting { of, since: now, what });
    }

    /// Removes the answered request `number`. Returns `None` if it was abandoned.
    pub(super) fn remove(&mut self, number: u64) -> Option<T> {
        self.0.remove(&number).map(|waiting| waiting.what)
    }

    /// Removes and returns the matching requests, each with the time of its start.
    pub(super) fn remove_if(&mut self, is_it: impl Fn(&T) -> bool) -> Vec<(T, Time)> {
        let found = self.0.extract_if(.., |_, waiting| is_it(&waiting.what));
        found.map(|(_, waiting)| (waiting.what, waiting.since)).collect()
    }

    /// Returns whether no request waits.
    pub(super) fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Removes and returns the requests with a deadline that has expired at `now`.
    pub(super) fn expire(&mut self, now: Time) -> Vec<T> {
        let late = self.0.extract_if(.., |_, waiting| now.since(waiting.since) >= ANSWERED_WITHIN);
        late.map(|(_, waiting)| waiting.what).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const START: Time = Time::from_nanos(1);

    fn of(requester: u32, peer: u32) -> Processes {
        Processes { requester, peer }
    }

    #[test]
    fn total_and_each_process_on_both_sides_are_bounded() {
        let mut unanswered = Unanswered::default();
        for number in 0..PROCESS_MAX as u64 {
            assert!(unanswered.has_room_for(of(1, 2)));
            unanswered.insert(number, of(1, 2), (), START);
        }
        assert!(!unanswered.has_room_for(of(1, 3)), "the limit of one requester");
        assert!(!unanswered.has_room_for(of(3, 2)), "the limit of one peer");
        for number in PROCESS_MAX as u64..ALL_MAX as u64 {
            assert!(unanswered.has_room_for(of(3, 4)));
            unanswered.insert(number, of(3, 4), (), START);
        }
        assert!(!unanswered.has_room_for(of(5, 6)), "the limit of all");
        assert_eq!(unanswered.remove(0), Some(()));
        assert!(unanswered.has_room_for(of(5, 6)));
    }

    #[test]
    fn request_expires_after_its_time() {
        let mut unanswered = Unanswered::default();
        let within = i64::try_from(ANSWERED_WITHIN.as_nanos()).unwrap();
        unanswered.insert(1, of(1, 2), "first", START);
        unanswered.insert(2, of(1, 2), "second", START.shifted(1));
        assert!(unanswered.expire(START.shifted(within - 1)).is_empty());
        assert_eq!(unanswered.expire(START.shifted(within)), ["first"]);
        assert_eq!(unanswered.remove(1), None);
        assert_eq!(unanswered.remove(2), Some("second"));
    }
}
