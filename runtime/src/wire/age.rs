//! How wrong a message's send time may be, in the 16 bits of the header that a session between two nodes has used up by then: so each message
//! carries it, to other processes of the host too, and nobody is asked.

use std::time::Duration;

use super::Header;
use crate::time::Time;

/// In these bits: it is not known.
const UNKNOWN: u16 = u16::MAX;
/// From here on milliseconds, below it microseconds.
const MILLIS: u16 = 1 << 15;

impl Header {
    /// The error of `sent` at most, where a node has turned it into the clock of this host: zero for what was sent on this host, `None`
    /// where nobody has measured the clock of the sender's host. Less than 33 ms is said in whole microseconds, more in whole milliseconds,
    /// rounded up.
    #[must_use]
    pub const fn sent_error(&self) -> Option<Duration> {
        match self.number {
            UNKNOWN => None,
            micros @ 0..MILLIS => Some(Duration::from_micros(micros as u64)),
            millis => Some(Duration::from_millis((millis - MILLIS) as u64)),
        }
    }

    /// Says how wrong `sent` may be; one that may be wrong by more than 32 s is not known.
    pub fn set_sent_error(&mut self, error: Option<Duration>) {
        self.number = error.map_or(UNKNOWN, |error| {
            let in_micros =
                u16::try_from(error.as_nanos().div_ceil(1_000)).ok().filter(|micros| *micros < MILLIS);
            let in_millis = || {
                u16::try_from(error.as_nanos().div_ceil(1_000_000))
                    .ok()
                    .filter(|millis| *millis < UNKNOWN - MILLIS)
            };
            in_micros.or_else(|| Some(MILLIS + in_millis()?)).unwrap_or(UNKNOWN)
        });
    }

    /// When it was sent, in this host's clock; `None` where that is not known.
    #[must_use]
    pub const fn known_sent(&self) -> Option<Time> {
        if self.number == UNKNOWN { None } else { Some(self.sent) }
    }

    /// Time from sending to `now`, as wrong as [`sent_error`](Self::sent_error) says; `None` where it is not known.
    #[must_use]
    pub const fn age(&self, now: Time) -> Option<Duration> {
        if self.number == UNKNOWN { None } else { Some(now.since(self.sent)) }
    }

    /// The greatest age that it can have at `now`: its age and the error of that; `None` where it is not known.
    #[must_use]
    pub fn age_at_most(&self, now: Time) -> Option<Duration> {
        Some(self.age(now)?.saturating_add(self.sent_error()?))
    }
}

/// Whether something of this greatest age may be older than `limit`. What has an unknown age may be.
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
        fn an_error_is_never_said_to_be_smaller(nanos in prop_oneof![any::<u64>(), 0..100_000_000u64, 0..100_000_000_000u64]) {
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
    fn what_was_sent_on_this_host_has_the_age_that_it_has() {
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
    fn an_unknown_age_is_none_and_older_than_every_limit() {
        let (header, now) = (header(None), Time::from_nanos(5_000));
        assert_eq!((header.sent_error(), header.known_sent()), (None, None));
        assert_eq!((header.age(now), header.age_at_most(now)), (None, None));
        assert!(may_be_older(header.age_at_most(now), Duration::MAX));
    }

    #[test]
    fn a_message_is_older_than_a_limit_if_it_may_be() {
        let (header, now) = (header(Some(Duration::from_micros(2))), Time::from_nanos(5_000));
        assert_eq!(header.age(now), Some(Duration::from_micros(4)));
        let may_be_older = |micros| may_be_older(header.age_at_most(now), Duration::from_micros(micros));
        assert!(may_be_older(5) && !may_be_older(6));
    }
}
