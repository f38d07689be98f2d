//! Keys of the robot that is attacked, as `sinew keys` makes them, and of a project of the same name whose authority is another one.

use std::{
    fs, io,
    net::Ipv4Addr,
    path::{Path, PathBuf},
    sync::Arc,
};

use sinew::{
    NodeAddress,
    security::{
        Certificate, Identity, files,
        rustls::pki_types::{CertificateDer, PrivateKeyDer, PrivatePkcs8KeyDer},
    },
};

use super::stranger::Client;
use crate::{OwnDirectory, keys::put};

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

    pub(super) fn identity(self) -> Identity {
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
    let key = fs::read(directory.join(crate::keys::NODE_KEY_DER)).expect("it was just made");
    let key = PrivateKeyDer::from(PrivatePkcs8KeyDer::from(key));
    let chain: Vec<CertificateDer<'static>> = vec![certificate.der().clone()];
    super::stranger::client(Some((chain, key)))
}

fn make(directory: &Path, nodes: &[Who]) -> io::Result<()> {
    let identities: Vec<Identity> = nodes.iter().map(|who| who.identity()).collect();
    crate::keys::make(directory, &identities)
}
