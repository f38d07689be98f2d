//! Security between nodes: who another node is, proven; and datagrams of discovery that nobody else can make.
//!
//! A project has a certificate authority, whose key stays off the robot. It signs a certificate for each node, which says the project,
//! the node's address and its name. Two nodes connect by TLS 1.3, each shows its certificate, and each takes those of its own project's
//! authority only, of nothing else that the host trusts. `sinew keys` makes all of it.
//!
//! ```text
//! Credentials::load   the files of a node, checked against its configuration
//!        |
//!        v
//!      Tls            configurations of rustls for both ends of a connection, whatever its class
//!        |
//!        v
//!   Tls::peer         after the handshake: which node that is, or why it is not taken
//! ```
//!
//! Datagrams of discovery have no handshake: [`Sealer`] and [`Checker`] are their tags, and what keeps an old one from being taken again.
//!
//! Everything here is pure but the reading of files ([`files`]): the time comes in as an argument, or from the
//! [`TimeProvider`](rustls::time_provider::TimeProvider) that the caller gives.

mod certificate;
mod credentials;
mod datagrams;
mod denied;
pub mod files;
mod identity;
mod peer;
mod replay;
#[cfg(test)]
pub(crate) mod tests;
mod times;
mod tls;
mod verifier;

pub use certificate::{Certificate, Malformed, Serial};
pub use credentials::{CredentialFault, CredentialFaults, Credentials};
#[cfg(feature = "fuzzing")]
pub(crate) use datagrams::SPAN;
pub use datagrams::{Checker, DiscoveryKey, Sealer, Stamp, Tag, Verdict};
pub use denied::{DenyList, DenyListFault};
pub use identity::{Identity, project_of, project_uri};
pub use peer::{Peer, PeerFault, words};
pub use rustls::{self, pki_types::UnixTime};
pub use times::{Judged, TimeFault, TimePolicy, Validity, date};
pub use tls::{PROTOCOL, Tls};
