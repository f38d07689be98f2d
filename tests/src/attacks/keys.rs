//! Keys of the attacked robot, as `sinew keys` makes them, and keys of a project with the same name but
//! another authority.

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

use super::raw_peer::Client;
use sinew_testkit::{TestDirectory, keys::put};

/// The project of the robot.
pub(super) const PROJECT: &str = "attacked";
/// A node of the robot with stolen keys, or with the keys of a peer that the other nodes do not know yet.
pub(super) const SPARE: TestNode = TestNode { name: "spare", host: 9 };
/// A node with a revoked certificate.
pub(super) const REVOKED: TestNode = TestNode { name: "revoked", host: 10 };
/// The nodes of the robot itself.
pub(super) const HIP: TestNode = TestNode { name: "hip", host: 1 };
pub(super) const KNEE: TestNode = TestNode { name: "knee", host: 2 };
pub(super) const ANKLE: TestNode = TestNode { name: "ankle", host: 4 };
/// A node of the other authority, on the attacker's host.
pub(super) const MALLORY: TestNode = TestNode { name: "mallory", host: 3 };

/// A node's name, and the last byte of its address.
#[derive(Clone, Copy, Debug)]
pub(super) struct TestNode {
    pub(super) name: &'static str,
    pub(super) host: u8,
}

impl TestNode {
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

/// All keys of one robot. The files are removed on drop.
pub(super) struct Keys {
    directory: TestDirectory,
}

impl Keys {
    pub(super) fn make() -> Self {
        Self::try_make().expect("the system's directory for temporary files can be written to")
    }

    fn try_make() -> io::Result<Self> {
        let keys = Self { directory: TestDirectory::new() };
        make(&keys.directory.join("ours"), &[HIP, KNEE, ANKLE, SPARE, REVOKED])?;
        make(&keys.directory.join("others"), &[MALLORY, HIP])?;
        let revoked = Certificate::from_file(&keys.of(REVOKED).join(files::NODE_CERTIFICATE))
            .map_err(io::Error::other)?;
        for node in [HIP, KNEE, ANKLE] {
            put(&keys.of(node), files::DENIED, 0o644, &format!("{}\n", revoked.serial()))?;
        }
        Ok(keys)
    }

    /// A path in the directory of this scene.
    pub(super) fn path(&self, name: &str) -> PathBuf {
        self.directory.join(name)
    }

    /// The key directory of a node of the robot.
    pub(super) fn of(&self, node: TestNode) -> PathBuf {
        self.directory.join(&format!("ours/{}", node.name))
    }

    /// The key directory of a node of the other authority.
    pub(super) fn of_others(&self, node: TestNode) -> PathBuf {
        self.directory.join(&format!("others/{}", node.name))
    }

    /// A TLS client that presents this certificate and accepts any server.
    pub(super) fn tls(&self, node: TestNode) -> Arc<Client> {
        client(&self.of(node))
    }

    /// The same with a certificate of the other authority.
    pub(super) fn tls_of_others(&self, node: TestNode) -> Arc<Client> {
        client(&self.of_others(node))
    }
}

fn client(directory: &Path) -> Arc<Client> {
    let certificate =
        Certificate::from_file(&directory.join(files::NODE_CERTIFICATE)).expect("it was just made");
    let key = fs::read(directory.join(sinew_testkit::keys::NODE_KEY_DER)).expect("it was just made");
    let key = PrivateKeyDer::from(PrivatePkcs8KeyDer::from(key));
    let chain: Vec<CertificateDer<'static>> = vec![certificate.der().clone()];
    super::raw_peer::client(Some((chain, key)))
}

fn make(directory: &Path, nodes: &[TestNode]) -> io::Result<()> {
    let identities: Vec<Identity> = nodes.iter().map(|node| node.identity()).collect();
    sinew_testkit::keys::make(directory, &identities)
}
