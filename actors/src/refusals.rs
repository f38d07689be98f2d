//! What was refused, counted for each cause, and logged at most once a second for each.

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

/// A peer that sends rubbish at line rate costs one log line a second, not a full disk.
const LOG_PERIOD: Duration = Duration::from_secs(1);
/// What is kept of a detail, in characters: a peer's own words may be among it.
const DETAIL_MAX: usize = 256;
/// What of a detail is in the log at most, in characters: the longest sentence of this program, and a peer's in it.
const LOGGED_MAX: usize = 1_024;
/// Causes that belong to ordinary starts, stops and restarts of nodes. They are counted as all are, and nobody is warned.
const ORDINARY: [&str; 8] = [
    // Two nodes have dialled each other at once: one of the two connections stays.
    "duplicate",
    "duplicate at the peer",
    // A node that is being stopped takes no further connection.
    "leaving",
    "the peer leaves",
    // The last datagrams of a life that has just ended, or to one.
    "datagram of a stranger",
    "datagram with another key",
    "datagram of a life that is over",
    PEER_GONE,
];

/// Counters of refusals. The causes are literals of this program, so their number is bounded.
#[derive(Debug, Default)]
pub(crate) struct Refusals {
    causes: Mutex<BTreeMap<&'static str, Cause>>,
    /// What the access list has refused: senders count that, of whom many may be in a hurry.
    by_list: AtomicU64,
    /// When that is logged next at the earliest, in nanoseconds.
    by_list_next: AtomicU64,
}

/// The cause under which messages are counted that the access list refuses.
pub(crate) const BY_LIST: &str = "access list";

/// The cause under which frames of a layer are counted that a peer was not sent as it is being stopped, or is lost.
pub(crate) const PEER_GONE: &str = "peer gone";

#[derive(Debug, Default)]
struct Cause {
    count: u64,
    logged: Option<Time>,
    suppressed: u64,
    /// What the last one was about that was logged.
    detail: String,
}

/// What was refused because of one cause, for whoever asks.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Told {
    pub(crate) cause: &'static str,
    pub(crate) count: u64,
    /// What the last one was about that was logged, and when.
    pub(crate) detail: String,
    pub(crate) at: Time,
}

impl Refusals {
    /// Counts one refusal because of `cause`, and logs it with its `detail` unless that cause was logged within the
    /// last second.
    pub(crate) fn count(&self, now: Time, cause: &'static str, detail: &dyn Display) {
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
        // Whoever reads the log may be slow: nobody waits for it with the lock in hand.
        drop(causes);
        if ORDINARY.contains(&cause) {
            crate::log::debug!(cause, suppressed, "refused: {detail}");
        } else {
            crate::log::warn!(cause, suppressed, "refused: {detail}");
        }
    }

    /// Counts a message that the access list refuses, without a lock.
    pub(crate) fn count_by_list(&self) {
        // SYNC: Relaxed; a count, which nothing hangs on.
        self.by_list.fetch_add(1, Ordering::Relaxed);
    }

    /// Whether one of those is to be logged at `now`: to one of all that ask in a second.
    pub(crate) fn logs_by_list(&self, now: Time) -> bool {
        let next = self.by_list_next.load(Ordering::Relaxed);
        let then = now + LOG_PERIOD;
        // SYNC: Relaxed; of several one changes it, whoever sees what else.
        now.as_nanos() >= next
            && self
                .by_list_next
                .compare_exchange(next, then.as_nanos(), Ordering::Relaxed, Ordering::Relaxed)
                .is_ok()
    }

    /// How much was refused.
    pub(crate) fn total(&self) -> u64 {
        self.causes().values().map(|cause| cause.count).sum()
    }

    /// How much was refused, for each cause.
    pub(crate) fn by_cause(&self) -> Vec<(&'static str, u64)> {
        self.causes().iter().map(|(cause, entry)| (*cause, entry.count)).collect()
    }

    /// What was refused, for each cause, with the last one of each that was logged.
    pub(crate) fn told(&self) -> Vec<Told> {
        let causes = self.causes();
        let told = causes.iter().filter_map(|(cause, entry)| {
            let Cause { count, ref detail, logged, .. } = *entry;
            Some(Told { cause, count, detail: detail.clone(), at: logged? })
        });
        told.collect()
    }

    /// How much was refused because of `cause`.
    #[cfg(test)]
    pub(crate) fn of(&self, cause: &'static str) -> u64 {
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

/// A detail as it is logged: nobody who has words of his in it ends its line or does things to a terminal, nor makes it longer than that.
fn in_one_line(detail: &dyn Display) -> String {
    let words = detail.to_string();
    let is_plain = |character: char| !is_invisible(character);
    let escaped = words.chars().flat_map(|character| {
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
    fn words_from_outside_stay_in_one_line_of_a_length() {
        let refusals = Refusals::default();
        refusals.count(Time::ZERO, "garbage", &"a\nWARN all is lost\u{1b}[2J\u{85}b");
        assert_eq!(refusals.told()[0].detail, "a\\u{a}WARN all is lost\\u{1b}[2J\\u{85}b");
        for long in ["a", "\u{1b}", "\u{202e}"] {
            assert_eq!(in_one_line(&long.repeat(100_000)).chars().count(), LOGGED_MAX);
        }
    }

    #[test]
    fn every_refusal_is_counted_for_its_cause_and_one_a_second_is_logged() {
        let refusals = Refusals::default();
        for millis in [0, 1, 999, 1_000] {
            refusals.count(Time::ZERO + Duration::from_millis(millis), "garbage", &"noise");
        }
        refusals.count(Time::ZERO, "too long", &"a whale");
        assert_eq!((refusals.of("garbage"), refusals.of("too long"), refusals.of("never")), (4, 1, 0));
        assert_eq!(refusals.total(), 5);
        let told = refusals.told();
        assert_eq!((told[0].cause, told[0].count, told[0].detail.as_str()), ("garbage", 4, "noise"));
        let causes = refusals.causes();
        assert_eq!(
            (causes["garbage"].suppressed, causes["garbage"].logged),
            (0, Some(Time::from_nanos(1_000_000_000)))
        );
    }
}
