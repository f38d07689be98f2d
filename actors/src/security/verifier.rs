//! Who may come in: certificates that the project's authority signed itself, in their times, not revoked.
//!
//! Both ends of a connection check by the same rules. Only the pinned authority counts, not what the host's system trusts, and there is
//! nothing between it and a node: a chain is one certificate long.

use std::sync::Arc;

use arc_swap::ArcSwap;
use rustls::{
    CertificateError, DigitallySignedStruct, DistinguishedName, Error, OtherError, SignatureScheme,
    client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier},
    crypto::{self, WebPkiSupportedAlgorithms},
    pki_types::{CertificateDer, ServerName, TrustAnchor, UnixTime},
    server::danger::{ClientCertVerified, ClientCertVerifier},
};
use webpki::{EndEntityCert, KeyUsage};

use super::{
    Certificate, DenyList, Judged, Malformed, Peer, PeerFault, TimeFault, TimePolicy, Validity, tls,
};

/// What a node believes.
#[derive(Clone, Debug)]
pub(super) struct Believed {
    pub(super) anchor: TrustAnchor<'static>,
    pub(super) project: String,
    /// Read again while connections stand: all that believe the same have the same one.
    pub(super) denied: Arc<ArcSwap<DenyList>>,
    pub(super) policy: TimePolicy,
    /// A time that is certainly past: when this node's own certificate was made.
    pub(super) floor: UnixTime,
}

impl Believed {
    pub(super) fn judge(&self, validity: Validity, now: UnixTime) -> Result<Judged, TimeFault> {
        self.policy.judge(validity, now, self.floor)
    }

    /// Which node `shown` is of, as its authority says. Nothing else of it is believed before that signature is.
    pub(super) fn prove(
        &self,
        shown: &CertificateDer<'_>,
        usage: KeyUsage,
        now: UnixTime,
    ) -> Result<Peer, PeerFault> {
        let certificate = Certificate::read(shown.clone().into_owned())
            .map_err(|Malformed| PeerFault::NoNode("it cannot be read".to_owned()))?;
        signed(&certificate, &self.anchor, [usage]).map_err(PeerFault::OtherAuthority)?;
        let nameless = || PeerFault::NoNode("it names no node".to_owned());
        let identity = certificate.identity().ok_or_else(nameless)?;
        if identity.project != self.project {
            return Err(PeerFault::OtherProject { identity, project: self.project.clone() });
        }
        let serial = certificate.serial().clone();
        if self.denied.load().has(&serial) {
            return Err(PeerFault::Denied { identity, serial });
        }
        let validity = certificate.validity();
        match self.judge(validity, now) {
            Ok(times) => Ok(Peer { identity, serial, validity, times }),
            Err(why) => Err(PeerFault::Times { identity, why }),
        }
    }
}

/// The authority of `certificate`; `None` if it is none.
pub(super) fn anchor(certificate: &Certificate) -> Option<TrustAnchor<'static>> {
    Some(webpki::anchor_from_trusted_cert(certificate.der()).ok()?.to_owned())
}

/// Whether the authority has signed this certificate, for these ends of connections. Its times are judged apart from that.
///
/// # Errors
/// It has not, in words.
pub(super) fn signed(
    certificate: &Certificate,
    anchor: &TrustAnchor<'_>,
    usages: impl IntoIterator<Item = KeyUsage>,
) -> Result<(), String> {
    let read = EndEntityCert::try_from(certificate.der()).map_err(|why| why.to_string())?;
    let algorithms = tls::provider().signature_verification_algorithms.all;
    let within = certificate.validity().from;
    for usage in usages {
        let anchors = std::slice::from_ref(anchor);
        match read.verify_for_usage(algorithms, anchors, &[], within, usage, None, None) {
            Ok(_) => {}
            Err(webpki::Error::UnknownIssuer | webpki::Error::InvalidSignatureForPublicKey) => {
                return Err("another authority signed it, or it was changed".to_owned());
            }
            Err(why) => return Err(why.to_string()),
        }
    }
    Ok(())
}

/// The rules for connections.
#[derive(Debug)]
pub(super) struct Verifier {
    pub(super) believed: Believed,
    pub(super) algorithms: WebPkiSupportedAlgorithms,
}

impl Verifier {
    fn verify(
        &self,
        shown: &CertificateDer<'_>,
        more: usize,
        usage: KeyUsage,
        now: UnixTime,
    ) -> Result<(), Error> {
        let proven = if more == 0 {
            self.believed.prove(shown, usage, now).map(drop)
        } else {
            Err(PeerFault::NoNode(format!("{more} more certificates stand between it and the authority")))
        };
        proven.map_err(|why| CertificateError::Other(OtherError(Arc::new(why))).into())
    }
}

impl ServerCertVerifier for Verifier {
    fn verify_server_cert(
        &self,
        end_entity: &CertificateDer<'_>,
        intermediates: &[CertificateDer<'_>],
        _server_name: &ServerName<'_>,
        _ocsp_response: &[u8],
        now: UnixTime,
    ) -> Result<ServerCertVerified, Error> {
        self.verify(end_entity, intermediates.len(), KeyUsage::server_auth(), now)?;
        Ok(ServerCertVerified::assertion())
    }

    fn verify_tls12_signature(
        &self,
        _message: &[u8],
        _certificate: &CertificateDer<'_>,
        _signature: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        Err(only_tls13())
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signature: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        crypto::verify_tls13_signature(message, certificate, signature, &self.algorithms)
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        self.algorithms.supported_schemes()
    }
}

impl ClientCertVerifier for Verifier {
    /// None: whoever asks needs not be told who the project is.
    fn root_hint_subjects(&self) -> &[DistinguishedName] {
        &[]
    }

    fn verify_client_cert(
        &self,
        end_entity: &CertificateDer<'_>,
        intermediates: &[CertificateDer<'_>],
        now: UnixTime,
    ) -> Result<ClientCertVerified, Error> {
        self.verify(end_entity, intermediates.len(), KeyUsage::client_auth(), now)?;
        Ok(ClientCertVerified::assertion())
    }

    fn verify_tls12_signature(
        &self,
        _message: &[u8],
        _certificate: &CertificateDer<'_>,
        _signature: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        Err(only_tls13())
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signature: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        crypto::verify_tls13_signature(message, certificate, signature, &self.algorithms)
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        self.algorithms.supported_schemes()
    }
}

/// No connection of an older version comes as far as this.
fn only_tls13() -> Error {
    Error::General("only TLS 1.3 is spoken between nodes".to_owned())
}
