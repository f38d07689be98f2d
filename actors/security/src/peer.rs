//! The identity of a peer, and the errors with which a peer is rejected.

use rustls::{AlertDescription, CertificateError, Error};
use sinew_runtime::tid::NodeAddress;

use super::{Identity, Judged, PROTOCOL, Serial, Validity, ValidityError, date};

/// The node at the other end of a connection, proven by its certificate and the key of that certificate.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Peer {
    /// Identity of the node.
    pub identity: Identity,
    /// Serial number of its certificate.
    pub serial: Serial,
    /// Validity period of the certificate.
    pub validity: Validity,
    /// Result of the check of the times. If the times were not checked or the clock is not set, the node should log it.
    pub times: Judged,
}

impl Peer {
    /// Returns the warning for a peer that was accepted without a check of its certificate's times, or `None`
    /// if they are valid.
    #[must_use]
    pub fn warning(&self) -> Option<String> {
        let Self { identity, validity, times, .. } = self;
        match times {
            Judged::Valid => None,
            Judged::ClockNotSet => Some(format!(
                "{identity} is taken although the clock here is not set; its certificate ends on {}",
                date(&validity.until)
            )),
            Judged::NotLookedAt => Some(format!(
                "{identity} is taken without a look at the times of its certificate ({validity}): security.times = \"ignored\""
            )),
        }
    }
}

/// The reason why the other end is rejected. The other end or its configuration is at fault; nothing was changed.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PeerError {
    /// The handshake is not complete, so nothing is proven yet.
    #[error("the handshake is not over: the identity of the peer is not proven")]
    Unfinished,
    /// The other end does not speak Sinew's protocol, or speaks another version.
    #[error(
        "the other end does not speak {:?} (it chose {}); run the same version of Sinew on both",
        String::from_utf8_lossy(PROTOCOL),
        .0.as_deref().map_or_else(|| "nothing".to_owned(), |name| format!("{name:?}"))
    )]
    OtherProtocol(Option<String>),
    /// The other end's certificate is not a node's.
    #[error("what the other end shows is no certificate of a node: {0}")]
    NoNode(String),
    /// The certificate was signed by another authority.
    #[error(
        "the other end's certificate is not from this project's authority: {0}. It has keys of another project, or of this \
         one from before they were made anew: `sinew keys issue NODE --keys DIR`, where this project's ca.key is, makes it some"
    )]
    OtherAuthority(String),
    /// The certificate is of another project with the same authority.
    #[error("{identity} is at the other end, and this is project {project:?}")]
    OtherProject {
        /// Identity of the other end.
        identity: Identity,
        /// The project here.
        project: String,
    },
    /// The certificate is revoked.
    #[error(
        "the certificate of {identity}, number {serial}, is revoked; if this is the real one, `sinew keys issue NODE --keys DIR`, where ca.key is, makes it another"
    )]
    Denied {
        /// Identity in the certificate.
        identity: Identity,
        /// Serial number of the certificate.
        serial: Serial,
    },
    /// The certificate is not valid now.
    #[error("the certificate of {identity}: {why}")]
    Times {
        /// Identity in the certificate.
        identity: Identity,
        /// The reason and the remedy.
        why: ValidityError,
    },
    /// Another node than the expected one is at the other end.
    #[error(
        "{identity} is at the other end, where {expected} was to be: two nodes with the keys of one, a wrong address in the \
         configuration, or an impostor"
    )]
    SomebodyElse {
        /// Identity of the other end.
        identity: Identity,
        /// Address of the expected node.
        expected: NodeAddress,
    },
}

/// Describes why a handshake failed, for the operator of the robot.
#[must_use]
#[expect(
    clippy::wildcard_enum_match_arm,
    reason = "rustls' list of errors grows; those not named here speak for themselves"
)]
pub fn words(error: &Error) -> String {
    const THERE: &str = "the other end does not take this node";
    if let Error::InvalidCertificate(CertificateError::Other(other)) = error
        && let Some(fault) = other.0.downcast_ref::<PeerError>()
    {
        return fault.to_string();
    }
    match error {
        Error::AlertReceived(AlertDescription::CertificateUnknown) => {
            format!("{THERE}'s certificate; its log says why")
        }
        Error::AlertReceived(AlertDescription::CertificateRequired) => {
            format!("{THERE}: it got no certificate from here")
        }
        Error::AlertReceived(AlertDescription::ProtocolVersion) | Error::PeerIncompatible(_) => {
            format!("the other end does not speak TLS 1.3, or not as it is spoken between nodes ({error})")
        }
        Error::AlertReceived(AlertDescription::NoApplicationProtocol) | Error::NoApplicationProtocol => {
            PeerError::OtherProtocol(None).to_string()
        }
        Error::NoCertificatesPresented => {
            "the other end shows no certificate; give it keys of this project with `sinew keys issue`"
                .to_owned()
        }
        Error::InvalidMessage(_) | Error::InappropriateMessage { .. } => {
            format!(
                "the other end does not speak TLS ({error}): it may be a node without [security], or no node"
            )
        }
        Error::InvalidCertificate(_) => {
            format!("the other end does not hold the key of the certificate that it shows ({error})")
        }
        other => format!("the handshake failed: {other}"),
    }
}
