//! A rate limiter: a sustained rate and a burst, for one source or for each of many. Pure.
//!
//! It is the generic cell rate algorithm in its form of virtual scheduling (ITU-T Recommendation I.371, annex
//! A). It admits the same events as a token bucket that fills continuously, and its state is one time.
//!
//! The crate `governor` has the same algorithm, and does not fit: it reads a clock of its own, its table of
//! keys has no bound, and it cannot delay an event that is over the limit, which several places here do.

use std::{collections::BTreeMap, time::Duration};

use sinew_runtime::time::Time;

/// A sustained rate, and how far a burst may exceed it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Rate {
    /// Time in which one more event becomes available: the increment *T* of I.371.
    pub interval: Duration,
    /// Time by which an event may be early: the limit *τ* of I.371.
    pub tolerance: Duration,
}

impl Rate {
    /// Returns the rate of one event in each `interval`, with `burst` events at once; at least one.
    #[must_use]
    pub const fn new(interval: Duration, burst: u32) -> Self {
        Self { interval, tolerance: interval.saturating_mul(burst.saturating_sub(1)) }
    }
}

/// The limiter of one source.
#[derive(Clone, Copy, Debug)]
pub struct RateLimiter {
    rate: Rate,
    /// The theoretical arrival time of the next event: when a source that always keeps to the rate sends it.
    due: Time,
}

impl RateLimiter {
    /// Creates a limiter with an available burst.
    #[must_use]
    pub const fn new(rate: Rate) -> Self {
        Self { rate, due: Time::ZERO }
    }

    /// Creates a limiter without an available burst at `now`.
    fn used_up(rate: Rate, now: Time) -> Self {
        Self { rate, due: now + rate.tolerance + rate.interval }
    }

    /// Returns how long an event at `now` is early. Zero: it keeps to the limit.
    #[must_use]
    pub fn delay(&self, now: Time) -> Duration {
        self.due.since(now).saturating_sub(self.rate.tolerance)
    }

    /// Counts an event at `now` if it keeps to the limit. Returns whether it does.
    pub fn try_take(&mut self, now: Time) -> bool {
        let is_admitted = self.delay(now).is_zero();
        if is_admitted {
            self.charge(now, self.rate.interval, Duration::MAX);
        }
        is_admitted
    }

    /// Counts an event at `now` that is delayed and not refused. Its cost is the time in which it becomes
    /// available again. Later events are [delayed](Self::delay) at most by `delay_max`.
    pub fn charge(&mut self, now: Time, cost: Duration, delay_max: Duration) {
        self.due = (self.due.max(now) + cost).min(now + self.rate.tolerance + delay_max);
    }

    /// Returns whether the whole burst is available at `now`.
    fn is_unused(&self, now: Time) -> bool {
        self.due <= now
    }
}

/// The rule for a new key of a full table.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WhenFull {
    /// Keys with their whole burst leave, which loses nothing. If there are none, all further keys share one
    /// limiter.
    Share,
    /// The key that has used the least of its burst leaves.
    EvictLeastUsed,
    /// The key that has used the most of its burst leaves, so keys with rare events stay. If all keys have
    /// their whole burst, the new key is refused. Each new key begins without a burst, as it may have left
    /// before.
    EvictMostUsed,
}

/// A limiter for each key, in a bounded table.
#[derive(Debug)]
pub struct KeyedRateLimiter<K> {
    rate: Rate,
    keys_max: usize,
    when_full: WhenFull,
    keys: BTreeMap<K, RateLimiter>,
    /// The limiter of all keys without a place in the table.
    others: RateLimiter,
}

impl<K: Ord + Clone> KeyedRateLimiter<K> {
    /// Creates an empty table for `keys_max` keys. Each key has this rate.
    #[must_use]
    pub const fn new(rate: Rate, keys_max: usize, when_full: WhenFull) -> Self {
        Self { rate, keys_max, when_full, keys: BTreeMap::new(), others: RateLimiter::new(rate) }
    }

    /// Returns the limiter of `key` at `now`, a new one if the table does not have it.
    pub fn of(&mut self, key: &K, now: Time) -> &mut RateLimiter {
        if !self.keys.contains_key(key) {
            let refuses = self.when_full == WhenFull::EvictMostUsed;
            let new =
                if refuses { RateLimiter::used_up(self.rate, now) } else { RateLimiter::new(self.rate) };
            if self.make_room(now) {
                self.keys.insert(key.clone(), new);
            } else if refuses {
                self.others = new;
            }
        }
        self.keys.get_mut(key).unwrap_or(&mut self.others)
    }

    /// Returns whether the table has `key`.
    #[must_use]
    pub fn has(&self, key: &K) -> bool {
        self.keys.contains_key(key)
    }

    /// Returns the number of keys in the table.
    #[must_use]
    pub fn len(&self) -> usize {
        self.keys.len()
    }

    /// Returns whether the table is empty.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.keys.is_empty()
    }

    /// Removes a key that will not come back.
    pub fn remove(&mut self, key: &K) {
        self.keys.remove(key);
    }

    /// Returns whether the table has room for one more key, after a key has left if necessary.
    fn make_room(&mut self, now: Time) -> bool {
        if self.keys.len() < self.keys_max {
            return true;
        }
        let leaves = match self.when_full {
            WhenFull::Share => {
                self.keys.retain(|_, limiter| !limiter.is_unused(now));
                return self.keys.len() < self.keys_max;
            }
            WhenFull::EvictLeastUsed => self.keys.iter().min_by_key(|(_, limiter)| limiter.due),
            WhenFull::EvictMostUsed => self
                .keys
                .iter()
                .max_by_key(|(_, limiter)| limiter.due)
                .filter(|(_, limiter)| !limiter.is_unused(now)),
        };
        let leaves = leaves.map(|(key, _)| key.clone());
        leaves.is_some_and(|key| self.keys.remove(&key).is_some())
    }
}

#[cfg(test)]
mod tests {
    use proptest::{collection::vec, prelude::*};

    use super::*;

    const MILLI: Duration = Duration::from_millis(1);
    /// 100 events per second, 5 at once.
    const RATE: Rate = Rate::new(Duration::from_millis(10), 5);
    const BURST: u64 = 5;
    const KEYS_MAX: usize = 8;

    fn at(millis: u64) -> Time {
        Time::ZERO + Duration::from_secs(1) + Duration::from_millis(millis)
    }

    /// A token bucket, with tokens in parts of a nanosecond of filling time.
    struct TokenBucket {
        tokens_ns: u64,
        filled: Time,
    }

    impl TokenBucket {
        fn try_take(&mut self, now: Time) -> bool {
            let each = RATE.interval.as_nanos() as u64;
            let gained = now.since(self.filled).as_nanos() as u64;
            (self.tokens_ns, self.filled) = ((self.tokens_ns + gained).min(each * BURST), now);
            let is_there = self.tokens_ns >= each;
            self.tokens_ns -= if is_there { each } else { 0 };
            is_there
        }
    }

    fn times(gaps_us: Vec<u64>) -> impl Iterator<Item = Time> {
        gaps_us.into_iter().scan(at(0), |now, gap| {
            *now = *now + Duration::from_micros(gap);
            Some(*now)
        })
    }

    proptest! {
        #[test]
        fn admitted_events_never_exceed_burst_and_rate(gaps_us in vec(0u64..30_000, 1..300)) {
            let mut limiter = RateLimiter::new(RATE);
            let admitted: Vec<_> = times(gaps_us).filter(|now| limiter.try_take(*now)).collect();
            // In each window, not only from the begin on.
            for (first, begin) in admitted.iter().enumerate() {
                for (last, end) in admitted.iter().enumerate().skip(first) {
                    let most = BURST + (end.since(*begin).as_nanos() / RATE.interval.as_nanos()) as u64;
                    prop_assert!(((last - first) as u64) < most, "{first} to {last}");
                }
            }
        }

        #[test]
        fn each_event_is_admitted_as_by_a_token_bucket(gaps_us in vec(0u64..30_000, 1..300)) {
            let mut limiter = RateLimiter::new(RATE);
            let full = RATE.interval.as_nanos() as u64 * BURST;
            let mut bucket = TokenBucket { tokens_ns: full, filled: Time::ZERO };
            for now in times(gaps_us) {
                prop_assert_eq!(limiter.try_take(now), bucket.try_take(now), "at {:?}", now);
            }
        }

        #[test]
        fn delayed_event_keeps_the_limit_after_its_delay(gaps_us in vec(0u64..30_000, 1..300)) {
            let mut limiter = RateLimiter::new(RATE);
            for now in times(gaps_us) {
                let delay = limiter.delay(now);
                prop_assert!(delay.is_zero() || !limiter.try_take(now + delay - Duration::from_nanos(1)));
                prop_assert!(limiter.clone().try_take(now + delay));
                limiter.charge(now, RATE.interval, Duration::from_secs(1));
                prop_assert!(limiter.delay(now) <= Duration::from_secs(1));
            }
        }

        #[test]
        fn table_is_bounded_by_each_rule(events in vec((0u8..40, 0u64..20_000), 1..300)) {
            for when_full in [WhenFull::Share, WhenFull::EvictLeastUsed, WhenFull::EvictMostUsed] {
                let (mut now, mut keyed) = (at(0), KeyedRateLimiter::new(RATE, KEYS_MAX, when_full));
                for (key, gap) in &events {
                    now = now + Duration::from_micros(*gap);
                    keyed.of(key, now).try_take(now);
                    prop_assert!(keyed.len() <= KEYS_MAX, "{when_full:?}");
                    prop_assert!(when_full != WhenFull::EvictLeastUsed || keyed.has(key));
                }
            }
        }
    }

    /// Fills a table. Key 0 has used one event, key 1 two, all others the whole burst.
    fn full(when_full: WhenFull) -> KeyedRateLimiter<usize> {
        let mut keyed = KeyedRateLimiter::new(RATE, KEYS_MAX, when_full);
        for key in 0..KEYS_MAX {
            // A key of `EvictMostUsed` has its burst later.
            keyed.of(&key, at(0));
            let count = key + 1;
            let used = (0..count.min(5)).filter(|_| keyed.of(&key, at(50)).try_take(at(50))).count();
            assert_eq!(used, count.min(5));
        }
        keyed
    }

    #[test]
    fn shared_table_gives_further_keys_one_burst_together() {
        let mut keyed = full(WhenFull::Share);
        let admitted = (100..200).filter(|key| keyed.of(key, at(50)).try_take(at(50))).count();
        assert_eq!(admitted, 5);
        assert_eq!(keyed.len(), KEYS_MAX);
        // Key 0 has its whole burst again after one interval, and leaves.
        assert!(keyed.of(&100, at(60)).try_take(at(60)));
        assert!(keyed.has(&100) && !keyed.has(&0));
    }

    #[test]
    fn least_used_key_leaves_for_a_new_one() {
        let mut keyed = full(WhenFull::EvictLeastUsed);
        assert!(keyed.of(&100, at(50)).try_take(at(50)));
        assert!(keyed.has(&100) && !keyed.has(&0) && keyed.has(&1));
    }

    #[test]
    fn most_used_key_leaves_and_rare_ones_stay() {
        let mut keyed = full(WhenFull::EvictMostUsed);
        let admitted = (100..200).filter(|key| keyed.of(key, at(50)).try_take(at(50))).count();
        assert_eq!(admitted, 0, "new keys begin without a burst");
        assert!(keyed.has(&0) && keyed.has(&1));
        // All keys have their whole burst again.
        assert!(!keyed.of(&300, at(1_000)).try_take(at(1_000)));
        assert!(!keyed.has(&300) && keyed.len() == KEYS_MAX);
    }

    #[test]
    fn cost_and_longest_delay_are_the_callers() {
        let mut limiter = RateLimiter::new(RATE);
        limiter.charge(at(0), MILLI * 40, Duration::MAX);
        assert_eq!(limiter.delay(at(0)), Duration::ZERO);
        limiter.charge(at(0), MILLI * 7, Duration::MAX);
        assert_eq!([0, 7].map(|millis| limiter.delay(at(millis))), [MILLI * 7, Duration::ZERO]);
        limiter.charge(at(0), Duration::MAX, MILLI * 100);
        assert_eq!(limiter.delay(at(0)), MILLI * 100);
    }
}
