//! When a certificate counts, for a machine whose clock may not be set.
//!
//! A robot without a battery for its clock boots in 1970, and finds the time later, or never. Its own certificate was made before it
//! booted: so a clock that shows an earlier time than that is known to be wrong. What then counts is the configuration's to say
//! (`security.times`), and whoever judges is told, so that it is never silent.

use std::{
    fmt,
    time::{Duration, SystemTime},
};

use rustls::pki_types::UnixTime;

/// From when to when a certificate counts; both ends belong to it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Validity {
    /// Its first second.
    pub from: UnixTime,
    /// Its last one.
    pub until: UnixTime,
}

/// What the times of certificates are good for on a machine whose clock may be wrong.
///
/// # Examples
///
/// ```
/// use sinew::{NodeConfig, security::TimePolicy};
///
/// let mut config = NodeConfig::new("knee");
/// // GPS sets the clock of this host before Sinew starts.
/// config.security.times = TimePolicy::Strict;
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum TimePolicy {
    /// A certificate counts from its first to its last second. While the clock is known not to be set none counts: no link is made.
    Strict,
    /// The same, but while the clock is known not to be set a certificate counts that had not ended when this node's own was made.
    /// Who can set the clock back can then use a certificate that ended since; the deny list counts in any case.
    #[default]
    UntilSet,
    /// Times are not looked at; only the deny list ends a certificate.
    Ignored,
}

/// Why a certificate was taken, as to its times.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Judged {
    /// The clock is within its times.
    Valid,
    /// The clock is not set; it had not ended when this node's own was made ([`TimePolicy::UntilSet`]).
    ClockNotSet,
    /// Its times were not looked at ([`TimePolicy::Ignored`]).
    NotLookedAt,
}

/// Why a certificate does not count, as to its times.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum TimeFault {
    /// Its first second is to come: the clock here is behind, or that of the machine that made it ahead.
    #[error("it counts from {} on, and the clock here says {}; set the clocks of both machines (`sinew doctor`)", date(.from), date(.now))]
    NotYet {
        /// Its first second.
        from: UnixTime,
        /// The clock here.
        now: UnixTime,
    },
    /// Its last second is over.
    #[error("it ended on {}, and the clock here says {}; make a new one with `sinew keys issue`, and copy it there", date(.until), date(.now))]
    Over {
        /// Its last second.
        until: UnixTime,
        /// The clock here.
        now: UnixTime,
    },
    /// The clock here is known not to be set, and none counts until it is ([`TimePolicy::Strict`]).
    #[error(
        "the clock here says {}, but this node's own certificate was made on {}: the clock is not set; set it, or let \
         certificates count until it is (security.times = \"until-set\")", date(.now), date(.floor)
    )]
    ClockNotSet {
        /// The clock here.
        now: UnixTime,
        /// When this node's own certificate was made.
        floor: UnixTime,
    },
}

impl TimePolicy {
    /// How it is written in a configuration.
    #[must_use]
    pub const fn word(self) -> &'static str {
        match self {
            Self::Strict => "strict",
            Self::UntilSet => "until-set",
            Self::Ignored => "ignored",
        }
    }

    /// Judges a certificate at `now`; `floor` is a time that is certainly past: when this node's own certificate was made.
    ///
    /// # Errors
    /// It does not count, and why.
    pub fn judge(self, validity: Validity, now: UnixTime, floor: UnixTime) -> Result<Judged, TimeFault> {
        let Validity { from, until } = validity;
        match self {
            Self::Ignored => Ok(Judged::NotLookedAt),
            Self::Strict if now < floor => Err(TimeFault::ClockNotSet { now, floor }),
            Self::UntilSet if now < floor && until >= floor => Ok(Judged::ClockNotSet),
            Self::Strict | Self::UntilSet if now.max(floor) > until => Err(TimeFault::Over { until, now }),
            Self::Strict | Self::UntilSet if now < from => Err(TimeFault::NotYet { from, now }),
            Self::Strict | Self::UntilSet => Ok(Judged::Valid),
        }
    }
}

/// Time before a certificate's end from which on a node says so, in seconds: 30 days.
const LAST_DAYS: u64 = 30 * 24 * 3_600;

impl TimePolicy {
    /// What a node should say of the times of its `own` certificate at `now`: the clock is not set, times are not looked at, it ends soon or
    /// has ended.
    #[must_use]
    pub fn warning(self, own: Validity, now: UnixTime) -> Option<String> {
        let Validity { from: floor, until } = own;
        if self == Self::Ignored {
            let said = "the times of certificates are not looked at (security.times = \"ignored\"): only the deny list ends one";
            return Some(said.to_owned());
        }
        if now < floor {
            return Some(format!(
                "the clock says {}, but this node's certificate was made on {}: the clock is not set. Until it is, other \
                 nodes' certificates count that had not ended on that day",
                date(&now),
                date(&floor)
            ));
        }
        if now > until {
            return Some(format!(
                "this node's certificate has ended, on {}: links that stand are left alone, and one that breaks does not come back, as no \
                 other node takes it. Make a new one with `sinew keys issue`, and start the node with it",
                date(&until)
            ));
        }
        (until.as_secs() - now.as_secs() < LAST_DAYS).then(|| {
            format!(
                "this node's certificate ends on {}, and then no other node takes it: make a new one with `sinew keys issue`",
                date(&until)
            )
        })
    }
}

impl std::str::FromStr for TimePolicy {
    type Err = ();

    fn from_str(text: &str) -> Result<Self, ()> {
        [Self::Strict, Self::UntilSet, Self::Ignored]
            .into_iter()
            .find(|policy| policy.word() == text)
            .ok_or(())
    }
}

impl fmt::Display for Validity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} to {}", date(&self.from), date(&self.until))
    }
}

/// A point in time as text, in UTC: `2027-11-22T15:13:00Z`. What is later than the year 9999 is shown as its end.
#[must_use]
pub fn date(time: &UnixTime) -> String {
    const LAST: u64 = 253_402_300_799; // 9999-12-31T23:59:59Z
    let since_1970 = Duration::from_secs(time.as_secs().min(LAST));
    humantime::format_rfc3339_seconds(SystemTime::UNIX_EPOCH + since_1970).to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    const fn at(seconds: u64) -> UnixTime {
        UnixTime::since_unix_epoch(Duration::from_secs(seconds))
    }

    fn validity(from: u64, until: u64) -> Validity {
        Validity { from: at(from), until: at(until) }
    }

    #[test]
    fn every_policy_judges_every_case_as_it_says() {
        use Judged::{ClockNotSet, NotLookedAt, Valid};
        use TimePolicy::{Ignored, Strict, UntilSet};
        let (own, now) = (1_000, 5_000);
        let over = |now, until| TimeFault::Over { until: at(until), now: at(now) };
        let not_yet = |now, from| TimeFault::NotYet { from: at(from), now: at(now) };
        let not_set = |now| TimeFault::ClockNotSet { now: at(now), floor: at(own) };
        for (policy, now, from, until, judged) in [
            (Strict, now, 900, 9_000, Ok(Valid)),
            (Strict, now, now, 9_000, Ok(Valid)),
            (Strict, now, 900, now, Ok(Valid)),
            (Strict, now, now + 1, 9_000, Err(not_yet(now, now + 1))),
            (Strict, now, 900, now - 1, Err(over(now, now - 1))),
            (Strict, 7, 900, 9_000, Err(not_set(7))),
            (UntilSet, now, 900, 9_000, Ok(Valid)),
            (UntilSet, now, now + 1, 9_000, Err(not_yet(now, now + 1))),
            (UntilSet, now, 900, now - 1, Err(over(now, now - 1))),
            // In 1970: what ended before this node's own was made has certainly ended; of the rest nobody knows.
            (UntilSet, 7, 900, 9_000, Ok(ClockNotSet)),
            (UntilSet, 7, 4_000, 9_000, Ok(ClockNotSet)),
            (UntilSet, 7, 500, own, Ok(ClockNotSet)),
            (UntilSet, 7, 500, own - 1, Err(over(7, own - 1))),
            (UntilSet, own, own, 9_000, Ok(Valid)),
            (Ignored, 7, 500, 600, Ok(NotLookedAt)),
            (Ignored, now, 9_000, 9_001, Ok(NotLookedAt)),
        ] {
            let found = policy.judge(validity(from, until), at(now), at(own));
            assert_eq!(found, judged, "{policy:?} at {now}: {from} to {until}");
        }
    }

    #[test]
    fn a_clock_in_1970_is_told_with_both_dates_and_a_remedy() {
        let words = TimePolicy::Strict
            .judge(validity(1_700_000_000, 1_800_000_000), at(12), at(1_700_000_000))
            .unwrap_err()
            .to_string();
        for part in ["1970-01-01T00:00:12Z", "2023-11-14T22:13:20Z", "set it", "until-set"] {
            assert!(words.contains(part), "{words}");
        }
    }

    #[test]
    fn a_node_that_runs_on_says_that_its_certificate_ends_and_that_it_has_ended() {
        let until = 100 * 24 * 3_600;
        let said =
            |policy: TimePolicy, now| policy.warning(validity(1_000, until), at(now)).unwrap_or_default();
        for policy in [TimePolicy::Strict, TimePolicy::UntilSet] {
            assert!(said(policy, 7).contains("the clock is not set"));
            assert_eq!(said(policy, until - LAST_DAYS), "");
            assert!(said(policy, until - LAST_DAYS + 1).contains("ends on 1970-04-11"));
            assert!(said(policy, until + 1).contains("has ended, on 1970-04-11"));
        }
        assert!(said(TimePolicy::Ignored, until + 1).contains("not looked at"));
    }

    #[test]
    fn every_time_has_a_date() {
        assert_eq!(date(&at(0)), "1970-01-01T00:00:00Z");
        assert_eq!(date(&at(u64::MAX)), "9999-12-31T23:59:59Z");
    }

    #[test]
    fn every_policy_is_read_as_it_is_written() {
        for policy in [TimePolicy::Strict, TimePolicy::UntilSet, TimePolicy::Ignored] {
            assert_eq!(policy.word().parse(), Ok(policy));
        }
        assert_eq!("Strict".parse::<TimePolicy>(), Err(()));
    }
}
