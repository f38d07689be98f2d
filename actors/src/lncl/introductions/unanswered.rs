//! What the node holds for introductions that are not answered: so many of all, so many of one process, so long. Pure.
//!
//! Each is a descriptor. Without a bound over all clients those who never answer would have all descriptors of the node, and
//! newcomers would not be served.

use std::{collections::BTreeMap, time::Duration};

use sinew_runtime::time::Time;

/// Introductions of all clients that are not answered. One more is refused as `QueueFull`.
pub(super) const ALL_MAX: usize = 64;
/// Those that the clients of one process have asked for, and those that they have not answered. One more is refused likewise.
pub(super) const PROCESS_MAX: usize = 32;
/// So long an introduction waits for its answer. Then it is given up, and the asker is told `QueueFull`: as long as it waits itself.
pub(super) const ANSWERED_WITHIN: Duration = Duration::from_secs(10);

/// The processes of both sides of an introduction.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Processes {
    pub(super) asker: u32,
    pub(super) peer: u32,
}

struct Waiting<T> {
    of: Processes,
    since: Time,
    what: T,
}

/// What waits, by the number of its introduction.
pub(super) struct Unanswered<T>(BTreeMap<u64, Waiting<T>>);

impl<T> Default for Unanswered<T> {
    fn default() -> Self {
        Self(BTreeMap::new())
    }
}

impl<T> Unanswered<T> {
    /// Whether there is room for one more. The limit of one process is not applied to a process with an unknown pid (0).
    pub(super) fn has_room_for(&self, of: Processes) -> bool {
        let count = |is_theirs: fn(Processes, Processes) -> bool| {
            self.0.values().filter(|waiting| is_theirs(waiting.of, of)).count()
        };
        self.0.len() < ALL_MAX
            && count(|one, other| one.asker != 0 && one.asker == other.asker) < PROCESS_MAX
            && count(|one, other| one.peer != 0 && one.peer == other.peer) < PROCESS_MAX
    }

    /// `what` waits from `now` on as the introduction `number`, which no other has.
    pub(super) fn insert(&mut self, number: u64, of: Processes, what: T, now: Time) {
        self.0.insert(number, Waiting { of, since: now, what });
    }

    /// The introduction `number` is answered. `None` if it was given up.
    pub(super) fn remove(&mut self, number: u64) -> Option<T> {
        self.0.remove(&number).map(|waiting| waiting.what)
    }

    /// What is like that waits no more; with each the time from when on it has waited.
    pub(super) fn remove_if(&mut self, is_it: impl Fn(&T) -> bool) -> Vec<(T, Time)> {
        let found = self.0.extract_if(.., |_, waiting| is_it(&waiting.what));
        found.map(|(_, waiting)| (waiting.what, waiting.since)).collect()
    }

    /// What has waited too long at `now`. It waits no more.
    pub(super) fn give_up(&mut self, now: Time) -> Vec<T> {
        let late = self.0.extract_if(.., |_, waiting| now.since(waiting.since) >= ANSWERED_WITHIN);
        late.map(|(_, waiting)| waiting.what).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const START: Time = Time::from_nanos(1);

    fn of(asker: u32, peer: u32) -> Processes {
        Processes { asker, peer }
    }

    #[test]
    fn all_have_a_bound_together_and_each_process_one_on_both_sides() {
        let mut unanswered = Unanswered::default();
        for number in 0..PROCESS_MAX as u64 {
            assert!(unanswered.has_room_for(of(1, 2)));
            unanswered.insert(number, of(1, 2), (), START);
        }
        assert!(!unanswered.has_room_for(of(1, 3)), "so many of one asker's");
        assert!(!unanswered.has_room_for(of(3, 2)), "so many that one has not answered");
        for number in PROCESS_MAX as u64..ALL_MAX as u64 {
            assert!(unanswered.has_room_for(of(3, 4)));
            unanswered.insert(number, of(3, 4), (), START);
        }
        assert!(!unanswered.has_room_for(of(5, 6)), "so many of all");
        assert_eq!(unanswered.remove(0), Some(()));
        assert!(unanswered.has_room_for(of(5, 6)));
    }

    #[test]
    fn what_has_waited_too_long_waits_no_more() {
        let mut unanswered = Unanswered::default();
        let within = i64::try_from(ANSWERED_WITHIN.as_nanos()).unwrap();
        unanswered.insert(1, of(1, 2), "first", START);
        unanswered.insert(2, of(1, 2), "second", START.shifted(1));
        assert!(unanswered.give_up(START.shifted(within - 1)).is_empty());
        assert_eq!(unanswered.give_up(START.shifted(within)), ["first"]);
        assert_eq!(unanswered.remove(1), None);
        assert_eq!(unanswered.remove(2), Some("second"));
    }
}
