//! Validity periods of certificates, for a machine with a clock that may not be set.
//!
//! A robot without a clock battery boots in 1970 and gets the time later or never. Its own certificate was
//! made before it booted. A clock that shows an earlier time than that is therefore known to be wrong. The
//! configuration (`security.times`) defines the policy for this case. The judge of a certificate is informed,
//! so the case is never silent.

use std::{
    fmt,
    time::{Duration, SystemTime},
};

use rustls::pki_types::UnixTime;
use sinew_model::config::TimePolicy;

/// The validity period of a certificate, with both ends included.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Validity {
    /// First valid second.
    pub from: UnixTime,
    /// Last valid second.
    pub until: UnixTime,
}

/// The reason why a certificate was accepted with regard to its times.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Judged {
    /// The clock is within the validity period.
    Valid,
    /// The clock is not set, and the certificate had not expired when this node's own was made
    /// ([`TimePolicy::UntilSet`]).
    ClockNotSet,
    /// The times were not checked ([`TimePolicy::Ignored`]).
    NotLookedAt,
}

/// The reason why a certificate is not valid with regard to its times.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ValidityError {
    /// The validity period has not begun. The clock here is behind, or the clock of the machine that made the
    /// certificate is ahead.
    #[error("it counts from {} on, and the clock here says {}; set the clocks of both machines (`sinew doctor`)", date(.from), date(.now))]
    NotYet {
        /// First valid second.
        from: UnixTime,
        /// Current time of the clock here.
        now: UnixTime,
    },
    /// The validity period is over.
    #[error("it ended on {}, and the clock here says {}; make a new one with `sinew keys issue`, and copy it there", date(.until), date(.now))]
    Over {
        /// Last valid second.
        until: UnixTime,
        /// Current time of the clock here.
        now: UnixTime,
    },
    /// The clock here is known not to be set, and no certificate is valid until it is ([`TimePolicy::Strict`]).
    #[error(
        "the clock here says {}, but this node's own certificate was made on {}: the clock is not set; set it, or let \
         certificates count until it is (security.times = \"until-set\")", date(.now), date(.floor)
    )]
    ClockNotSet {
        /// Current time of the clock here.
        now: UnixTime,
        /// Time at which this node's own certificate was made.
        floor: UnixTime,
    },
}

impl Validity {
    /// Judges a certificate with these times at `now`, by `policy`. `floor` is a time that is certainly past: the
    /// time at which this node's own certificate was made.
    ///
    /// # Errors
    /// Returns why the certificate is not valid.
    pub fn judge(self, policy: TimePolicy, now: UnixTime, floor: UnixTime) -> Result<Judged, ValidityError> {
        use TimePolicy::{Ignored, Strict, UntilSet};
        let Self { from, until } = self;
        match policy {
            Ignored => Ok(Judged::NotLookedAt),
            Strict if now < floor => Err(ValidityError::ClockNotSet { now, floor }),
            UntilSet if now < floor && until >= floor => Ok(Judged::ClockNotSet),
            Strict | UntilSet if now.max(floor) > until => Err(ValidityError::Over { until, now }),
            Strict | UntilSet if now < from => Err(ValidityError::NotYet { from, now }),
            Strict | UntilSet => Ok(Judged::Valid),
        }
    }
}

/// Time before the end of a certificate from which on a node warns, in seconds: 30 days.
const LAST_DAYS: u64 = 30 * 24 * 3_600;

impl Validity {
    /// Returns the warning for these times of the node's own certificate at `now`, if there is one. The clock
    /// is not set, times are not checked, or the certificate expires soon or has expired.
    #[must_use]
    pub fn warning(self, policy: TimePolicy, now: UnixTime) -> Option<String> {
        let Self { from: floor, until } = self;
        if policy == TimePolicy::Ignored {
            let warning = "the times of certificates are not looked at (security.times = \"ignored\"): only the deny list ends one";
            return Some(warning.to_owned());
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

impl fmt::Display for Validity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} to {}", date(&self.from), date(&self.until))
    }
}

/// Formats a point in time in UTC: `2027-11-22T15:13:00Z`. A time after the year 9999 is shown as the end of that year.
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
    fn every_policy_judges_every_case() {
        use Judged::{ClockNotSet, NotLookedAt, Valid};
        use TimePolicy::{Ignored, Strict, UntilSet};
        let (own, now) = (1_000, 5_000);
        let over = |now, until| ValidityError::Over { until: at(until), now: at(now) };
        let not_yet = |now, from| ValidityError::NotYet { from: at(from), now: at(now) };
        let not_set = |now| ValidityError::ClockNotSet { now: at(now), floor: at(own) };
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
            // In 1970: a certificate that ended before this node's own was made has certainly ended; the
            // others may be valid.
            (UntilSet, 7, 900, 9_000, Ok(ClockNotSet)),
            (UntilSet, 7, 4_000, 9_000, Ok(ClockNotSet)),
            (UntilSet, 7, 500, own, Ok(ClockNotSet)),
            (UntilSet, 7, 500, own - 1, Err(over(7, own - 1))),
            (UntilSet, own, own, 9_000, Ok(Valid)),
            (Ignored, 7, 500, 600, Ok(NotLookedAt)),
            (Ignored, now, 9_000, 9_001, Ok(NotLookedAt)),
        ] {
            let found = validity(from, until).judge(policy, at(now), at(own));
            assert_eq!(found, judged, "{policy:?} at {now}: {from} to {until}");
        }
    }

    #[test]
    fn unset_clock_error_has_dates_and_remedy() {
        let words = validity(1_700_000_000, 1_800_000_000)
            .judge(TimePolicy::Strict, at(12), at(1_700_000_000))
            .unwrap_err()
            .to_string();
        for part in ["1970-01-01T00:00:12Z", "2023-11-14T22:13:20Z", "set it", "until-set"] {
            assert!(words.contains(part), "{words}");
        }
    }

    #[test]
    fn running_node_warns_of_own_expiry() {
        let until = 100 * 24 * 3_600;
        let warning =
            |policy: TimePolicy, now| validity(1_000, until).warning(policy, at(now)).unwrap_or_default();
        for policy in [TimePolicy::Strict, TimePolicy::UntilSet] {
            assert!(warning(policy, 7).contains("the clock is not set"));
            assert_eq!(warning(policy, until - LAST_DAYS), "");
            assert!(warning(policy, until - LAST_DAYS + 1).contains("ends on 1970-04-11"));
            assert!(warning(policy, until + 1).contains("has ended, on 1970-04-11"));
        }
        assert!(warning(TimePolicy::Ignored, until + 1).contains("not looked at"));
    }

    #[test]
    fn every_time_has_a_date() {
        assert_eq!(date(&at(0)), "1970-01-01T00:00:00Z");
        assert_eq!(date(&at(u64::MAX)), "9999-12-31T23:59:59Z");
    }
}
