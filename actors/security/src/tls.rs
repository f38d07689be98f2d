//! The rustls configuration of a node. It is the same for every connection to another node, of every class.
//!
//! | | | why |
//! | --- | --- | --- |
//! | version | TLS 1.3 only | nothing older is needed, so an attacker cannot force a downgrade |
//! | cryptography | one provider, ring | none is taken from the process: rustls panics if one program has two |
//! | certificates | of both ends, of the project's authority alone | no authority of the host's system can admit a node |
//! | tickets, early data | none | early data can be replayed by others; a robot's handshake is rare, and short |
//! | protocol (ALPN) | `sinew/1`, on both ends | bytes of another protocol are not parsed as Sinew's |
//! | name of the server | not sent | an eavesdropper need not learn it |
//!
//! A handshake has no deadline of its own: the reader of the socket sets one. In TLS 1.3 the dialling end is
//! ready before the other end has seen its certificate. If it was rejected, the dialling end learns that from
//! the connection afterwards.

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
    Certificate, Credentials, DenyList, Identity, Peer, PeerError,
    verifier::{TrustSettings, Verifier},
};

/// Protocol name (ALPN) that both ends send in the handshake.
pub const PROTOCOL: &[u8] = b"sinew/1";

/// The TLS configurations for both ends of a node's connections to other nodes.
#[derive(Clone, Debug)]
pub struct Tls {
    client: Arc<ClientConfig>,
    server: Arc<ServerConfig>,
    trust: Arc<TrustSettings>,
    identity: Identity,
}

impl Tls {
    /// Creates the configurations from a node's `credentials`. Each handshake reads the time from `clock`.
    ///
    /// # Errors
    /// Returns an error if rustls rejects the key, because ring does not support its kind.
    pub fn new(credentials: &Credentials, clock: Arc<dyn TimeProvider>) -> Result<Self, Error> {
        let provider = Arc::new(provider());
        let algorithms = provider.signature_verification_algorithms;
        let verifier = Arc::new(Verifier { trust: credentials.trust.clone(), algorithms });
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
            trust: Arc::new(credentials.trust.clone()),
            identity: credentials.identity.clone(),
        })
    }

    /// Returns the configuration of the dialling end, for use with [`server_name`](Self::server_name).
    #[must_use]
    pub fn client(&self) -> Arc<ClientConfig> {
        self.client.clone()
    }

    /// Returns the configuration of the accepting end.
    #[must_use]
    pub fn server(&self) -> Arc<ServerConfig> {
        self.server.clone()
    }

    /// Returns the server name that rustls requires and Sinew does not use. It is neither sent nor compared.
    /// [`peer`](Self::peer) returns the identity of the other end.
    #[must_use]
    pub fn server_name() -> ServerName<'static> {
        ServerName::try_from("node.sinew.invalid").expect("a name under .invalid (RFC 6761) is a name")
    }

    /// Returns the identity of the node.
    #[must_use]
    pub const fn identity(&self) -> &Identity {
        &self.identity
    }

    /// Returns the peer of a connection after its complete handshake. No data of the connection may be
    /// trusted before this call. Only this function checks the protocol, and whether the peer is the
    /// `expected` node.
    ///
    /// # Errors
    /// Returns why the peer is rejected. Close the connection, and log the error.
    pub fn peer(
        &self,
        connection: &CommonState,
        expected: Option<NodeAddress>,
        now: UnixTime,
    ) -> Result<Peer, PeerError> {
        if connection.is_handshaking() {
            return Err(PeerError::Unfinished);
        }
        let protocol = connection.alpn_protocol();
        if protocol != Some(PROTOCOL) {
            let chosen = protocol.map(|name| String::from_utf8_lossy(name).into_owned());
            return Err(PeerError::OtherProtocol(chosen));
        }
        let shown = connection.peer_certificates().unwrap_or_default();
        let [certificate] = shown else {
            return Err(PeerError::NoNode(format!("{} certificates", shown.len())));
        };
        let peer = self.trust.authenticate(certificate, KeyUsage::client_auth(), now)?;
        match expected.filter(|expected| *expected != peer.identity.address) {
            Some(expected) => Err(PeerError::SomebodyElse { identity: peer.identity, expected }),
            None => Ok(peer),
        }
    }

    /// Puts another deny list in force for all later handshakes of each [`Tls`] from the same credentials.
    /// Established connections are checked with [`denies`](Self::denies).
    pub fn deny(&self, denied: DenyList) {
        self.trust.denied.store(Arc::new(denied));
    }

    /// Returns the active deny list.
    #[must_use]
    pub fn denied(&self) -> Arc<DenyList> {
        self.trust.denied.load_full()
    }

    /// Returns why `peer`, which was accepted before, would be rejected now: its certificate is on the deny list.
    #[must_use]
    pub fn denies(&self, peer: &Peer) -> Option<PeerError> {
        let Peer { identity, serial, .. } = peer;
        let is_denied = self.trust.denied.load().has(serial);
        is_denied.then(|| PeerError::Denied { identity: identity.clone(), serial: serial.clone() })
    }
}

/// Returns the only provider of cryptography.
pub(super) fn provider() -> CryptoProvider {
    ring::default_provider()
}

/// Checks whether `key` is the key of `certificate`.
///
/// # Errors
/// Returns an error if it is not. The error has a description if the key is not usable.
pub(super) fn fits(certificate: &Certificate, key: &PrivateKeyDer<'_>) -> Result<(), Option<String>> {
    let loaded = provider().key_provider.load_private_key(key.clone_key());
    let loaded = loaded.map_err(|why| Some(why.to_string()))?;
    let read = webpki::EndEntityCert::try_from(certificate.der()).map_err(|why| Some(why.to_string()))?;
    match loaded.public_key() {
        Some(own) if own == read.subject_public_key_info() => Ok(()),
        Some(_) | None => Err(None),
    }
}
