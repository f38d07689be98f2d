//! Counts refusals per cause, and logs each cause at most once a second.

use std::{
    collections::BTreeMap,
    fmt::Display,
    sync::{
        Mutex, MutexGuard, PoisonError,
        atomic::{AtomicU64, Ordering},
    },
    time::Duration,
};

use sinew_runtime::{name::is_invisible, time::Time};

/// A peer that sends invalid data at line rate causes one log line a second, not a full disk.
const LOG_PERIOD: Duration = Duration::from_secs(1);
/// Maximum characters of a stored detail: it may contain text of a peer.
const DETAIL_MAX: usize = 256;
/// Maximum characters of a logged detail: the longest sentence of this program, including a peer's text.
const LOGGED_MAX: usize = 1_024;
/// Causes that occur during ordinary starts, stops and restarts of nodes. They are counted like all causes,
/// but logged at debug level.
const ORDINARY: [&str; 8] = [
    // Two nodes have dialled each other at once: one of the two connections remains.
    "duplicate",
    "duplicate at the peer",
    // A node that is being stopped accepts no further connection.
    "leaving",
    "the peer leaves",
    // The last datagrams of an incarnation that has just ended, or to one.
    "datagram of a stranger",
    "datagram with another key",
    "datagram of a former incarnation",
    PEER_GONE,
];

/// Counters of refusals. The causes are literals of this program, so their number is bounded.
#[derive(Debug, Default)]
pub struct Refusals {
    causes: Mutex<BTreeMap<&'static str, Cause>>,
    /// The number of messages that the access list has refused. Senders count it, possibly many and in a hot path.
    by_list: AtomicU64,
    /// The earliest time of the next log line about that, in nanoseconds.
    by_list_next: AtomicU64,
}

/// The cause for messages that the access list refuses.
pub const BY_LIST: &str = "access list";

/// The cause for frames of a layer that were not sent because the peer is being stopped or is lost.
pub const PEER_GONE: &str = "peer gone";

#[derive(Debug, Default)]
struct Cause {
    count: u64,
    logged: Option<Time>,
    suppressed: u64,
    /// The detail of the last logged refusal.
    detail: String,
}

/// The refusals of one cause, as reported to inspectors.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RefusalReport {
    /// Why the inputs were refused.
    pub cause: &'static str,
    /// How many were refused for this cause.
    pub count: u64,
    /// The detail and the time of the last logged refusal.
    pub detail: String,
    /// When the last one was refused.
    pub at: Time,
}

impl Refusals {
    /// Counts one refusal because of `cause`, and logs it with its `detail` unless that cause was logged
    /// within the last second.
    pub fn count(&self, now: Time, cause: &'static str, detail: &dyn Display) {
        let mut causes = self.causes();
        let entry = causes.entry(cause).or_default();
        entry.count += 1;
        if entry.logged.is_some_and(|logged| now.since(logged) < LOG_PERIOD) {
            entry.suppressed += 1;
            return;
        }
        entry.logged = Some(now);
        let suppressed = std::mem::take(&mut entry.suppressed);
        let detail = in_one_line(detail);
        entry.detail = detail.chars().take(DETAIL_MAX).collect();
        // The log's reader may be slow, so the lock is released before logging.
        drop(causes);
        if ORDINARY.contains(&cause) {
            sinew_runtime::log::debug!(suppressed, "{cause}: {detail}");
        } else {
            sinew_runtime::log::warn!(suppressed, "{cause}: {detail}");
        }
    }

    /// Counts a message that the access list refuses, without a lock.
    pub fn count_by_list(&self) {
        // SYNC: Relaxed; a counter on which no other data depends.
        self.by_list.fetch_add(1, Ordering::Relaxed);
    }

    /// Returns whether such a refusal is logged at `now`: true for one caller per second.
    pub fn logs_by_list(&self, now: Time) -> bool {
        let next = self.by_list_next.load(Ordering::Relaxed);
        let then = now + LOG_PERIOD;
        // SYNC: Relaxed; one of several threads changes it, independently of other data.
        now.as_nanos() >= next
            && self
                .by_list_next
                .compare_exchange(next, then.as_nanos(), Ordering::Relaxed, Ordering::Relaxed)
                .is_ok()
    }

    /// Returns the total of refusals.
    pub fn total(&self) -> u64 {
        self.causes().values().map(|cause| cause.count).sum()
    }

    /// Returns the number of refusals per cause.
    pub fn by_cause(&self) -> Vec<(&'static str, u64)> {
        self.causes().iter().map(|(cause, entry)| (*cause, entry.count)).collect()
    }

    /// Returns the refusals per cause, with the last logged one of each.
    pub fn reports(&self) -> Vec<RefusalReport> {
        let causes = self.causes();
        let reports = causes.iter().filter_map(|(cause, entry)| {
            let Cause { count, ref detail, logged, .. } = *entry;
            Some(RefusalReport { cause, count, detail: detail.clone(), at: logged? })
        });
        reports.collect()
    }

    /// Returns the number of refusals because of `cause`.
    pub fn of(&self, cause: &'static str) -> u64 {
        self.causes().get(cause).map_or(0, |cause| cause.count)
    }

    fn causes(&self) -> MutexGuard<'_, BTreeMap<&'static str, Cause>> {
        let mut causes = self.causes.lock().unwrap_or_else(PoisonError::into_inner);
        let by_list = self.by_list.swap(0, Ordering::Relaxed);
        if by_list > 0 {
            let cause = causes.entry(BY_LIST).or_default();
            (cause.count, cause.suppressed) = (cause.count + by_list, cause.suppressed + by_list);
        }
        causes
    }
}

/// Returns a detail as logged. Text of a peer in it cannot end the line, control a terminal, or make the line
/// longer than the bound.
fn in_one_line(detail: &dyn Display) -> String {
    let text = detail.to_string();
    let is_plain = |character: char| !is_invisible(character);
    let escaped = text.chars().flat_map(|character| {
        let (plain, escaped) =
            if is_plain(character) { (Some(character), None) } else { (None, Some(character)) };
        plain.into_iter().chain(escaped.into_iter().flat_map(char::escape_unicode))
    });
    escaped.take(LOGGED_MAX).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn outside_text_is_one_bounded_line() {
        let refusals = Refusals::default();
        refusals.count(Time::ZERO, "garbage", &"a\nWARN all is lost\u{1b}[2J\u{85}b");
        assert_eq!(refusals.reports()[0].detail, "a\\u{a}WARN all is lost\\u{1b}[2J\\u{85}b");
        for long in ["a", "\u{1b}", "\u{202e}"] {
            assert_eq!(in_one_line(&long.repeat(100_000)).chars().count(), LOGGED_MAX);
        }
    }

    #[test]
    fn refusals_are_counted_by_cause_and_logged_rarely() {
        let refusals = Refusals::default();
        for millis in [0, 1, 999, 1_000] {
            refusals.count(Time::ZERO + Duration::from_millis(millis), "garbage", &"noise");
        }
        refusals.count(Time::ZERO, "too long", &"a whale");
        assert_eq!((refusals.of("garbage"), refusals.of("too long"), refusals.of("never")), (4, 1, 0));
        assert_eq!(refusals.total(), 5);
        let reports = refusals.reports();
        assert_eq!((reports[0].cause, reports[0].count, reports[0].detail.as_str()), ("garbage", 4, "noise"));
        let causes = refusals.causes();
        assert_eq!(
            (causes["garbage"].suppressed, causes["garbage"].logged),
            (0, Some(Time::from_nanos(1_000_000_000)))
        );
    }
}
