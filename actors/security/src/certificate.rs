//! The fields of a certificate that Sinew uses: identity, serial number and validity period.
//!
//! Certificates are parsed by webpki, which also parses those of unauthenticated peers in handshakes. The
//! parsed fields are not proven yet; the [`verifier`](super::verifier) does that.

use std::{fmt, path::Path, str::FromStr, time::Duration};

use rustls::pki_types::{CertificateDer, UnixTime};
use webpki::{EndEntityCert, Error, KeyUsage};

use super::{CredentialError, Identity, Validity, credentials, project_of};

/// A parsed certificate. Nothing in it is proven.
///
/// # Examples
///
/// ```no_run
/// use std::path::Path;
///
/// use sinew::security::{Certificate, date};
///
/// let certificate = Certificate::from_file(Path::new("/etc/sinew/keys/node.pem"))?;
/// println!("{:?} until {}", certificate.identity(), date(&certificate.validity().until));
/// # Ok::<(), sinew::security::CredentialError>(())
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Certificate {
    der: CertificateDer<'static>,
    serial: Serial,
    validity: Validity,
    uris: Vec<String>,
}

/// An error for bytes that are not a usable certificate.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("no certificate (X.509, version 3) with a number and times that can be read")]
pub struct MalformedCertificateError;

/// The serial number of a certificate, which its authority assigns once. It is written as hexadecimal digits.
///
/// # Examples
///
/// ```
/// use sinew::security::Serial;
///
/// let serial: Serial = "2D6F".parse().expect("hexadecimal digits");
/// assert_eq!(serial.to_string(), "2d6f");
/// ```
#[derive(Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Serial(Vec<u8>);

/// Maximum number of names that are read in one certificate.
const URIS_MAX: usize = 8;

impl Certificate {
    /// Parses the certificate in `der`.
    ///
    /// # Errors
    /// Returns [`MalformedCertificateError`] if the bytes are not a usable certificate.
    pub fn read(der: CertificateDer<'static>) -> Result<Self, MalformedCertificateError> {
        let read = EndEntityCert::try_from(&der).map_err(|_| MalformedCertificateError)?;
        let serial = Serial::new(read.serial()).ok_or(MalformedCertificateError)?;
        let validity = validity(&read).ok_or(MalformedCertificateError)?;
        let uris = read.valid_uri_names().take(URIS_MAX).map(str::to_owned).collect();
        Ok(Self { serial, validity, uris, der })
    }

    /// Reads the certificate in the PEM file at `path`, which only its owner may be able to change.
    ///
    /// # Errors
    /// Returns an error if the file cannot be read, or holds something else.
    pub fn from_file(path: &Path) -> Result<Self, CredentialError> {
        credentials::read_certificate(path)
    }

    /// Returns the claimed identity of the node, or `None` if the certificate names none, or more than one.
    #[must_use]
    pub fn identity(&self) -> Option<Identity> {
        let [uri] = &self.uris[..] else { return None };
        Identity::from_uri(uri)
    }

    /// Returns the project that the certificate claims to be the authority of.
    #[must_use]
    pub fn project(&self) -> Option<String> {
        let [uri] = &self.uris[..] else { return None };
        project_of(uri)
    }

    /// Returns the serial number.
    #[must_use]
    pub const fn serial(&self) -> &Serial {
        &self.serial
    }

    /// Returns the validity period.
    #[must_use]
    pub const fn validity(&self) -> Validity {
        self.validity
    }

    /// Returns the encoded certificate.
    #[must_use]
    pub const fn der(&self) -> &CertificateDer<'static> {
        &self.der
    }
}

/// Returns the validity period. It is read from webpki's errors at the first and the last possible time.
/// webpki checks the times before it searches an issuer, so no issuer is needed.
fn validity(certificate: &EndEntityCert<'_>) -> Option<Validity> {
    let at = |seconds| {
        let time = UnixTime::since_unix_epoch(Duration::from_secs(seconds));
        certificate.verify_for_usage(&[], &[], &[], time, KeyUsage::client_auth(), None, None).err()
    };
    let from = match at(0) {
        Some(Error::CertNotValidYet { not_before, .. }) => not_before,
        // The certificate is already valid in the first second of 1970, as far as this error shows.
        Some(_) | None => UnixTime::since_unix_epoch(Duration::ZERO),
    };
    let Some(Error::CertExpired { not_after: until, .. }) = at(u64::MAX) else { return None };
    Some(Validity { from, until })
}

impl Serial {
    /// Creates a number from its bytes in big-endian order. Returns `None` if there are more than 20 (RFC
    /// 5280) or the number is zero.
    #[must_use]
    pub fn new(bytes: &[u8]) -> Option<Self> {
        const BYTES_MAX: usize = 20;
        let start = bytes.iter().position(|byte| *byte != 0)?;
        let bytes = &bytes[start..];
        (bytes.len() <= BYTES_MAX).then(|| Self(bytes.to_vec()))
    }
}

impl FromStr for Serial {
    type Err = ();

    fn from_str(text: &str) -> Result<Self, ()> {
        const DIGITS_MAX: usize = 42;
        if !text.is_ascii() || text.len() % 2 == 1 || text.len() > DIGITS_MAX {
            return Err(());
        }
        let byte = |at| {
            let digits = &text[at..at + 2];
            let is_hex = digits.bytes().all(|digit| digit.is_ascii_hexdigit());
            u8::from_str_radix(digits, 16).ok().filter(|_| is_hex)
        };
        let bytes: Option<Vec<u8>> = (0..text.len()).step_by(2).map(byte).collect();
        bytes.and_then(|bytes| Self::new(&bytes)).ok_or(())
    }
}

impl fmt::Display for Serial {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

impl fmt::Debug for Serial {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}
