//! The key and the certificate of the authority, and the certificates that it signs.

use std::time::Duration;

use rcgen::{
    BasicConstraints, CertificateParams, DistinguishedName, DnType, ExtendedKeyUsagePurpose, IsCa, Issuer,
    KeyPair, KeyUsagePurpose, SanType,
};
use sinew::security::{Identity, UnixTime, date, project_uri};

use crate::system::SystemError;

/// The validity of the authority's own certificate: 20 years, the life of a robot and more.
const AUTHORITY_DAYS: u64 = 20 * 365;
/// Certificates are valid from shortly before their creation: the robot's clock may be behind this machine's.
const BEFORE: Duration = Duration::from_secs(3_600);
/// The release of `sinew keys`, in seconds since 1970 (2026-01-01): a clock that shows an earlier time is wrong.
const EARLIEST: u64 = 1_767_225_600;
const DAY: Duration = Duration::from_secs(24 * 3_600);

/// The validity period of certificates that are created now.
#[derive(Clone, Copy, Debug)]
pub(super) struct Clock {
    pub(super) now: UnixTime,
    days: u32,
}

/// A project's authority.
pub(super) struct Authority {
    project: String,
    key: KeyPair,
}

/// A key and a certificate, as PEM.
pub(super) struct Pair {
    pub(super) key: String,
    pub(super) certificate: String,
}

impl Clock {
    /// Refuses a clock that is not set: the certificates would have the wrong validity period.
    pub(super) fn new(now: UnixTime, days: u32) -> Result<Self, SystemError> {
        if now.as_secs() < EARLIEST {
            return Err(SystemError::Keys(format!(
                "the clock of this machine shows {}, and certificates have dates; set it first",
                date(&now)
            )));
        }
        Ok(Self { now, days })
    }

    /// Refuses a certificate that would be valid beyond the end of its authority, `until`: no node would accept it
    /// then.
    pub(super) fn must_end_before(self, until: UnixTime) -> Result<(), SystemError> {
        let left = until.as_secs().saturating_sub(self.now.as_secs()) / DAY.as_secs();
        if u64::from(self.days) <= left {
            return Ok(());
        }
        let until = date(&until);
        Err(SystemError::Keys(if left == 0 {
            format!(
                "the authority's certificate ends on {until}: make this robot's keys anew with `sinew keys init`"
            )
        } else {
            format!(
                "the authority's certificate is valid until {until}, and these should be valid for {} days: say --days {left} at most, or make \
                 this robot's keys anew with `sinew keys init`",
                self.days
            )
        }))
    }

    fn set(self, params: &mut CertificateParams, days: u64) {
        let since_1970 = Duration::from_secs(self.now.as_secs());
        let days = DAY * u32::try_from(days).unwrap_or(u32::MAX);
        let origin = rcgen::date_time_ymd(1970, 1, 1);
        params.not_before = origin + since_1970.saturating_sub(BEFORE);
        params.not_after = origin + since_1970 + days;
    }
}

impl Authority {
    /// Creates an authority, and its certificate as PEM.
    pub(super) fn make(project: &str, clock: Clock) -> Result<(Self, Pair), rcgen::Error> {
        let key = KeyPair::generate()?;
        let mut params = params_of(project)?;
        clock.set(&mut params, AUTHORITY_DAYS);
        let pair = Pair { key: key.serialize_pem(), certificate: params.self_signed(&key)?.pem() };
        Ok((Self { project: project.to_owned(), key }, pair))
    }

    /// Reads the authority of `project` with the key in `pem`.
    pub(super) fn read(project: &str, pem: &str) -> Result<Self, rcgen::Error> {
        Ok(Self { project: project.to_owned(), key: KeyPair::from_pem(pem)? })
    }

    /// Creates a key and a certificate for the node `identity`, for both ends of connections.
    pub(super) fn sign(&self, identity: &Identity, clock: Clock) -> Result<Pair, rcgen::Error> {
        let own = params_of(&self.project)?;
        let issuer = Issuer::from_params(&own, &self.key);
        let key = KeyPair::generate()?;
        let mut params = CertificateParams::default();
        params.distinguished_name = named(&identity.name);
        params.subject_alt_names = vec![SanType::URI(identity.uri().try_into()?)];
        params.key_usages = vec![KeyUsagePurpose::DigitalSignature];
        params.extended_key_usages =
            vec![ExtendedKeyUsagePurpose::ServerAuth, ExtendedKeyUsagePurpose::ClientAuth];
        params.use_authority_key_identifier_extension = true;
        clock.set(&mut params, clock.days.into());
        let certificate = params.signed_by(&key, &issuer)?.pem();
        Ok(Pair { key: key.serialize_pem(), certificate })
    }
}

/// Returns the parameters of an authority: it signs nodes, and no other authority.
fn params_of(project: &str) -> Result<CertificateParams, rcgen::Error> {
    let mut params = CertificateParams::default();
    params.distinguished_name = named(&format!("{project} (Sinew)"));
    params.subject_alt_names = vec![SanType::URI(project_uri(project).try_into()?)];
    params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
    params.key_usages = vec![KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::CrlSign];
    Ok(params)
}

fn named(name: &str) -> DistinguishedName {
    let mut names = DistinguishedName::new();
    names.push(DnType::CommonName, name);
    names
}

#[cfg(test)]
mod tests {
    use super::*;

    fn clock(days: u32) -> Clock {
        Clock::new(UnixTime::since_unix_epoch(Duration::from_secs(EARLIEST)), days).expect("it is set")
    }

    #[test]
    fn certificate_does_not_outlive_its_authority() {
        let in_days = |days: u32| UnixTime::since_unix_epoch(Duration::from_secs(EARLIEST) + DAY * days);
        assert!(clock(365).must_end_before(in_days(365)).is_ok());
        let longer = clock(366).must_end_before(in_days(365)).expect_err("a day too many").to_string();
        assert!(longer.contains("--days 365 at most"), "{longer}");
        let ended = clock(1).must_end_before(in_days(0)).expect_err("it has ended").to_string();
        assert!(ended.contains("ends on") && ended.contains("keys init"), "{ended}");
    }
}
