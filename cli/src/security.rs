//! How a node authenticates, by its own report: open, or secured and for how long.

use std::time::Duration;

use serde_json::{Value, json};
use sinew::{
    inspect::{CertificateReport, NodeReport},
    security::{TimePolicy, UnixTime, date},
};

const DAY_S: u64 = 24 * 3_600;
/// A certificate with less remaining validity than this is a finding: 30 days, in seconds.
pub(crate) const SOON_S: u64 = 30 * DAY_S;

/// The state of a node, the worst first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum CertificateState {
    /// Open, and reachable from other hosts.
    Open,
    /// Its certificate is on the deny list that it has itself.
    Revoked,
    /// Its certificate has ended, by its own clock.
    Ended,
    /// Its clock shows a time before its certificate's creation: it cannot determine when one ends.
    ClockNotSet,
    /// Its certificate ends within 30 days.
    EndsSoon,
    /// Not reported: an older version.
    Unknown,
    /// Open, and reachable only from its own host, by every user there.
    Alone,
    /// It has a certificate, and ignores validity times.
    NotLookedAt,
    /// Secured.
    Secured,
}

impl CertificateState {
    pub(crate) fn of(report: &NodeReport) -> Self {
        let Some(security) = &report.security else { return Self::Unknown };
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

/// Returns a cell of a table.
pub(crate) fn cell(report: &NodeReport) -> String {
    let state = CertificateState::of(report);
    let days = certificate(report).and_then(days_left);
    match (state, days) {
        (CertificateState::Open, _) => "OPEN".to_owned(),
        (CertificateState::Revoked, _) => "REVOKED".to_owned(),
        (CertificateState::Ended, _) => "ENDED".to_owned(),
        (CertificateState::Secured | CertificateState::EndsSoon, Some(days)) => format!("{days} d"),
        _ => state.word().to_owned(),
    }
}

pub(crate) fn json(report: &NodeReport) -> Value {
    let certificate = certificate(report).map(|certificate| {
        json!({
            "from": at(certificate.from_s),
            "until": at(certificate.until_s),
            "clock": at(certificate.clock_s),
            "days_left": days_left(certificate),
            "times": certificate.times,
            "revoked": certificate.is_revoked,
        })
    });
    let security = report.security.as_ref();
    json!({
        "state": CertificateState::of(report).word(),
        "secured": security.map(|security| security.certificate.is_some()),
        "beyond_host": security.map(|security| security.is_beyond_host),
        "certificate": certificate,
    })
}

pub(crate) fn certificate(report: &NodeReport) -> Option<&CertificateReport> {
    report.security.as_ref()?.certificate.as_ref()
}

/// Returns the remaining full days of its certificate by its own clock; `None` while that is not set.
pub(crate) fn days_left(certificate: &CertificateReport) -> Option<u64> {
    let CertificateReport { from_s, until_s, clock_s, .. } = certificate;
    (clock_s >= from_s).then(|| until_s.saturating_sub(*clock_s) / DAY_S)
}

/// Returns seconds since 1970 as text, in UTC.
pub(crate) fn at(seconds: u64) -> String {
    date(&UnixTime::since_unix_epoch(Duration::from_secs(seconds)))
}

#[cfg(test)]
pub(crate) mod tests {
    use sinew::{NodeAddress, address::Incarnation, inspect::SecurityReport};

    use super::*;

    pub(crate) const NOW_S: u64 = 1_795_360_380;

    /// The report of a node with this name.
    pub(crate) fn node_report(name: &str, last: u8, security: Option<SecurityReport>) -> NodeReport {
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
            unguarded: Vec::new(),
            lost_echoes: Vec::new(),
            real_time: None,
            recording: None,
            retained: None,
            stop: None,
            guards: Vec::new(),
            guards_left_out: 0,
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

    /// With a certificate that is valid for a year from [`NOW_S`].
    pub(crate) fn secured(clock_s: u64, times: &str) -> Option<SecurityReport> {
        let (from_s, until_s) = (NOW_S, NOW_S + 365 * DAY_S);
        let times = times.to_owned();
        let certificate = CertificateReport { from_s, until_s, clock_s, times, is_revoked: false };
        Some(SecurityReport { is_beyond_host: true, certificate: Some(certificate) })
    }

    /// The same, with the certificate on the node's deny list.
    pub(crate) fn revoked(clock_s: u64) -> Option<SecurityReport> {
        let certificate = secured(clock_s, "strict")?.certificate?;
        let certificate = CertificateReport { is_revoked: true, ..certificate };
        Some(SecurityReport { is_beyond_host: true, certificate: Some(certificate) })
    }

    #[test]
    fn state_follows_the_clock_of_the_node() {
        let until_s = NOW_S + 365 * DAY_S;
        for (security, state, shown) in [
            (None, CertificateState::Unknown, "unknown"),
            (open(true), CertificateState::Open, "OPEN"),
            (open(false), CertificateState::Alone, "open, own host only"),
            (revoked(NOW_S), CertificateState::Revoked, "REVOKED"),
            // Revocation ranks above expiry: setting the clock does not fix it.
            (revoked(until_s + 1), CertificateState::Revoked, "REVOKED"),
            (secured(NOW_S, "until-set"), CertificateState::Secured, "365 d"),
            (secured(until_s - 30 * DAY_S, "until-set"), CertificateState::Secured, "30 d"),
            (secured(until_s - 30 * DAY_S + 1, "strict"), CertificateState::EndsSoon, "29 d"),
            (secured(until_s, "until-set"), CertificateState::EndsSoon, "0 d"),
            (secured(until_s + 1, "until-set"), CertificateState::Ended, "ENDED"),
            // With a clock in 1970, expiry cannot be judged.
            (secured(7, "until-set"), CertificateState::ClockNotSet, "clock not set"),
            (secured(7, "ignored"), CertificateState::NotLookedAt, "times ignored"),
            (secured(until_s + 1, "ignored"), CertificateState::NotLookedAt, "times ignored"),
        ] {
            let report = node_report("hip", 1, security);
            assert_eq!((CertificateState::of(&report), cell(&report).as_str()), (state, shown), "{report:?}");
        }
    }

    #[test]
    fn unknown_value_is_null_instead_of_false() {
        let shown = json(&node_report("hip", 1, None));
        assert!(shown["secured"].is_null() && shown["certificate"].is_null(), "{shown}");
        let shown = json(&node_report("hip", 1, secured(7, "strict")));
        assert_eq!((&shown["secured"], &shown["certificate"]["days_left"]), (&true.into(), &Value::Null));
        assert_eq!(shown["certificate"]["clock"], "1970-01-01T00:00:07Z");
    }
}
