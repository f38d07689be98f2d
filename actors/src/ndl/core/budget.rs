//! What a flood may cost: a token bucket for each source address, and one for all strangers together.

use std::{collections::BTreeMap, net::IpAddr};

use sinew_runtime::time::Time;

/// Tokens of a bucket: one for each datagram.
#[derive(Clone, Copy, Debug)]
pub(super) struct Rate {
    /// Datagrams a second, for good.
    pub(super) per_second: u64,
    /// Datagrams at once, after silence.
    pub(super) burst: u64,
}

/// One stranger's address.
pub(super) const STRANGER: Rate = Rate { per_second: 50, burst: 100 };
/// All strangers together.
pub(super) const STRANGERS: Rate = Rate { per_second: 1_000, burst: 1_000 };
/// A member or a seed: 300 a second come from one whose period is the shortest, 10 ms.
pub(super) const KNOWN: Rate = Rate { per_second: 500, burst: 500 };

/// Strangers' addresses that are told apart; the one that was silent longest makes room.
const STRANGERS_MAX: usize = 1_024;

/// A bucket that fills with time and empties with each datagram.
#[derive(Debug)]
pub(super) struct Bucket {
    rate: Rate,
    /// In nanoseconds of filling time, so that nothing is lost to rounding.
    credit_ns: u64,
    filled: Time,
}

impl Bucket {
    pub(super) const fn full(rate: Rate, now: Time) -> Self {
        Self { rate, credit_ns: Self::cost(rate) * rate.burst, filled: now }
    }

    const fn cost(rate: Rate) -> u64 {
        1_000_000_000 / rate.per_second
    }

    /// Takes one token, if there is one.
    pub(super) fn take(&mut self, now: Time) -> bool {
        let cost = Self::cost(self.rate);
        let gained = u64::try_from(now.since(self.filled).as_nanos()).unwrap_or(u64::MAX);
        self.credit_ns = self.credit_ns.saturating_add(gained).min(cost * self.rate.burst);
        self.filled = self.filled.max(now);
        let there = self.credit_ns >= cost;
        if there {
            self.credit_ns -= cost;
        }
        there
    }
}

/// The budget of addresses that nobody knows.
#[derive(Debug)]
pub(super) struct Strangers {
    all: Bucket,
    each: BTreeMap<IpAddr, Bucket>,
}

impl Strangers {
    pub(super) const fn new(now: Time) -> Self {
        Self { all: Bucket::full(STRANGERS, now), each: BTreeMap::new() }
    }

    /// Whether a datagram from `ip` may cost anything. // spec: NDL-7.2
    pub(super) fn admit(&mut self, now: Time, ip: IpAddr) -> bool {
        // Its own bucket first, so that one loud address does not empty the common one.
        if let Some(own) = self.each.get_mut(&ip) {
            return own.take(now) && self.all.take(now);
        }
        if !self.all.take(now) {
            return false;
        }
        self.make_room();
        let mut own = Bucket::full(STRANGER, now);
        own.take(now);
        self.each.insert(ip, own);
        true
    }

    /// Whether something that did not come as a datagram may cost anything.
    pub(super) fn admit_any(&mut self, now: Time) -> bool {
        self.all.take(now)
    }

    fn make_room(&mut self) {
        if self.each.len() < STRANGERS_MAX {
            return;
        }
        if let Some(quietest) = self.each.iter().min_by_key(|(_, bucket)| bucket.filled).map(|(ip, _)| *ip) {
            self.each.remove(&quietest);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::{net::Ipv4Addr, time::Duration};

    use proptest::prelude::*;

    use super::*;

    fn ip(bits: u32) -> IpAddr {
        Ipv4Addr::from(bits).into()
    }

    #[test]
    fn a_loud_address_gets_its_burst_then_its_rate() {
        let mut strangers = Strangers::new(Time::ZERO);
        let admitted = (0..10_000).filter(|_| strangers.admit(Time::ZERO, ip(1))).count();
        assert_eq!(admitted, 100);
        let second = Time::ZERO + Duration::from_secs(1);
        let admitted = (0..10_000).filter(|_| strangers.admit(second, ip(1))).count();
        assert_eq!(admitted, 50);
    }

    #[test]
    fn a_loud_address_leaves_room_for_others() {
        let mut strangers = Strangers::new(Time::ZERO);
        let _ = (0..1_000_000).filter(|_| strangers.admit(Time::ZERO, ip(1))).count();
        assert!(strangers.admit(Time::ZERO, ip(2)));
    }

    #[test]
    fn forged_addresses_share_one_budget_and_a_bounded_table() {
        let mut strangers = Strangers::new(Time::ZERO);
        let admitted = (0..100_000).filter(|bits| strangers.admit(Time::ZERO, ip(*bits))).count();
        assert_eq!(admitted, 1_000);
        let later = Time::ZERO + Duration::from_secs(1);
        let _ = (0..100_000).filter(|bits| strangers.admit(later, ip(1 << 20 | bits))).count();
        assert!(strangers.each.len() <= STRANGERS_MAX);
    }

    proptest! {
        #[test]
        fn no_pattern_of_arrivals_gets_more_than_burst_and_rate(
            gaps_us in proptest::collection::vec(0u64..100_000, 1..500),
        ) {
            let mut bucket = Bucket::full(STRANGER, Time::ZERO);
            let (mut now, mut taken) = (Time::ZERO, 0);
            for gap in gaps_us {
                now = now + Duration::from_micros(gap);
                taken += u64::from(bucket.take(now));
            }
            prop_assert!(taken <= STRANGER.burst + STRANGER.per_second * now.as_nanos() / 1_000_000_000 + 1);
        }
    }
}
