//! Quotas for log lines that other nodes and clients can cause: by connecting, registering, moving, or
//! leaving wills. A burst is allowed, and one line a second in the long run. In addition, each known source
//! has a few lines of its own. So a source that connects and disconnects in a loop does not suppress the
//! lines of others.

use std::{
    sync::{Arc, Mutex},
    time::Duration,
};

use sinew_runtime::{lock, tid::NodeAddress, time::Time};

use crate::{
    periodic_checks::PeriodicChecks,
    rate_limiter::{KeyedRateLimiter, Rate, RateLimiter, WhenFull},
};

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
#[derive(Debug)]
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
    /// Creates full quotas. A suppressed line requests `checks`, which call [`tick`](Self::tick).
    #[must_use]
    pub fn new(checks: &Arc<PeriodicChecks>) -> Self {
        Self {
            links: Quota::new(checks),
            members: Quota::new(checks),
            clients: Quota::new(checks),
            times: Quota::new(checks),
            moves: Quota::new(checks),
            wills: Quota::new(checks),
            wills_not_taken: Quota::new(checks),
        }
    }

    /// Logs how many lines were suppressed, once a second for each kind: without further lines the suppression
    /// would otherwise not be visible. Returns whether suppressed lines are left for a later call.
    pub fn tick(&self, now: Time) -> bool {
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
        let is_left = [
            links.has_suppressed(),
            members.has_suppressed(),
            clients.has_suppressed(),
            times.has_suppressed(),
            moves.has_suppressed(),
            wills.has_suppressed(),
            wills_not_taken.has_suppressed(),
        ];
        is_left.contains(&true)
    }
}

/// The quota of one kind of lines, per source of type `K`.
#[derive(Debug)]
pub struct Quota<K> {
    state: Mutex<State<K>>,
    checks: Arc<PeriodicChecks>,
}

#[derive(Debug)]
struct State<K> {
    common: RateLimiter,
    own: KeyedRateLimiter<K>,
    suppressed: u64,
    /// When the number of suppressed lines was logged last.
    last_logged: Time,
}

impl<K: Ord + Clone> Quota<K> {
    fn new(checks: &Arc<PeriodicChecks>) -> Self {
        let common = RateLimiter::new(Rate::new(EACH, AT_ONCE));
        let own = Rate::new(OWN_EACH, OWN_AT_ONCE);
        let own = KeyedRateLimiter::new(own, KNOWN_MAX, WhenFull::EvictMostUsed);
        let state = State { common, own, suppressed: 0, last_logged: Time::ZERO };
        Self { state: Mutex::new(state), checks: checks.clone() }
    }

    /// Returns the number of lines suppressed since the last one if one more line of `key` may be written at
    /// `now`. `None`: it must not be written, and is counted.
    pub fn take(&self, key: &K, now: Time) -> Option<u64> {
        let mut state = lock(&self.state);
        let State { common, own, suppressed, last_logged } = &mut *state;
        // The source becomes known with its first line.
        let own = own.of(key, now);
        if !common.try_take(now) && !own.try_take(now) {
            *suppressed += 1;
            drop(state);
            self.checks.request();
            return None;
        }
        *last_logged = now;
        Some(std::mem::take(suppressed))
    }

    /// Returns the number of suppressed lines that must be logged now, without another line.
    fn take_suppressed(&self, now: Time) -> u64 {
        let mut state = lock(&self.state);
        if now.since(state.last_logged) < EACH {
            return 0;
        }
        state.last_logged = now;
        std::mem::take(&mut state.suppressed)
    }

    fn has_suppressed(&self) -> bool {
        lock(&self.state).suppressed > 0
    }
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;

    use super::*;

    fn quota() -> Quota<i32> {
        Quota::new(&Arc::default())
    }

    fn at(millis: u64) -> Time {
        Time::ZERO + Duration::from_secs(1_000) + Duration::from_millis(millis)
    }

    #[test]
    fn burst_then_one_line_per_second_with_skipped_count() {
        let quota = quota();
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
        let quota = quota();
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
        let quota = quota();
        let written = (0..AT_ONCE + 3).filter(|_| quota.take(&1, at(0)).is_some()).count();
        assert_eq!(written, usize::try_from(AT_ONCE).unwrap_or_default());
        assert_eq!([999, 1_000, 2_000].map(|millis| quota.take_suppressed(at(millis))), [0, 3, 0]);
    }

    #[test]
    fn suppressed_line_is_left_until_its_second_is_over() {
        let quotas = LogQuotas::new(&Arc::default());
        assert!(!quotas.tick(at(0)));
        let node = NodeAddress::new(1);
        let written = (0..=AT_ONCE).filter(|_| quotas.links.take(&node, at(0)).is_some()).count();
        assert_eq!(written, usize::try_from(AT_ONCE).unwrap_or_default());
        assert_eq!([999, 1_000, 1_001].map(|millis| quotas.tick(at(millis))), [true, false, false]);
    }

    #[test]
    fn suppressed_line_requests_checks_but_written_line_does_not() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().expect("a runtime");
        let (checks, polled) = (Arc::<PeriodicChecks>::default(), Cell::new(0));
        let quotas = LogQuotas::new(&checks);
        let run = checks.run(Duration::from_millis(1), || {
            polled.set(polled.get() + 1);
            false
        });
        let polls = async |count| {
            while polled.get() < count {
                tokio::task::yield_now().await;
            }
        };
        let test = async {
            // Nothing is due: it is polled twice, and then waits.
            polls(2).await;
            let node = NodeAddress::new(1);
            while quotas.links.take(&node, at(0)).is_some() {
                tokio::time::sleep(Duration::from_micros(1)).await;
                assert_eq!(polled.get(), 2, "no line was suppressed");
            }
            polls(4).await;
        };
        runtime.block_on(async {
            tokio::select! {
                () = run => panic!("it never ends"),
                ended = tokio::time::timeout(Duration::from_secs(60), test) => ended.expect("waited 60 s for the checks"),
            }
        });
    }
}
