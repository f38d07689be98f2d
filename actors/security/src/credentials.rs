//! The credentials and trust anchors of a node. They are read from its files and checked, and all faults are
//! reported together.

use std::{
    fmt,
    path::{Path, PathBuf},
    sync::Arc,
};

use arc_swap::ArcSwap;
use rustls::pki_types::{
    CertificateDer, PrivateKeyDer, TrustAnchor, UnixTime,
    pem::{Error as PemError, PemObject},
};
use sinew_model::config::TimePolicy;
use webpki::KeyUsage;

use super::{
    Certificate, DenyList, DenyListEntryError, DiscoveryKey, Identity, Serial, Validity, ValidityError,
    files::{self, KeyFileError},
    tls,
    verifier::{self, TrustSettings},
};

/// The key and certificate of a node, and its trust settings. [`load`](Self::load) makes them, so they fit together.
pub struct Credentials {
    pub(super) identity: Identity,
    pub(super) certificate: Certificate,
    pub(super) key: PrivateKeyDer<'static>,
    pub(super) trust: TrustSettings,
    discovery: DiscoveryKey,
    directory: PathBuf,
    warnings: Vec<String>,
}

/// All faults of a node's files, one per line. Nothing was changed.
#[derive(Debug)]
pub struct CredentialsError(Vec<CredentialError>);

/// One fault of a node's files.
#[derive(Debug, thiserror::Error)]
pub enum CredentialError {
    /// A file does not exist, or other users have access to it.
    #[error(transparent)]
    File(#[from] KeyFileError),
    /// A file holds no certificate, or more than one.
    #[error("{path}: {why}; put the one there that `sinew keys` made")]
    NoCertificate {
        /// Path of the file.
        path: PathBuf,
        /// Description of the content.
        why: String,
    },
    /// A file holds no key.
    #[error("{path} holds no key ({why}); put the one there that `sinew keys` made")]
    NoKey {
        /// Path of the file.
        path: PathBuf,
        /// Description of the content.
        why: String,
    },
    /// The deny list cannot be read.
    #[error("{path}: {why}")]
    DenyList {
        /// Path of the file.
        path: PathBuf,
        /// The line and the remedy.
        why: DenyListEntryError,
    },
    /// The key belongs to another certificate.
    #[error("{key} is not the key of {certificate}; copy the node's directory again, as a whole")]
    OtherKey {
        /// Path of the key.
        key: PathBuf,
        /// Path of the certificate.
        certificate: PathBuf,
    },
    /// The authority's certificate is not one of a project.
    #[error("{path} is no certificate of a project's authority; copy the node's directory again, as a whole")]
    NoAuthority {
        /// Path of the file.
        path: PathBuf,
    },
    /// The certificate was not signed by this authority.
    #[error(
        "{certificate} is not from the authority in {authority}: {why}; copy the node's directory again, as a whole"
    )]
    OtherAuthority {
        /// Path of the certificate.
        certificate: PathBuf,
        /// Path of the authority's certificate.
        authority: PathBuf,
        /// Result of the check.
        why: String,
    },
    /// The certificate is of another node than this one.
    #[error(
        "{path} is of {certified}, but this is {configured}: set node.name, node.address and node.project as the \
         certificate says, or make one for this node: `sinew keys issue {}={}`", .configured.name, .configured.address
    )]
    OtherNode {
        /// Path of the file.
        path: PathBuf,
        /// Identity in the certificate.
        certified: Identity,
        /// Identity in the node's configuration.
        configured: Identity,
    },
    /// The certificate is not valid now.
    #[error("{path}: {why}")]
    Times {
        /// Path of the file.
        path: PathBuf,
        /// The reason and the remedy.
        why: ValidityError,
    },
    /// The certificate is revoked.
    #[error("{path}, number {serial}, is revoked; make a new one with `sinew keys issue`")]
    Denied {
        /// Path of the file.
        path: PathBuf,
        /// Serial number of the certificate.
        serial: Serial,
    },
}

impl Credentials {
    /// Reads the files of the node `configured` in `directory` (see [`files`]). Checks that at the time `now`
    /// they are protected, fit together, belong to this node, and are valid.
    ///
    /// # Errors
    /// Returns all faults, not just the first one. If one fault hides others, these are reported after it is fixed.
    pub fn load(
        directory: &Path,
        configured: &Identity,
        policy: TimePolicy,
        now: UnixTime,
    ) -> Result<Self, CredentialsError> {
        let mut faults = Vec::new();
        let path = |name: &str| directory.join(name);
        let parts = (
            keep(&mut faults, files::directory(directory).map_err(CredentialError::from)),
            keep(&mut faults, read_certificate(&path(files::NODE_CERTIFICATE))),
            keep(&mut faults, read_key(&path(files::NODE_KEY))),
            keep(&mut faults, read_certificate(&path(files::AUTHORITY))),
            keep(&mut faults, read_discovery(&path(files::DISCOVERY_KEY))),
            keep(&mut faults, read_denied(&path(files::DENIED))),
        );
        let (Some(()), Some(certificate), Some(key), Some(authority), Some(discovery), Some(denied)) = parts
        else {
            return Err(CredentialsError(faults));
        };
        let Some(anchor) = keep(&mut faults, anchor(&path(files::AUTHORITY), &authority, configured)) else {
            return Err(CredentialsError(faults));
        };
        let floor = certificate.validity().from;
        let denied = Arc::new(ArcSwap::from_pointee(denied));
        let trust = TrustSettings { anchor, project: configured.project.clone(), denied, policy, floor };
        let mut credentials = Self {
            identity: configured.clone(),
            certificate,
            key,
            trust,
            discovery,
            directory: directory.to_owned(),
            warnings: Vec::new(),
        };
        credentials.check(directory, now, &mut faults);
        if !faults.is_empty() {
            return Err(CredentialsError(faults));
        }
        credentials.warnings =
            credentials.certificate.validity().warning(credentials.policy(), now).into_iter().collect();
        Ok(credentials)
    }

    fn check(&self, directory: &Path, now: UnixTime, faults: &mut Vec<CredentialError>) {
        let path = directory.join(files::NODE_CERTIFICATE);
        let (key, authority) = (directory.join(files::NODE_KEY), directory.join(files::AUTHORITY));
        let usages = [KeyUsage::client_auth(), KeyUsage::server_auth()];
        if let Err(why) = tls::fits(&self.certificate, &self.key) {
            faults.push(match why {
                None => CredentialError::OtherKey { key, certificate: path.clone() },
                Some(why) => CredentialError::NoKey { path: key, why },
            });
        }
        if let Err(why) = verifier::signed(&self.certificate, &self.trust.anchor, usages) {
            let certificate = path.clone();
            faults.push(CredentialError::OtherAuthority { certificate, authority, why });
        }
        match self.certificate.identity() {
            Some(certified) if certified == self.identity => {}
            Some(certified) => {
                let configured = self.identity.clone();
                faults.push(CredentialError::OtherNode { path: path.clone(), certified, configured });
            }
            None => {
                let why = "a certificate that names no node".to_owned();
                faults.push(CredentialError::NoCertificate { path: path.clone(), why });
            }
        }
        let serial = self.certificate.serial();
        if self.trust.denied.load().has(serial) {
            faults.push(CredentialError::Denied { path: path.clone(), serial: serial.clone() });
        }
        if let Err(why) = self.trust.judge(self.certificate.validity(), now) {
            faults.push(CredentialError::Times { path, why });
        }
    }

    /// Returns the policy for certificate times.
    #[must_use]
    pub const fn policy(&self) -> TimePolicy {
        self.trust.policy
    }

    /// Reads the deny list in `directory` again, as [`load`](Self::load) does.
    ///
    /// # Errors
    /// Returns an error if the list does not exist, cannot be read, or can be changed by other users.
    pub fn deny_list(directory: &Path) -> Result<DenyList, CredentialsError> {
        let mut faults = Vec::new();
        let parts = (
            keep(&mut faults, files::directory(directory).map_err(CredentialError::from)),
            keep(&mut faults, read_denied(&directory.join(files::DENIED))),
        );
        match parts {
            (Some(()), Some(denied)) => Ok(denied),
            (None, _) | (_, None) => Err(CredentialsError(faults)),
        }
    }

    /// Returns the directory from which the files were read.
    #[must_use]
    pub fn directory(&self) -> &Path {
        &self.directory
    }

    /// Returns the identity of the node.
    #[must_use]
    pub const fn identity(&self) -> &Identity {
        &self.identity
    }

    /// Returns the serial number of the node's certificate.
    #[must_use]
    pub const fn serial(&self) -> &Serial {
        self.certificate.serial()
    }

    /// Returns the validity period of the node's certificate.
    #[must_use]
    pub const fn validity(&self) -> Validity {
        self.certificate.validity()
    }

    /// Returns the project's key for discovery datagrams.
    #[must_use]
    pub const fn discovery(&self) -> &DiscoveryKey {
        &self.discovery
    }

    /// Returns the warnings for the start of the node: its clock is not set, times are not checked, or its
    /// certificate expires soon.
    #[must_use]
    pub fn warnings(&self) -> &[String] {
        &self.warnings
    }
}

fn keep<T>(faults: &mut Vec<CredentialError>, read: Result<T, CredentialError>) -> Option<T> {
    read.map_err(|fault| faults.push(fault)).ok()
}

pub(super) fn read_certificate(path: &Path) -> Result<Certificate, CredentialError> {
    let bytes = files::certificate(path)?;
    let no = |why: String| CredentialError::NoCertificate { path: path.to_owned(), why };
    let mut found = CertificateDer::pem_slice_iter(&bytes);
    let first = found.next().ok_or_else(|| no("no certificate in PEM".to_owned()))?;
    if found.next().is_some() {
        return Err(no("more than one certificate".to_owned()));
    }
    let der = first.map_err(|why| no(words(&why)))?;
    Certificate::read(der).map_err(|error| no(error.to_string()))
}

fn read_key(path: &Path) -> Result<PrivateKeyDer<'static>, CredentialError> {
    let bytes = files::secret(path)?;
    let no = |why: PemError| CredentialError::NoKey { path: path.to_owned(), why: words(&why) };
    PrivateKeyDer::from_pem_slice(&bytes).map_err(no)
}

fn read_discovery(path: &Path) -> Result<DiscoveryKey, CredentialError> {
    let bytes = files::secret(path)?;
    let why = || "64 hexadecimal digits are".to_owned();
    DiscoveryKey::read(&bytes).ok_or_else(|| CredentialError::NoKey { path: path.to_owned(), why: why() })
}

fn read_denied(path: &Path) -> Result<DenyList, CredentialError> {
    let bytes = files::denied(path)?;
    let fault = |why| CredentialError::DenyList { path: path.to_owned(), why };
    DenyList::read(&String::from_utf8_lossy(&bytes)).map_err(fault)
}

/// Describes an unreadable PEM file. The text never includes the content itself, which may be a key.
fn words(why: &PemError) -> String {
    // The text of some variants includes a line of the file, which may be the key.
    match why {
        PemError::NoItemsFound => "nothing in PEM of that kind",
        PemError::MissingSectionEnd { .. } => {
            "PEM that has no end: is a line missing, or all of it in one line?"
        }
        PemError::IllegalSectionStart { .. } => {
            "PEM with a line that begins no section: is all of it in one line?"
        }
        PemError::Base64Decode(_) => "PEM whose base64 is damaged",
        PemError::Io(_) => "PEM that could not be read to its end",
        PemError::SectionTooLarge | _ => "PEM that cannot be read",
    }
    .to_owned()
}

fn anchor(
    path: &Path,
    authority: &Certificate,
    configured: &Identity,
) -> Result<TrustAnchor<'static>, CredentialError> {
    let none = || CredentialError::NoAuthority { path: path.to_owned() };
    let project = authority.project().ok_or_else(none)?;
    if project != configured.project {
        let why = format!(
            "the authority of project {project:?}, and this node's project (node.project) is {:?}",
            configured.project
        );
        return Err(CredentialError::NoCertificate { path: path.to_owned(), why });
    }
    verifier::anchor(authority).ok_or_else(none)
}

impl CredentialsError {
    /// Returns all faults, at least one.
    #[must_use]
    pub fn faults(&self) -> &[CredentialError] {
        &self.0
    }
}

impl std::error::Error for CredentialsError {}

impl fmt::Display for CredentialsError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (at, fault) in self.0.iter().enumerate() {
            write!(f, "{}{fault}", if at == 0 { "" } else { "\n" })?;
        }
        Ok(())
    }
}

/// Shows the identity and the serial number, and no secret.
impl fmt::Debug for Credentials {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Credentials({}, number {})", self.identity, self.serial())
    }
}
