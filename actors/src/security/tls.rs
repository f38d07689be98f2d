//! What rustls is told, once for a node: the same for every connection to another node, whatever its class.
//!
//! | | | why |
//! | --- | --- | --- |
//! | version | TLS 1.3 only | nothing older is needed, so nothing older can be chosen by whoever is in between |
//! | cryptography | one provider, ring | none is picked up from the process: two in one program are a panic in rustls |
//! | certificates | of both ends, of the project's authority alone | no authority of the host's system can let anybody in |
//! | tickets, early data | none | what is sent early can be sent again by others; a robot's handshake is rare, and short |
//! | protocol (ALPN) | `sinew/1`, on both ends | bytes meant for another protocol are not taken for Sinew's |
//! | name of the server | not sent | who listens on the network needs not be told |
//!
//! A handshake has no deadline of its own: whoever reads the socket gives it one. In TLS 1.3 the dialling end is ready before the other
//! one has seen its certificate: that it was refused, it reads from the connection afterwards.

use std::sync::Arc;

use rustls::{
    ClientConfig, CommonState, Error, ServerConfig,
    client::Resumption,
    crypto::{CryptoProvider, ring},
    pki_types::{PrivateKeyDer, ServerName, UnixTime},
    server::NoServerSessionStorage,
    time_provider::TimeProvider,
    version::TLS13,
};
use sinew_runtime::tid::NodeAddress;
use webpki::KeyUsage;

use super::{
    Certificate, Credentials, DenyList, Identity, Peer, PeerFault,
    verifier::{Believed, Verifier},
};

/// What is spoken inside, as both ends say in the handshake (ALPN).
pub const PROTOCOL: &[u8] = b"sinew/1";

/// Both ends of a node's connections to other nodes.
#[derive(Clone, Debug)]
pub struct Tls {
    client: Arc<ClientConfig>,
    server: Arc<ServerConfig>,
    believed: Arc<Believed>,
    identity: Identity,
}

impl Tls {
    /// From a node's `credentials`; `clock` is asked for the time in each handshake.
    ///
    /// # Errors
    /// rustls does not take the key: of a kind that ring does not know.
    pub fn new(credentials: &Credentials, clock: Arc<dyn TimeProvider>) -> Result<Self, Error> {
        let provider = Arc::new(provider());
        let algorithms = provider.signature_verification_algorithms;
        let verifier = Arc::new(Verifier { believed: credentials.believed.clone(), algorithms });
        let chain = vec![credentials.certificate.der().clone()];
        let key = &credentials.key;

        let mut client = ClientConfig::builder_with_details(provider.clone(), clock.clone())
            .with_protocol_versions(&[&TLS13])?
            .dangerous()
            .with_custom_certificate_verifier(verifier.clone())
            .with_client_auth_cert(chain.clone(), key.clone_key())?;
        client.alpn_protocols = vec![PROTOCOL.to_vec()];
        client.resumption = Resumption::disabled();
        client.enable_early_data = false;
        client.enable_sni = false;

        let mut server = ServerConfig::builder_with_details(provider, clock)
            .with_protocol_versions(&[&TLS13])?
            .with_client_cert_verifier(verifier)
            .with_single_cert(chain, key.clone_key())?;
        server.alpn_protocols = vec![PROTOCOL.to_vec()];
        server.session_storage = Arc::new(NoServerSessionStorage {});
        server.send_tls13_tickets = 0;
        server.max_early_data_size = 0;

        Ok(Self {
            client: Arc::new(client),
            server: Arc::new(server),
            believed: Arc::new(credentials.believed.clone()),
            identity: credentials.identity.clone(),
        })
    }

    /// For the end that dials; with [`server_name`](Self::server_name).
    #[must_use]
    pub fn client(&self) -> Arc<ClientConfig> {
        self.client.clone()
    }

    /// For the end that is dialled.
    #[must_use]
    pub fn server(&self) -> Arc<ServerConfig> {
        self.server.clone()
    }

    /// What rustls wants to know of a server and Sinew does not use: it is not sent, and not compared with anything. Who is there,
    /// [`peer`](Self::peer) says.
    #[must_use]
    pub fn server_name() -> ServerName<'static> {
        ServerName::try_from("node.sinew.invalid").expect("a name under .invalid (RFC 6761) is a name")
    }

    /// Which node these configurations are of.
    #[must_use]
    pub const fn identity(&self) -> &Identity {
        &self.identity
    }

    /// Who is at the other end of a connection whose handshake is over. Nothing that comes over it may be believed before this was asked:
    /// it alone looks at the protocol, and at whether it is the node that was `expected`.
    ///
    /// # Errors
    /// Nobody that is taken: close the connection, and log the words.
    pub fn peer(
        &self,
        connection: &CommonState,
        expected: Option<NodeAddress>,
        now: UnixTime,
    ) -> Result<Peer, PeerFault> {
        if connection.is_handshaking() {
            return Err(PeerFault::Unfinished);
        }
        let protocol = connection.alpn_protocol();
        if protocol != Some(PROTOCOL) {
            let chosen = protocol.map(|name| String::from_utf8_lossy(name).into_owned());
            return Err(PeerFault::OtherProtocol(chosen));
        }
        let shown = connection.peer_certificates().unwrap_or_default();
        let [certificate] = shown else {
            return Err(PeerFault::NoNode(format!("{} certificates", shown.len())));
        };
        let peer = self.believed.prove(certificate, KeyUsage::client_auth(), now)?;
        match expected.filter(|expected| *expected != peer.identity.address) {
            Some(expected) => Err(PeerFault::SomebodyElse { identity: peer.identity, expected }),
            None => Ok(peer),
        }
    }

    /// Puts another deny list in force, for every handshake from now on, of each [`Tls`] from the same credentials. Connections that stand
    /// are asked for with [`denies`](Self::denies).
    pub fn deny(&self, denied: DenyList) {
        self.believed.denied.store(Arc::new(denied));
    }

    /// The deny list that is in force.
    #[must_use]
    pub fn denied(&self) -> Arc<DenyList> {
        self.believed.denied.load_full()
    }

    /// Why `peer`, who was taken before, would not be taken any more: its certificate is on the deny list.
    #[must_use]
    pub fn denies(&self, peer: &Peer) -> Option<PeerFault> {
        let Peer { identity, serial, .. } = peer;
        let is_denied = self.believed.denied.load().has(serial);
        is_denied.then(|| PeerFault::Denied { identity: identity.clone(), serial: serial.clone() })
    }
}

/// The one provider of cryptography.
pub(super) fn provider() -> CryptoProvider {
    ring::default_provider()
}

/// Whether `key` is the one of `certificate`.
///
/// # Errors
/// It is not; with words, where it is no key that can be used.
pub(super) fn fits(certificate: &Certificate, key: &PrivateKeyDer<'_>) -> Result<(), Option<String>> {
    let loaded = provider().key_provider.load_private_key(key.clone_key());
    let loaded = loaded.map_err(|why| Some(why.to_string()))?;
    let read = webpki::EndEntityCert::try_from(certificate.der()).map_err(|why| Some(why.to_string()))?;
    match loaded.public_key() {
        Some(own) if own == read.subject_public_key_info() => Ok(()),
        Some(_) | None => Err(None),
    }
}
