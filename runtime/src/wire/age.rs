//! The error of a message's send time, in the 16 header bits that a session between two nodes no longer needs
//! then. So each message carries it, also to other processes of the host, without a query.

use std::time::Duration;

use super::Header;
use crate::time::Time;

/// The value of these bits for an unknown error.
const UNKNOWN: u16 = u16::MAX;
/// The unit is milliseconds from here on, microseconds below it.
const MILLIS: u16 = 1 << 15;

impl Header {
    /// Returns the maximum error of `sent`, after a node has converted it to the clock of this host: zero for
    /// a message of this host, `None` if the clock of the sender's host was not measured. Errors below 33 ms
    /// are in whole microseconds, larger ones in whole milliseconds, rounded up.
    #[must_use]
    pub const fn sent_error(&self) -> Option<Duration> {
        match self.number {
            UNKNOWN => None,
            micros @ 0..MILLIS => Some(Duration::from_micros(micros as u64)),
            millis => Some(Duration::from_millis((millis - MILLIS) as u64)),
        }
    }

    /// Sets the error of `sent`; an error above 32 s counts as unknown.
    pub fn set_sent_error(&mut self, error: Option<Duration>) {
        self.number = error.map_or(UNKNOWN, |error| {
            // In 64 bits: the division of 128 bits is slow, and this runs for each message between nodes.
            let nanos = u64::try_from(error.as_nanos()).unwrap_or(u64::MAX);
            let in_micros = u16::try_from(nanos.div_ceil(1_000)).ok().filter(|micros| *micros < MILLIS);
            let in_millis =
                || u16::try_from(nanos.div_ceil(1_000_000)).ok().filter(|millis| *millis < UNKNOWN - MILLIS);
            in_micros.or_else(|| Some(MILLIS + in_millis()?)).unwrap_or(UNKNOWN)
        });
    }

    /// Returns when the message was sent, in this host's clock; `None` if that is unknown.
    #[must_use]
    pub const fn known_sent(&self) -> Option<Time> {
        if self.number == UNKNOWN { None } else { Some(self.sent) }
    }

    /// Returns the time from sending to `now`, with the error [`sent_error`](Self::sent_error); `None` if it
    /// is unknown.
    #[must_use]
    pub const fn age(&self, now: Time) -> Option<Duration> {
        if self.number == UNKNOWN { None } else { Some(now.since(self.sent)) }
    }

    /// Returns the maximum age at `now`: the age plus its error; `None` if it is unknown.
    #[must_use]
    pub fn age_at_most(&self, now: Time) -> Option<Duration> {
        Some(self.age(now)?.saturating_add(self.sent_error()?))
    }
}

/// Returns whether a message of this maximum age may be older than `limit`. An unknown age may be.
#[must_use]
pub fn may_be_older(age_at_most: Option<Duration>, limit: Duration) -> bool {
    age_at_most.is_none_or(|age| age > limit)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::{tid::Tid, wire::Kind};

    fn header(error: Option<Duration>) -> Header {
        let mut header = Header::new(Kind::PING, Tid::NONE, Tid::NONE);
        header.sent = Time::from_nanos(1_000);
        header.set_sent_error(error);
        header
    }

    proptest! {
        #[test]
        fn error_is_never_rounded_down(nanos in prop_oneof![any::<u64>(), 0..100_000_000u64, 0..100_000_000_000u64]) {
            let error = Duration::from_nanos(nanos);
            match header(Some(error)).sent_error() {
                Some(said) => {
                    let coarse = if nanos < 32_000_000 { Duration::from_micros(1) } else { Duration::from_millis(1) };
                    prop_assert!(said >= error && said - error < coarse, "{said:?}");
                }
                None => prop_assert!(error > Duration::from_secs(32)),
            }
        }
    }

    #[test]
    fn message_of_this_host_has_its_exact_age() {
        let header =
            Header { sent: Time::from_nanos(1_000), ..Header::new(Kind::PING, Tid::NONE, Tid::NONE) };
        let now = Time::from_nanos(5_000);
        assert_eq!(header.sent_error(), Some(Duration::ZERO));
        let age = Some(Duration::from_nanos(4_000));
        assert_eq!(
            (header.known_sent(), header.age(now), header.age_at_most(now)),
            (Some(header.sent), age, age)
        );
    }

    #[test]
    fn unknown_age_is_none_and_exceeds_every_limit() {
        let (header, now) = (header(None), Time::from_nanos(5_000));
        assert_eq!((header.sent_error(), header.known_sent()), (None, None));
        assert_eq!((header.age(now), header.age_at_most(now)), (None, None));
        assert!(may_be_older(header.age_at_most(now), Duration::MAX));
    }

    #[test]
    fn message_exceeds_a_limit_if_it_may() {
        let (header, now) = (header(Some(Duration::from_micros(2))), Time::from_nanos(5_000));
        assert_eq!(header.age(now), Some(Duration::from_micros(4)));
        let may_be_older = |micros| may_be_older(header.age_at_most(now), Duration::from_micros(micros));
        assert!(may_be_older(5) && !may_be_older(6));
    }
}
