//! Rate limits against floods: one for each unknown source address, and one for all of them.

use std::{net::IpAddr, time::Duration};

use sinew_model::rate_limiter::{KeyedRateLimiter, Rate, RateLimiter, WhenFull};
use sinew_runtime::time::Time;

/// Rate of one unknown address: 50 datagrams per second, 100 at once.
pub(super) const UNKNOWN_EACH: Rate = Rate::new(Duration::from_millis(20), 100);
/// Rate of all unknown addresses together: 1,000 datagrams per second, 1,000 at once.
pub(super) const UNKNOWN_ALL: Rate = Rate::new(Duration::from_millis(1), 1_000);
/// Rate of a member or a seed: 500 datagrams per second, 500 at once. A node with the shortest period, 10 ms,
/// sends 300 a second.
pub(super) const KNOWN: Rate = Rate::new(Duration::from_millis(2), 500);

/// Maximum number of unknown addresses with a limiter of their own.
const UNKNOWN_MAX: usize = 1_024;

/// The limits of unknown addresses.
#[derive(Debug)]
pub(super) struct UnknownAddressLimits {
    all: RateLimiter,
    each: KeyedRateLimiter<IpAddr>,
}

impl UnknownAddressLimits {
    pub(super) const fn new() -> Self {
        let each = KeyedRateLimiter::new(UNKNOWN_EACH, UNKNOWN_MAX, WhenFull::EvictLeastUsed);
        Self { all: RateLimiter::new(UNKNOWN_ALL), each }
    }

    /// Returns whether a datagram from `ip` is processed. // spec: NDL-7.2
    pub(super) fn admit(&mut self, now: Time, ip: IpAddr) -> bool {
        // A new address gets no place in the table by a datagram that the common budget refuses.
        if !self.each.has(&ip) && !self.all.delay(now).is_zero() {
            return false;
        }
        // The address's own limit is checked first, so that one address cannot use up the common budget.
        self.each.of(&ip, now).try_take(now) && self.all.try_take(now)
    }

    /// Returns whether an input other than a datagram is processed.
    pub(super) fn admit_any(&mut self, now: Time) -> bool {
        self.all.try_take(now)
    }
}

#[cfg(test)]
mod tests {
    use std::net::Ipv4Addr;

    use super::*;

    fn ip(bits: u32) -> IpAddr {
        Ipv4Addr::from(bits).into()
    }

    #[test]
    fn loud_address_gets_its_burst_then_its_rate() {
        let mut limits = UnknownAddressLimits::new();
        let admitted = (0..10_000).filter(|_| limits.admit(Time::ZERO, ip(1))).count();
        assert_eq!(admitted, 100);
        let second = Time::ZERO + Duration::from_secs(1);
        let admitted = (0..10_000).filter(|_| limits.admit(second, ip(1))).count();
        assert_eq!(admitted, 50);
    }

    #[test]
    fn loud_address_leaves_room_for_others() {
        let mut limits = UnknownAddressLimits::new();
        let _ = (0..1_000_000).filter(|_| limits.admit(Time::ZERO, ip(1))).count();
        assert!(limits.admit(Time::ZERO, ip(2)));
    }

    #[test]
    fn forged_addresses_share_one_budget_and_a_bounded_table() {
        let mut limits = UnknownAddressLimits::new();
        let admitted = (0..100_000).filter(|bits| limits.admit(Time::ZERO, ip(*bits))).count();
        assert_eq!(admitted, 1_000);
        let later = Time::ZERO + Duration::from_secs(1);
        let _ = (0..100_000).filter(|bits| limits.admit(later, ip(1 << 20 | bits))).count();
        assert!(limits.each.len() <= UNKNOWN_MAX);
    }
}
