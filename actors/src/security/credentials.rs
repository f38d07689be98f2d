//! What a node shows others and by what it knows them: read from its files and checked, all faults together.

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
use webpki::KeyUsage;

use super::{
    Certificate, DenyList, DenyListFault, DiscoveryKey, Identity, Malformed, Serial, TimeFault, TimePolicy,
    Validity,
    files::{self, FileFault},
    tls,
    verifier::{self, Believed},
};

/// A node's own key and certificate, and what it believes. Made by [`load`](Self::load), so they fit together.
pub struct Credentials {
    pub(super) identity: Identity,
    pub(super) certificate: Certificate,
    pub(super) key: PrivateKeyDer<'static>,
    pub(super) believed: Believed,
    discovery: DiscoveryKey,
    directory: PathBuf,
    warnings: Vec<String>,
}

/// All that is wrong with a node's files, one a line. Nothing was changed.
#[derive(Debug)]
pub struct CredentialFaults(Vec<CredentialFault>);

/// One thing that is wrong with a node's files.
#[derive(Debug, thiserror::Error)]
pub enum CredentialFault {
    /// A file is not there, or others can get at it.
    #[error(transparent)]
    File(#[from] FileFault),
    /// A file holds no certificate, or more than one.
    #[error("{path}: {why}; put the one there that `sinew keys` made")]
    NoCertificate {
        /// Which.
        path: PathBuf,
        /// What is there.
        why: String,
    },
    /// A file holds no key.
    #[error("{path} holds no key ({why}); put the one there that `sinew keys` made")]
    NoKey {
        /// Which.
        path: PathBuf,
        /// What is there.
        why: String,
    },
    /// The deny list cannot be read.
    #[error("{path}: {why}")]
    DenyList {
        /// Which.
        path: PathBuf,
        /// Where, and what to do.
        why: DenyListFault,
    },
    /// The key is another certificate's.
    #[error("{key} is not the key of {certificate}; copy the node's directory again, as a whole")]
    OtherKey {
        /// The key.
        key: PathBuf,
        /// The certificate.
        certificate: PathBuf,
    },
    /// The authority is none of a project.
    #[error("{path} is no certificate of a project's authority; copy the node's directory again, as a whole")]
    NoAuthority {
        /// Which.
        path: PathBuf,
    },
    /// The certificate is not of this authority.
    #[error(
        "{certificate} is not from the authority in {authority}: {why}; copy the node's directory again, as a whole"
    )]
    OtherAuthority {
        /// The certificate.
        certificate: PathBuf,
        /// The authority's.
        authority: PathBuf,
        /// What the check says.
        why: String,
    },
    /// The certificate is of another node than this one.
    #[error(
        "{path} is of {certified}, but this is {configured}: set node.name, node.address and node.project as the \
         certificate says, or make one for this node: `sinew keys issue {}={}`", .configured.name, .configured.address
    )]
    OtherNode {
        /// Which.
        path: PathBuf,
        /// Whom it is of.
        certified: Identity,
        /// Who the node is.
        configured: Identity,
    },
    /// The certificate does not count now.
    #[error("{path}: {why}")]
    Times {
        /// Which.
        path: PathBuf,
        /// Why, and what to do.
        why: TimeFault,
    },
    /// The certificate is revoked.
    #[error("{path}, number {serial}, is revoked; make a new one with `sinew keys issue`")]
    Denied {
        /// Which.
        path: PathBuf,
        /// Its number.
        serial: Serial,
    },
}

impl Credentials {
    /// Reads the files of the node `configured` in `directory` (see [`files`]), and checks at the time `now` that they are protected, fit
    /// together, are this node's, and count.
    ///
    /// # Errors
    /// All faults, not just the first one; where one hides others, these come when it is mended.
    pub fn load(
        directory: &Path,
        configured: &Identity,
        policy: TimePolicy,
        now: UnixTime,
    ) -> Result<Self, CredentialFaults> {
        let mut faults = Vec::new();
        let path = |name: &str| directory.join(name);
        let parts = (
            keep(&mut faults, files::directory(directory).map_err(CredentialFault::from)),
            keep(&mut faults, read_certificate(&path(files::NODE_CERTIFICATE))),
            keep(&mut faults, read_key(&path(files::NODE_KEY))),
            keep(&mut faults, read_certificate(&path(files::AUTHORITY))),
            keep(&mut faults, read_discovery(&path(files::DISCOVERY_KEY))),
            keep(&mut faults, read_denied(&path(files::DENIED))),
        );
        let (Some(()), Some(certificate), Some(key), Some(authority), Some(discovery), Some(denied)) = parts
        else {
            return Err(CredentialFaults(faults));
        };
        let Some(anchor) = keep(&mut faults, anchor(&path(files::AUTHORITY), &authority, configured)) else {
            return Err(CredentialFaults(faults));
        };
        let floor = certificate.validity().from;
        let denied = Arc::new(ArcSwap::from_pointee(denied));
        let believed = Believed { anchor, project: configured.project.clone(), denied, policy, floor };
        let mut credentials = Self {
            identity: configured.clone(),
            certificate,
            key,
            believed,
            discovery,
            directory: directory.to_owned(),
            warnings: Vec::new(),
        };
        credentials.check(directory, now, &mut faults);
        if !faults.is_empty() {
            return Err(CredentialFaults(faults));
        }
        credentials.warnings =
            credentials.policy().warning(credentials.certificate.validity(), now).into_iter().collect();
        Ok(credentials)
    }

    fn check(&self, directory: &Path, now: UnixTime, faults: &mut Vec<CredentialFault>) {
        let path = directory.join(files::NODE_CERTIFICATE);
        let (key, authority) = (directory.join(files::NODE_KEY), directory.join(files::AUTHORITY));
        let usages = [KeyUsage::client_auth(), KeyUsage::server_auth()];
        if let Err(why) = tls::fits(&self.certificate, &self.key) {
            faults.push(match why {
                None => CredentialFault::OtherKey { key, certificate: path.clone() },
                Some(why) => CredentialFault::NoKey { path: key, why },
            });
        }
        if let Err(why) = verifier::signed(&self.certificate, &self.believed.anchor, usages) {
            let certificate = path.clone();
            faults.push(CredentialFault::OtherAuthority { certificate, authority, why });
        }
        match self.certificate.identity() {
            Some(certified) if certified == self.identity => {}
            Some(certified) => {
                let configured = self.identity.clone();
                faults.push(CredentialFault::OtherNode { path: path.clone(), certified, configured });
            }
            None => {
                let why = "a certificate that names no node".to_owned();
                faults.push(CredentialFault::NoCertificate { path: path.clone(), why });
            }
        }
        let serial = self.certificate.serial();
        if self.believed.denied.load().has(serial) {
            faults.push(CredentialFault::Denied { path: path.clone(), serial: serial.clone() });
        }
        if let Err(why) = self.believed.judge(self.certificate.validity(), now) {
            faults.push(CredentialFault::Times { path, why });
        }
    }

    /// When certificates count here.
    #[must_use]
    pub const fn policy(&self) -> TimePolicy {
        self.believed.policy
    }

    /// Reads the deny list in `directory` again, as [`load`](Self::load) does.
    ///
    /// # Errors
    /// It is not there, cannot be read, or others can change it.
    pub fn deny_list(directory: &Path) -> Result<DenyList, CredentialFaults> {
        let mut faults = Vec::new();
        let parts = (
            keep(&mut faults, files::directory(directory).map_err(CredentialFault::from)),
            keep(&mut faults, read_denied(&directory.join(files::DENIED))),
        );
        match parts {
            (Some(()), Some(denied)) => Ok(denied),
            (None, _) | (_, None) => Err(CredentialFaults(faults)),
        }
    }

    /// Where they were read from.
    #[must_use]
    pub fn directory(&self) -> &Path {
        &self.directory
    }

    /// Which node these are of.
    #[must_use]
    pub const fn identity(&self) -> &Identity {
        &self.identity
    }

    /// The number of its certificate.
    #[must_use]
    pub const fn serial(&self) -> &Serial {
        self.certificate.serial()
    }

    /// From when until when its certificate counts.
    #[must_use]
    pub const fn validity(&self) -> Validity {
        self.certificate.validity()
    }

    /// The project's key for datagrams of discovery.
    #[must_use]
    pub const fn discovery(&self) -> &DiscoveryKey {
        &self.discovery
    }

    /// What the node should say at its start: its clock is not set, times are not looked at, its certificate ends soon.
    #[must_use]
    pub fn warnings(&self) -> &[String] {
        &self.warnings
    }
}

fn keep<T>(faults: &mut Vec<CredentialFault>, read: Result<T, CredentialFault>) -> Option<T> {
    read.map_err(|fault| faults.push(fault)).ok()
}

pub(super) fn read_certificate(path: &Path) -> Result<Certificate, CredentialFault> {
    let bytes = files::certificate(path)?;
    let no = |why: String| CredentialFault::NoCertificate { path: path.to_owned(), why };
    let mut found = CertificateDer::pem_slice_iter(&bytes);
    let first = found.next().ok_or_else(|| no("no certificate in PEM".to_owned()))?;
    if found.next().is_some() {
        return Err(no("more than one certificate".to_owned()));
    }
    let der = first.map_err(|why| no(words(&why)))?;
    Certificate::read(der).map_err(|Malformed| no(Malformed.to_string()))
}

fn read_key(path: &Path) -> Result<PrivateKeyDer<'static>, CredentialFault> {
    let bytes = files::secret(path)?;
    let no = |why: PemError| CredentialFault::NoKey { path: path.to_owned(), why: words(&why) };
    PrivateKeyDer::from_pem_slice(&bytes).map_err(no)
}

fn read_discovery(path: &Path) -> Result<DiscoveryKey, CredentialFault> {
    let bytes = files::secret(path)?;
    let why = || "64 hexadecimal digits are".to_owned();
    DiscoveryKey::read(&bytes).ok_or_else(|| CredentialFault::NoKey { path: path.to_owned(), why: why() })
}

fn read_denied(path: &Path) -> Result<DenyList, CredentialFault> {
    let bytes = files::denied(path)?;
    let fault = |why| CredentialFault::DenyList { path: path.to_owned(), why };
    DenyList::read(&String::from_utf8_lossy(&bytes)).map_err(fault)
}

/// What is in a PEM file that cannot be read; never the content itself, which may be a key.
fn words(why: &PemError) -> String {
    // Some of these have a line of the file in them, which may be the key.
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
) -> Result<TrustAnchor<'static>, CredentialFault> {
    let none = || CredentialFault::NoAuthority { path: path.to_owned() };
    let project = authority.project().ok_or_else(none)?;
    if project != configured.project {
        let why = format!(
            "the authority of project {project:?}, and this node's project (node.project) is {:?}",
            configured.project
        );
        return Err(CredentialFault::NoCertificate { path: path.to_owned(), why });
    }
    verifier::anchor(authority).ok_or_else(none)
}

impl CredentialFaults {
    /// All of them, at least one.
    #[must_use]
    pub fn faults(&self) -> &[CredentialFault] {
        &self.0
    }
}

impl std::error::Error for CredentialFaults {}

impl fmt::Display for CredentialFaults {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (at, fault) in self.0.iter().enumerate() {
            write!(f, "{}{fault}", if at == 0 { "" } else { "\n" })?;
        }
        Ok(())
    }
}

/// Says whose they are, and no secret.
impl fmt::Debug for Credentials {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Credentials({}, number {})", self.identity, self.serial())
    }
}
