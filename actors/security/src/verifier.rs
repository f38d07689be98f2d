//! Verification of certificates. A certificate must be signed directly by the project's authority, be within
//! its validity period, and not be revoked.
//!
//! Both ends of a connection check by the same rules. Only the pinned authority is trusted, not the
//! authorities of the host's system. There are no intermediate certificates: a chain is one certificate long.

use std::sync::Arc;

use arc_swap::ArcSwap;
use rustls::{
    CertificateError, DigitallySignedStruct, DistinguishedName, Error, OtherError, SignatureScheme,
    client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier},
    crypto::{self, WebPkiSupportedAlgorithms},
    pki_types::{CertificateDer, ServerName, TrustAnchor, UnixTime},
    server::danger::{ClientCertVerified, ClientCertVerifier},
};
use sinew_model::config::TimePolicy;
use webpki::{EndEntityCert, KeyUsage};

use super::{
    Certificate, DenyList, Judged, MalformedCertificateError, Peer, PeerError, Validity, ValidityError, tls,
};

/// The trust settings of a node.
#[derive(Clone, Debug)]
pub(super) struct TrustSettings {
    pub(super) anchor: TrustAnchor<'static>,
    pub(super) project: String,
    /// The active deny list. It can be replaced while connections are open, and is shared by all clones of
    /// these settings.
    pub(super) denied: Arc<ArcSwap<DenyList>>,
    pub(super) policy: TimePolicy,
    /// A time that is certainly past: the time at which this node's own certificate was made.
    pub(super) floor: UnixTime,
}

impl TrustSettings {
    pub(super) fn judge(&self, validity: Validity, now: UnixTime) -> Result<Judged, ValidityError> {
        validity.judge(self.policy, now, self.floor)
    }

    /// Returns the identity in `shown` after its signature by the authority was verified. Nothing else in it
    /// is trusted before that.
    pub(super) fn authenticate(
        &self,
        shown: &CertificateDer<'_>,
        usage: KeyUsage,
        now: UnixTime,
    ) -> Result<Peer, PeerError> {
        let certificate = Certificate::read(shown.clone().into_owned())
            .map_err(|MalformedCertificateError| PeerError::NoNode("it cannot be read".to_owned()))?;
        signed(&certificate, &self.anchor, [usage]).map_err(PeerError::OtherAuthority)?;
        let nameless = || PeerError::NoNode("it names no node".to_owned());
        let identity = certificate.identity().ok_or_else(nameless)?;
        if identity.project != self.project {
            return Err(PeerError::OtherProject { identity, project: self.project.clone() });
        }
        let serial = certificate.serial().clone();
        if self.denied.load().has(&serial) {
            return Err(PeerError::Denied { identity, serial });
        }
        let validity = certificate.validity();
        match self.judge(validity, now) {
            Ok(times) => Ok(Peer { identity, serial, validity, times }),
            Err(why) => Err(PeerError::Times { identity, why }),
        }
    }
}

/// Returns the trust anchor of `certificate`, or `None` if it is not an authority's.
pub(super) fn anchor(certificate: &Certificate) -> Option<TrustAnchor<'static>> {
    Some(webpki::anchor_from_trusted_cert(certificate.der()).ok()?.to_owned())
}

/// Checks whether the authority signed this certificate for these usages. Validity periods are checked separately.
///
/// # Errors
/// Returns a description of the failure.
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

/// The certificate verifier for connections.
#[derive(Debug)]
pub(super) struct Verifier {
    pub(super) trust: TrustSettings,
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
        let authenticated = if more == 0 {
            self.trust.authenticate(shown, usage, now).map(drop)
        } else {
            Err(PeerError::NoNode(format!("{more} more certificates stand between it and the authority")))
        };
        authenticated.map_err(|why| CertificateError::Other(OtherError(Arc::new(why))).into())
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
    /// Returns no hints: an unauthenticated client need not learn the project's name.
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

/// A connection with an older version never reaches this code.
fn only_tls13() -> Error {
    Error::General("only TLS 1.3 is spoken between nodes".to_owned())
}
