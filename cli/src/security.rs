//! How a node proves itself to others, as it says: open, or secured and for how long.

use std::time::Duration;

use serde_json::{Value, json};
use sinew::{
    inspect::{CertificateReport, NodeReport},
    security::{TimePolicy, UnixTime, date},
};

const DAY_S: u64 = 24 * 3_600;
/// A certificate that counts for less than this is a finding: 30 days, in seconds.
pub(crate) const SOON_S: u64 = 30 * DAY_S;

/// Where a node stands, the worst first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Standing {
    /// Open, and other hosts reach it.
    Open,
    /// Its certificate is on the deny list that it has itself.
    Revoked,
    /// Its certificate has ended, by its own clock.
    Ended,
    /// Its clock says an earlier time than its certificate was made: nobody there knows when one ends.
    ClockNotSet,
    /// Its certificate ends within 30 days.
    EndsSoon,
    /// It does not say: of an older version.
    Unknown,
    /// Open, and nobody but its own host reaches it: every user of that.
    Alone,
    /// It has a certificate, and looks at nobody's times.
    NotLookedAt,
    /// Secured.
    Secured,
}

impl Standing {
    pub(crate) fn of(said: &NodeReport) -> Self {
        let Some(security) = &said.security else { return Self::Unknown };
        match &security.certificate {
            None if security.is_beyond_host => Self::Open,
            None => Self::Alone,
            Some(CertificateReport { is_revoked: true, .. }) => Self::Revoked,
            Some(certificate) if certificate.times == TimePolicy::Ignored.word() => Self::NotLookedAt,
            Some(CertificateReport { from_s, clock_s, .. }) if clock_s < from_s => Self::ClockNotSet,
            Some(CertificateReport { until_s, clock_s, .. }) if until_s < clock_s => Self::Ended,
            Some(CertificateReport { until_s, clock_s, .. }) if until_s - clock_s < SOON_S => Self::EndsSoon,
            Some(_) => Self::Secured,
        }
    }

    const fn word(self) -> &'static str {
        match self {
            Self::Open => "open",
            Self::Revoked => "revoked",
            Self::Ended => "ended",
            Self::ClockNotSet => "clock not set",
            Self::EndsSoon => "ends soon",
            Self::Unknown => "unknown",
            Self::Alone => "open, own host only",
            Self::NotLookedAt => "times ignored",
            Self::Secured => "secured",
        }
    }
}

/// A cell of a table.
pub(crate) fn cell(said: &NodeReport) -> String {
    let standing = Standing::of(said);
    let days = certificate(said).and_then(days_left);
    match (standing, days) {
        (Standing::Open, _) => "OPEN".to_owned(),
        (Standing::Revoked, _) => "REVOKED".to_owned(),
        (Standing::Ended, _) => "ENDED".to_owned(),
        (Standing::Secured | Standing::EndsSoon, Some(days)) => format!("{days} d"),
        _ => standing.word().to_owned(),
    }
}

pub(crate) fn json(said: &NodeReport) -> Value {
    let certificate = certificate(said).map(|certificate| {
        json!({
            "from": at(certificate.from_s),
            "until": at(certificate.until_s),
            "clock": at(certificate.clock_s),
            "days_left": days_left(certificate),
            "times": certificate.times,
            "revoked": certificate.is_revoked,
        })
    });
    let security = said.security.as_ref();
    json!({
        "state": Standing::of(said).word(),
        "secured": security.map(|security| security.certificate.is_some()),
        "beyond_host": security.map(|security| security.is_beyond_host),
        "certificate": certificate,
    })
}

pub(crate) fn certificate(said: &NodeReport) -> Option<&CertificateReport> {
    said.security.as_ref()?.certificate.as_ref()
}

/// Whole days that its certificate still counts by its own clock; `None` while that is not set.
pub(crate) fn days_left(certificate: &CertificateReport) -> Option<u64> {
    let CertificateReport { from_s, until_s, clock_s, .. } = certificate;
    (clock_s >= from_s).then(|| until_s.saturating_sub(*clock_s) / DAY_S)
}

/// Seconds since 1970 as text, in UTC.
pub(crate) fn at(seconds: u64) -> String {
    date(&UnixTime::since_unix_epoch(Duration::from_secs(seconds)))
}

#[cfg(test)]
pub(crate) mod tests {
    use sinew::{NodeAddress, address::Incarnation, inspect::SecurityReport};

    use super::*;

    pub(crate) const NOW_S: u64 = 1_795_360_380;

    /// What a node of this name says.
    pub(crate) fn said(name: &str, last: u8, security: Option<SecurityReport>) -> NodeReport {
        NodeReport {
            node: NodeAddress::from([192, 168, 0, last]),
            name: name.to_owned(),
            incarnation: Incarnation(1),
            up_us: 1,
            pid: 1,
            version: "0.1.0".to_owned(),
            stopping: false,
            refused: 0,
            project: "walker".to_owned(),
            security,
            interface: "192.168.0.0".to_owned(),
            is_interface_default: Some(false),
            udp: None,
            gncl: None,
            group: None,
            groups: Vec::new(),
            seeds: Vec::new(),
            sources: Vec::new(),
            lost: Vec::new(),
            lost_left_out: 0,
            foreign: Vec::new(),
            foreign_left_out: 0,
            refusals: Vec::new(),
            unhandled: Vec::new(),
            refusals_left_out: 0,
            peers: Vec::new(),
            own_stalls: None,
            troubled: 0,
            troubles: Vec::new(),
            idle_clients: 0,
            idle: Vec::new(),
            left_out: 0,
        }
    }

    pub(crate) fn open(is_beyond_host: bool) -> Option<SecurityReport> {
        Some(SecurityReport { is_beyond_host, certificate: None })
    }

    /// With a certificate of a year that was made at [`NOW_S`].
    pub(crate) fn secured(clock_s: u64, times: &str) -> Option<SecurityReport> {
        let (from_s, until_s) = (NOW_S, NOW_S + 365 * DAY_S);
        let times = times.to_owned();
        let certificate = CertificateReport { from_s, until_s, clock_s, times, is_revoked: false };
        Some(SecurityReport { is_beyond_host: true, certificate: Some(certificate) })
    }

    /// The same, and it is on the list that its node has.
    pub(crate) fn revoked(clock_s: u64) -> Option<SecurityReport> {
        let certificate = secured(clock_s, "strict")?.certificate?;
        let certificate = CertificateReport { is_revoked: true, ..certificate };
        Some(SecurityReport { is_beyond_host: true, certificate: Some(certificate) })
    }

    #[test]
    fn a_node_stands_where_its_own_clock_says() {
        let until_s = NOW_S + 365 * DAY_S;
        for (security, standing, shown) in [
            (None, Standing::Unknown, "unknown"),
            (open(true), Standing::Open, "OPEN"),
            (open(false), Standing::Alone, "open, own host only"),
            (revoked(NOW_S), Standing::Revoked, "REVOKED"),
            // Worse than that it has ended, too: to set the clock does not mend it.
            (revoked(until_s + 1), Standing::Revoked, "REVOKED"),
            (secured(NOW_S, "until-set"), Standing::Secured, "365 d"),
            (secured(until_s - 30 * DAY_S, "until-set"), Standing::Secured, "30 d"),
            (secured(until_s - 30 * DAY_S + 1, "strict"), Standing::EndsSoon, "29 d"),
            (secured(until_s, "until-set"), Standing::EndsSoon, "0 d"),
            (secured(until_s + 1, "until-set"), Standing::Ended, "ENDED"),
            // In 1970 nobody knows whether it has ended.
            (secured(7, "until-set"), Standing::ClockNotSet, "clock not set"),
            (secured(7, "ignored"), Standing::NotLookedAt, "times ignored"),
            (secured(until_s + 1, "ignored"), Standing::NotLookedAt, "times ignored"),
        ] {
            let said = said("hip", 1, security);
            assert_eq!((Standing::of(&said), cell(&said).as_str()), (standing, shown), "{said:?}");
        }
    }

    #[test]
    fn what_is_not_known_is_null_and_not_false() {
        let shown = json(&said("hip", 1, None));
        assert!(shown["secured"].is_null() && shown["certificate"].is_null(), "{shown}");
        let shown = json(&said("hip", 1, secured(7, "strict")));
        assert_eq!((&shown["secured"], &shown["certificate"]["days_left"]), (&true.into(), &Value::Null));
        assert_eq!(shown["certificate"]["clock"], "1970-01-01T00:00:07Z");
    }
}
