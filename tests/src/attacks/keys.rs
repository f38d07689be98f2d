//! Keys of the robot that is attacked, as `sinew keys` makes them, and of a project of the same name whose authority is another one.

use std::{
    fs::{self, Permissions},
    io,
    net::Ipv4Addr,
    os::unix::fs::PermissionsExt as _,
    path::{Path, PathBuf},
    sync::Arc,
};

use rcgen::{BasicConstraints, CertificateParams, ExtendedKeyUsagePurpose, IsCa, Issuer, KeyPair, SanType};
use sinew::{
    NodeAddress,
    security::{
        Certificate, DiscoveryKey, Identity, files, project_uri,
        rustls::pki_types::{CertificateDer, PrivateKeyDer, PrivatePkcs8KeyDer},
    },
};

use super::stranger::Client;
use crate::OwnDirectory;

/// The project of the robot.
pub(super) const PROJECT: &str = "attacked";
/// A node of the robot, whose keys were stolen or are carried by somebody whom nobody knows yet.
pub(super) const SPARE: Who = Who { name: "spare", host: 9 };
/// One whose certificate was revoked.
pub(super) const REVOKED: Who = Who { name: "revoked", host: 10 };
/// Those of the robot itself.
pub(super) const HIP: Who = Who { name: "hip", host: 1 };
pub(super) const KNEE: Who = Who { name: "knee", host: 2 };
pub(super) const ANKLE: Who = Who { name: "ankle", host: 4 };
/// One of the other authority, on the attacker's host.
pub(super) const MALLORY: Who = Who { name: "mallory", host: 3 };

/// A node's name, and the last byte of its address.
#[derive(Clone, Copy, Debug)]
pub(super) struct Who {
    pub(super) name: &'static str,
    pub(super) host: u8,
}

impl Who {
    pub(super) const fn address(self) -> Ipv4Addr {
        Ipv4Addr::new(10, 77, 0, self.host)
    }

    pub(super) fn node(self) -> NodeAddress {
        self.address().into()
    }

    fn identity(self) -> Identity {
        Identity { project: PROJECT.to_owned(), address: self.node(), name: self.name.to_owned() }
    }
}

/// All keys of one robot. They go with it.
pub(super) struct Keys {
    directory: OwnDirectory,
}

impl Keys {
    pub(super) fn make() -> Self {
        Self::try_make().expect("the system's directory for temporary files can be written to")
    }

    fn try_make() -> io::Result<Self> {
        let keys = Self { directory: OwnDirectory::new() };
        make(&keys.directory.join("ours"), &[HIP, KNEE, ANKLE, SPARE, REVOKED])?;
        make(&keys.directory.join("others"), &[MALLORY, HIP])?;
        let revoked = Certificate::from_file(&keys.of(REVOKED).join(files::NODE_CERTIFICATE))
            .map_err(io::Error::other)?;
        for who in [HIP, KNEE, ANKLE] {
            put(&keys.of(who), files::DENIED, 0o644, &format!("{}\n", revoked.serial()))?;
        }
        Ok(keys)
    }

    /// A directory of the scene's own.
    pub(super) fn path(&self, name: &str) -> PathBuf {
        self.directory.join(name)
    }

    /// The directory of a node of the robot's.
    pub(super) fn of(&self, who: Who) -> PathBuf {
        self.directory.join(&format!("ours/{}", who.name))
    }

    /// The directory of a node of the other authority's.
    pub(super) fn of_others(&self, who: Who) -> PathBuf {
        self.directory.join(&format!("others/{}", who.name))
    }

    /// A client that shows this certificate, and takes any server.
    pub(super) fn tls(&self, who: Who) -> Arc<Client> {
        client(&self.of(who))
    }

    /// The same of the other authority's.
    pub(super) fn tls_of_others(&self, who: Who) -> Arc<Client> {
        client(&self.of_others(who))
    }
}

fn client(directory: &Path) -> Arc<Client> {
    let certificate =
        Certificate::from_file(&directory.join(files::NODE_CERTIFICATE)).expect("it was just made");
    let key = fs::read(directory.join("node.der")).expect("it was just made");
    let key = PrivateKeyDer::from(PrivatePkcs8KeyDer::from(key));
    let chain: Vec<CertificateDer<'static>> = vec![certificate.der().clone()];
    super::stranger::client(Some((chain, key)))
}

fn make(directory: &Path, nodes: &[Who]) -> io::Result<()> {
    let mut params = CertificateParams::default();
    params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
    params.subject_alt_names = vec![uri(&project_uri(PROJECT))];
    let key = KeyPair::generate().map_err(io::Error::other)?;
    let authority = params.self_signed(&key).map_err(io::Error::other)?.pem();
    let issuer = Issuer::from_params(&params, &key);
    let discovery = DiscoveryKey::generate()?;
    for who in nodes {
        let mut params = CertificateParams::default();
        params.subject_alt_names = vec![uri(&who.identity().uri())];
        params.extended_key_usages =
            vec![ExtendedKeyUsagePurpose::ServerAuth, ExtendedKeyUsagePurpose::ClientAuth];
        let key = KeyPair::generate().map_err(io::Error::other)?;
        let certificate = params.signed_by(&key, &issuer).map_err(io::Error::other)?.pem();
        let directory = directory.join(who.name);
        fs::create_dir_all(&directory)?;
        fs::set_permissions(&directory, Permissions::from_mode(0o700))?;
        put(&directory, files::NODE_KEY, 0o600, &key.serialize_pem())?;
        put(&directory, files::NODE_CERTIFICATE, 0o644, &certificate)?;
        put(&directory, files::AUTHORITY, 0o644, &authority)?;
        put(&directory, files::DISCOVERY_KEY, 0o600, &discovery.text())?;
        put(&directory, files::DENIED, 0o644, "")?;
        // The same key for peers by hand.
        fs::write(directory.join("node.der"), key.serialize_der())?;
    }
    Ok(())
}

fn uri(text: &str) -> SanType {
    SanType::URI(text.try_into().expect("it is ASCII"))
}

fn put(directory: &Path, name: &str, mode: u32, text: &str) -> io::Result<()> {
    let path = directory.join(name);
    fs::write(&path, text)?;
    fs::set_permissions(&path, Permissions::from_mode(mode))
}
