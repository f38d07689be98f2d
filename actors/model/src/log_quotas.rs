//! Quotas for log lines that other nodes and clients can cause: by connecting, registering, moving, or
//! leaving wills. A burst is allowed, and one line a second in the long run. In addition, each known source
//! has a few lines of its own. So a source that connects and disconnects in a loop does not suppress the
//! lines of others.

use std::{sync::Mutex, time::Duration};

use sinew_runtime::{lock, tid::NodeAddress, time::Time};

use crate::rate_limiter::{KeyedRateLimiter, Rate, RateLimiter, WhenFull};

/// Burst size per kind of line: more than a robot of many nodes causes when it starts.
const AT_ONCE: u32 = 256;
/// Time after which one more line may be written.
const EACH: Duration = Duration::from_secs(1);
/// Lines of one kind that a known source may write after others have used up the shared quota.
const OWN_AT_ONCE: u32 = 4;
/// Time after which a source may write one more of these. A new source starts with none, so a source that
/// changes its name each time has none.
const OWN_EACH: Duration = Duration::from_secs(60);
/// Maximum number of known sources per kind. For a further one, the source that has used the most is dropped.
const KNOWN_MAX: usize = 256;

/// The number of lines that may be written, per kind.
#[derive(Debug, Default)]
pub struct LogQuotas {
    /// Links that are established or down.
    pub links: Quota<NodeAddress>,
    /// Nodes that are up or lost.
    pub members: Quota<NodeAddress>,
    /// Applications of other processes that register or end.
    pub clients: Quota<String>,
    /// Peers that are accepted although their certificates are outside their validity period.
    pub times: Quota<NodeAddress>,
    /// Nodes that have changed their listening address.
    pub moves: Quota<NodeAddress>,
    /// Last wills of lost nodes that are executed.
    pub wills: Quota<NodeAddress>,
    /// Of these, those that were not accepted.
    pub wills_not_taken: Quota<NodeAddress>,
}

impl LogQuotas {
    /// Logs periodically how many lines were suppressed: without further lines the suppression would
    /// otherwise not be visible.
    pub fn tick(&self, now: Time) {
        let Self { links, members, clients, times, moves, wills, wills_not_taken } = self;
        let suppressed = [
            ("link", links.take_suppressed(now)),
            ("membership", members.take_suppressed(now)),
            ("application", clients.take_suppressed(now)),
            ("certificate", times.take_suppressed(now)),
            ("move", moves.take_suppressed(now)),
            ("last will", wills.take_suppressed(now)),
            ("last will not taken", wills_not_taken.take_suppressed(now)),
        ];
        for (of, suppressed) in suppressed.into_iter().filter(|(_, suppressed)| *suppressed > 0) {
            sinew_runtime::log::warn!(
                of,
                suppressed,
                "so many lines were left out, as there are too many of them"
            );
        }
    }
}

/// The quota of one kind of lines, per source of type `K`.
#[derive(Debug)]
pub struct Quota<K>(Mutex<State<K>>);

#[derive(Debug)]
struct State<K> {
    common: RateLimiter,
    own: KeyedRateLimiter<K>,
    suppressed: u64,
    /// When the number of suppressed lines was logged last.
    last_logged: Time,
}

impl<K: Ord + Clone> Default for Quota<K> {
    fn default() -> Self {
        let common = RateLimiter::new(Rate::new(EACH, AT_ONCE));
        let own = Rate::new(OWN_EACH, OWN_AT_ONCE);
        let own = KeyedRateLimiter::new(own, KNOWN_MAX, WhenFull::EvictMostUsed);
        Self(Mutex::new(State { common, own, suppressed: 0, last_logged: Time::ZERO }))
    }
}

impl<K: Ord + Clone> Quota<K> {
    /// Returns the number of lines suppressed since the last one if one more line of `key` may be written at
    /// `now`. `None`: it must not be written, and is counted.
    pub fn take(&self, key: &K, now: Time) -> Option<u64> {
        let mut state = lock(&self.0);
        let State { common, own, suppressed, last_logged } = &mut *state;
        // The source becomes known with its first line.
        let own = own.of(key, now);
        if !common.try_take(now) && !own.try_take(now) {
            *suppressed += 1;
            return None;
        }
        *last_logged = now;
        Some(std::mem::take(suppressed))
    }

    /// Returns the number of suppressed lines that must be logged now, without another line.
    fn take_suppressed(&self, now: Time) -> u64 {
        let mut state = lock(&self.0);
        if now.since(state.last_logged) < EACH {
            return 0;
        }
        state.last_logged = now;
        std::mem::take(&mut state.suppressed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(millis: u64) -> Time {
        Time::ZERO + Duration::from_secs(1_000) + Duration::from_millis(millis)
    }

    #[test]
    fn burst_then_one_line_per_second_with_skipped_count() {
        let quota = Quota::default();
        let take = |millis| quota.take(&1, at(millis));
        for _ in 0..AT_ONCE {
            assert_eq!(take(0), Some(0));
        }
        assert_eq!([take(0), take(999)], [None, None]);
        assert_eq!([take(1_000), take(1_001), take(2_500)], [Some(2), None, Some(1)]);
        // A started second counts.
        assert_eq!([take(2_999), take(3_000)], [None, Some(1)]);
        // After a quiet time the initial number of lines is available again, plus the node's own.
        let later = (0..300).filter(|_| take(1_000_000).is_some()).count();
        assert_eq!(later, usize::try_from(AT_ONCE + OWN_AT_ONCE).unwrap_or_default());
    }

    #[test]
    fn known_node_is_logged_despite_strangers() {
        let quota = Quota::default();
        let knee = 0;
        assert_eq!(quota.take(&knee, at(0)), Some(0));
        // When: each of an endless number of strangers has its own name.
        let strangers = (1..=10_000).filter(|stranger| quota.take(stranger, at(300_000)).is_some()).count();
        assert_eq!(strangers, usize::try_from(AT_ONCE).unwrap_or_default());
        // Then:
        assert_eq!(quota.take(&knee, at(300_000)), Some(10_000 - u64::from(AT_ONCE)));
        assert_eq!(quota.take(&10_001, at(300_000)), None);
    }

    #[test]
    fn skipped_lines_are_reported_without_a_further_line() {
        let quota = Quota::default();
        let written = (0..AT_ONCE + 3).filter(|_| quota.take(&1, at(0)).is_some()).count();
        assert_eq!(written, usize::try_from(AT_ONCE).unwrap_or_default());
        assert_eq!([999, 1_000, 2_000].map(|millis| quota.take_suppressed(at(millis))), [0, 3, 0]);
    }
}
