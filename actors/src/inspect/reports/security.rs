//! How a node proves itself to others.

use serde::{Deserialize, Serialize};

/// Whether a node is secured or open, and who can reach it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct SecurityReport {
    /// Whether it looks for nodes beyond its own host (`ndl.interface`), or listens or is announced there besides (`gncl.further`,
    /// `gncl.announce`): if it is open, anybody there can pose as any node.
    pub is_beyond_host: bool,
    /// What it proves itself with (`security.keys`); `None`: it is open.
    pub certificate: Option<CertificateReport>,
}

/// When a node's own certificate counts. Seconds since 1970-01-01, UTC.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct CertificateReport {
    /// Its first second.
    pub from_s: u64,
    /// Its last one.
    pub until_s: u64,
    /// The node's own clock. It is not set where it says an earlier time than `from_s`.
    pub clock_s: u64,
    /// What the times of certificates are good for there (`security.times`): `strict`, `until-set` or `ignored`.
    pub times: String,
    /// Whether it is on the deny list that the node itself has in force. Nodes that have read the same list do not take it.
    #[serde(default)]
    pub is_revoked: bool,
}
