//! How a node authenticates to others.

use serde::{Deserialize, Serialize};

/// Whether a node is secured or open, and its exposure to the network.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct SecurityReport {
    /// Whether it discovers nodes beyond its own host (`ndl.interface`), or listens or is announced there
    /// (`gncl.further`, `gncl.announce`). If it is open, any process there can impersonate any node.
    pub is_beyond_host: bool,
    /// The certificate that authenticates it (`security.keys`); `None`: it is open.
    pub certificate: Option<CertificateReport>,
}

/// The validity of a node's own certificate. Seconds since 1970-01-01, UTC.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct CertificateReport {
    /// The first valid second.
    pub from_s: u64,
    /// The last valid second.
    pub until_s: u64,
    /// The node's own clock. It is not set if it shows a time before `from_s`.
    pub clock_s: u64,
    /// How the node uses the validity times of certificates (`security.times`): `strict`, `until-set` or `ignored`.
    pub times: String,
    /// Whether it is on the deny list that the node itself has in force. Nodes with the same list reject it.
    #[serde(default)]
    pub is_revoked: bool,
}
