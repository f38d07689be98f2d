//! A certificate as far as Sinew looks at it: who, which number, from when until when.
//!
//! Read by webpki, which reads those of strangers in handshakes, too. What is read here is not proven yet: the
//! [`verifier`](super::verifier) does that.

use std::{fmt, path::Path, str::FromStr, time::Duration};

use rustls::pki_types::{CertificateDer, UnixTime};
use webpki::{EndEntityCert, Error, KeyUsage};

use super::{CredentialFault, Identity, Validity, credentials, project_of};

/// A certificate that could be read. Nothing is proven by that.
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
/// # Ok::<(), sinew::security::CredentialFault>(())
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Certificate {
    der: CertificateDer<'static>,
    serial: Serial,
    validity: Validity,
    uris: Vec<String>,
}

/// These bytes are no certificate that Sinew could use.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("no certificate (X.509, version 3) with a number and times that can be read")]
pub struct Malformed;

/// The number of a certificate, which its authority gives out once. Written as hexadecimal digits.
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

/// Names in one certificate that are looked at.
const URIS_MAX: usize = 8;

impl Certificate {
    /// Reads the certificate in `der`.
    ///
    /// # Errors
    /// It is none.
    pub fn read(der: CertificateDer<'static>) -> Result<Self, Malformed> {
        let read = EndEntityCert::try_from(&der).map_err(|_| Malformed)?;
        let serial = Serial::new(read.serial()).ok_or(Malformed)?;
        let validity = validity(&read).ok_or(Malformed)?;
        let uris = read.valid_uri_names().take(URIS_MAX).map(str::to_owned).collect();
        Ok(Self { serial, validity, uris, der })
    }

    /// Reads the certificate in the PEM file at `path`, which nobody but its owner may be able to change.
    ///
    /// # Errors
    /// The file cannot be had, or holds something else.
    pub fn from_file(path: &Path) -> Result<Self, CredentialFault> {
        credentials::read_certificate(path)
    }

    /// The node that it says it is of; `None` if it names none, or more than one.
    #[must_use]
    pub fn identity(&self) -> Option<Identity> {
        let [uri] = &self.uris[..] else { return None };
        Identity::from_uri(uri)
    }

    /// The project whose authority it says it is of.
    #[must_use]
    pub fn project(&self) -> Option<String> {
        let [uri] = &self.uris[..] else { return None };
        project_of(uri)
    }

    /// Its number.
    #[must_use]
    pub const fn serial(&self) -> &Serial {
        &self.serial
    }

    /// From when until when it counts.
    #[must_use]
    pub const fn validity(&self) -> Validity {
        self.validity
    }

    /// Its bytes.
    #[must_use]
    pub const fn der(&self) -> &CertificateDer<'static> {
        &self.der
    }
}

/// What webpki answers when it is asked about the first and the last of all times. It looks at the times before it looks for an issuer,
/// so it needs none.
fn validity(certificate: &EndEntityCert<'_>) -> Option<Validity> {
    let at = |seconds| {
        let time = UnixTime::since_unix_epoch(Duration::from_secs(seconds));
        certificate.verify_for_usage(&[], &[], &[], time, KeyUsage::client_auth(), None, None).err()
    };
    let from = match at(0) {
        Some(Error::CertNotValidYet { not_before, .. }) => not_before,
        // It is valid in the first second of 1970 already, as far as that says.
        Some(_) | None => UnixTime::since_unix_epoch(Duration::ZERO),
    };
    let Some(Error::CertExpired { not_after: until, .. }) = at(u64::MAX) else { return None };
    Some(Validity { from, until })
}

impl Serial {
    /// From its bytes, the highest first; `None` if these are too many (RFC 5280: 20 at most) or no number above zero.
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
