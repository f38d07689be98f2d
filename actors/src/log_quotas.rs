//! Lines in the log that others cause by what they may do: connect, come and go, move, leave wills. Many at once, one a second in the long run; and beside those a
//! few of each one's own, so that who comes and goes without end leaves the others' ends in the log.

use std::{collections::BTreeMap, sync::Mutex, time::Duration};

use sinew_runtime::{tid::NodeAddress, time::Time};

use crate::stores::lock;

/// Lines of one sort at once: more than a robot of many nodes has when it starts.
const AT_ONCE: u32 = 256;
/// Time in which one more may be written.
const EACH: Duration = Duration::from_secs(1);
/// Lines of one sort that somebody who is known has for himself, where others have used up all that there are.
const OWN_AT_ONCE: u32 = 4;
/// Time in which he has one more. Who is new begins with none: who takes a new name for each has none.
const OWN_EACH: Duration = Duration::from_secs(60);
/// Who are known of one sort, at most. For a further one goes who has used up the most.
const KNOWN_MAX: usize = 256;

/// How many lines may be written, for each sort.
#[derive(Debug, Default)]
pub(crate) struct LogQuotas {
    /// Links that stand, or are down.
    pub(crate) links: Quota<NodeAddress>,
    /// Nodes that are there, or are lost.
    pub(crate) members: Quota<NodeAddress>,
    /// Applications of other processes that register, and that go.
    pub(crate) clients: Quota<String>,
    /// Peers that are taken though the times of their certificates do not hold.
    pub(crate) times: Quota<NodeAddress>,
    /// Nodes that listen elsewhere now.
    pub(crate) moves: Quota<NodeAddress>,
    /// Last wills of lost nodes that are executed.
    pub(crate) wills: Quota<NodeAddress>,
    /// Of these, those that were not taken.
    pub(crate) wills_not_taken: Quota<NodeAddress>,
}

impl LogQuotas {
    /// Says now and then what was left out: nobody may have anything to say for long, and that is then not seen.
    pub(crate) fn tick(&self, now: Time) {
        let Self { links, members, clients, times, moves, wills, wills_not_taken } = self;
        let left_out = [
            ("link", links.left_out(now)),
            ("membership", members.left_out(now)),
            ("application", clients.left_out(now)),
            ("certificate", times.left_out(now)),
            ("move", moves.left_out(now)),
            ("last will", wills.left_out(now)),
            ("last will not taken", wills_not_taken.left_out(now)),
        ];
        for (of, suppressed) in left_out.into_iter().filter(|(_, suppressed)| *suppressed > 0) {
            crate::log::warn!(of, suppressed, "so many lines were left out, as there are too many of them");
        }
    }
}

/// How many lines of one sort may be written, of those who are called by `K`.
#[derive(Debug)]
pub(crate) struct Quota<K>(Mutex<State<K>>);

#[derive(Debug)]
struct State<K> {
    common: Bucket,
    own: BTreeMap<K, Bucket>,
    suppressed: u64,
    /// When what was suppressed was said last.
    said: Time,
}

/// Lines that may be written yet.
#[derive(Clone, Copy, Debug)]
struct Bucket {
    left: u32,
    /// When `left` was as it is.
    at: Time,
}

impl Bucket {
    /// Whether there was one, which is gone then.
    fn take(&mut self, now: Time, most: u32, each: Duration) -> bool {
        self.fill(now, most, each);
        let Some(left) = self.left.checked_sub(1) else { return false };
        self.left = left;
        true
    }

    fn fill(&mut self, now: Time, most: u32, each: Duration) {
        let more = now.since(self.at).as_secs() / each.as_secs();
        let room = u64::from(most - self.left);
        if more >= room {
            (self.left, self.at) = (most, now);
        } else {
            let more = u32::try_from(more).unwrap_or(most);
            self.left += more;
            self.at = self.at + each * more;
        }
    }
}

impl<K> Default for Quota<K> {
    fn default() -> Self {
        let common = Bucket { left: AT_ONCE, at: Time::ZERO };
        Self(Mutex::new(State { common, own: BTreeMap::new(), suppressed: 0, said: Time::ZERO }))
    }
}

impl<K: Ord + Clone> Quota<K> {
    /// Whether one more of `who` may be written at `now`: then how many were not, since the last one. `None`: it may not, and is counted.
    pub(crate) fn take(&self, who: &K, now: Time) -> Option<u64> {
        let mut state = lock(&self.0);
        state.know(who, now);
        let State { common, own, suppressed, said } = &mut *state;
        let is_free = common.take(now, AT_ONCE, EACH)
            || own.get_mut(who).is_some_and(|own| own.take(now, OWN_AT_ONCE, OWN_EACH));
        if !is_free {
            *suppressed += 1;
            return None;
        }
        *said = now;
        Some(std::mem::take(suppressed))
    }

    /// How many were not written and are to be said now, without another line.
    fn left_out(&self, now: Time) -> u64 {
        let mut state = lock(&self.0);
        if now.since(state.said) < EACH {
            return 0;
        }
        state.said = now;
        std::mem::take(&mut state.suppressed)
    }
}

impl<K: Ord + Clone> State<K> {
    fn know(&mut self, who: &K, now: Time) {
        if self.own.contains_key(who) {
            return;
        }
        if self.own.len() >= KNOWN_MAX {
            self.own.values_mut().for_each(|own| own.fill(now, OWN_AT_ONCE, OWN_EACH));
            // Of two that have as much the one who came last: who is quiet stays.
            let poorest = self.own.iter().min_by_key(|(_, own)| (own.left, std::cmp::Reverse(own.at)));
            let Some((poorest, Bucket { left: 0..OWN_AT_ONCE, .. })) = poorest else { return };
            let poorest = poorest.clone();
            self.own.remove(&poorest);
        }
        self.own.insert(who.clone(), Bucket { left: 0, at: now });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(millis: u64) -> Time {
        Time::ZERO + Duration::from_secs(1_000) + Duration::from_millis(millis)
    }

    #[test]
    fn many_lines_at_once_and_then_one_a_second_with_how_many_were_left_out() {
        let quota = Quota::default();
        let take = |millis| quota.take(&1, at(millis));
        for _ in 0..AT_ONCE {
            assert_eq!(take(0), Some(0));
        }
        assert_eq!([take(0), take(999)], [None, None]);
        assert_eq!([take(1_000), take(1_001), take(2_500)], [Some(2), None, Some(1)]);
        // What was begun of a second counts.
        assert_eq!([take(2_999), take(3_000)], [None, Some(1)]);
        // After a quiet time as many as at first, and one's own.
        let later = (0..300).filter(|_| take(1_000_000).is_some()).count();
        assert_eq!(later, usize::try_from(AT_ONCE + OWN_AT_ONCE).unwrap_or_default());
    }

    #[test]
    fn the_end_of_one_who_is_known_is_written_while_strangers_come_and_go() {
        let quota = Quota::default();
        let knee = 0;
        assert_eq!(quota.take(&knee, at(0)), Some(0));
        // When: each stranger has a name of his own, and there is no end of them.
        let strangers = (1..=10_000).filter(|stranger| quota.take(stranger, at(300_000)).is_some()).count();
        assert_eq!(strangers, usize::try_from(AT_ONCE).unwrap_or_default());
        // Then:
        assert_eq!(quota.take(&knee, at(300_000)), Some(10_000 - u64::from(AT_ONCE)));
        assert_eq!(quota.take(&10_001, at(300_000)), None);
    }

    #[test]
    fn what_was_left_out_is_said_without_another_line() {
        let quota = Quota::default();
        let written = (0..AT_ONCE + 3).filter(|_| quota.take(&1, at(0)).is_some()).count();
        assert_eq!(written, usize::try_from(AT_ONCE).unwrap_or_default());
        assert_eq!([999, 1_000, 2_000].map(|millis| quota.left_out(at(millis))), [0, 3, 0]);
    }
}
