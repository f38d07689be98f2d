//! Who is at the other end, or why nobody is taken there, in words.

use rustls::{AlertDescription, CertificateError, Error};
use sinew_runtime::tid::NodeAddress;

use super::{Identity, Judged, PROTOCOL, Serial, TimeFault, Validity, date};

/// The node at the other end of a connection, proven by its certificate and the key that belongs to it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Peer {
    /// Which node.
    pub identity: Identity,
    /// The number of its certificate.
    pub serial: Serial,
    /// From when until when that counts.
    pub validity: Validity,
    /// What its times were good for: where they were not looked at, or the clock is not set, the node should say so.
    pub times: Judged,
}

impl Peer {
    /// What the node should log of a peer that was taken without a look at the times of its certificate; `None` where they hold.
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

/// Why the other end is not taken. It, or who set it up, is at fault; nothing was changed.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PeerFault {
    /// The handshake is not over: nothing is proven yet.
    #[error("the handshake is not over: nobody has proven who is there")]
    Unfinished,
    /// The other end does not speak Sinew's protocol, or another version of it.
    #[error(
        "the other end does not speak {:?} (it chose {}); run the same version of Sinew on both",
        String::from_utf8_lossy(PROTOCOL),
        .0.as_deref().map_or_else(|| "nothing".to_owned(), |name| format!("{name:?}"))
    )]
    OtherProtocol(Option<String>),
    /// What it shows is no certificate of a node.
    #[error("what the other end shows is no certificate of a node: {0}")]
    NoNode(String),
    /// Its certificate is of another authority.
    #[error(
        "the other end's certificate is not from this project's authority: {0}. It has keys of another project, or of this \
         one from before they were made anew: `sinew keys issue NODE --keys DIR`, where this project's ca.key is, makes it some"
    )]
    OtherAuthority(String),
    /// Its certificate is of another project, of the same authority.
    #[error("{identity} is at the other end, and this is project {project:?}")]
    OtherProject {
        /// Who is there.
        identity: Identity,
        /// The project here.
        project: String,
    },
    /// Its certificate is revoked.
    #[error(
        "the certificate of {identity}, number {serial}, is revoked; if this is the real one, `sinew keys issue NODE --keys DIR`, where ca.key is, makes it another"
    )]
    Denied {
        /// Who shows it.
        identity: Identity,
        /// Its number.
        serial: Serial,
    },
    /// Its certificate does not count now.
    #[error("the certificate of {identity}: {why}")]
    Times {
        /// Who shows it.
        identity: Identity,
        /// Why, and what to do.
        why: TimeFault,
    },
    /// Somebody else is there.
    #[error(
        "{identity} is at the other end, where {expected} was to be: two nodes with the keys of one, a wrong address in the \
         configuration, or somebody who pretends"
    )]
    SomebodyElse {
        /// Who is there.
        identity: Identity,
        /// Who was to be there.
        expected: NodeAddress,
    },
}

/// Why a handshake failed, in words for who looks after the robot.
#[must_use]
#[expect(
    clippy::wildcard_enum_match_arm,
    reason = "rustls' list of errors grows; those not named here speak for themselves"
)]
pub fn words(error: &Error) -> String {
    const THERE: &str = "the other end does not take this node";
    if let Error::InvalidCertificate(CertificateError::Other(other)) = error
        && let Some(fault) = other.0.downcast_ref::<PeerFault>()
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
            PeerFault::OtherProtocol(None).to_string()
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
