//! Security between nodes: authentication of nodes and of discovery datagrams.
//!
//! A project has a certificate authority, with a key that stays off the robot. It signs a certificate for
//! each node, with the project, the node's address and its name. Two nodes connect with TLS 1.3, and each
//! shows its certificate. Each node trusts only its own project's authority, not the authorities of the host.
//! `sinew keys` makes all of these files.
//!
//! ```text
//! Credentials::load   the files of a node, checked against its configuration
//!        |
//!        v
//!      Tls            configurations of rustls for both ends of a connection, for every class
//!        |
//!        v
//!   Tls::peer         after the handshake: the node's identity, or the reason for its rejection
//! ```
//!
//! Discovery datagrams have no handshake. [`Sealer`] and [`Checker`] make and check their tags, and reject
//! replayed ones.
//!
//! Besides: [`access`], the list that allows messages between applications, and [`node_security`], the keys in
//! force of a node.
//!
//! [`state_files`] writes the files in which a node keeps its state.
//!
//! Everything here is pure except the reading and writing of files ([`files`], [`state_files`]). The time is an
//! argument, or comes from the [`TimeProvider`](rustls::time_provider::TimeProvider) of the caller.

pub mod access;
mod certificate;
mod credentials;
mod datagrams;
mod denied;
pub mod files;
mod identity;
pub mod node_security;
mod peer;
mod replay;
mod security_state;
pub mod state_files;
#[cfg(any(test, feature = "testing"))]
#[doc(hidden)]
pub mod testing;
#[cfg(test)]
mod tests;
mod times;
mod tls;
mod verifier;

pub use certificate::{Certificate, MalformedCertificateError, Serial};
pub use credentials::{CredentialError, Credentials, CredentialsError};
#[cfg(feature = "fuzzing")]
pub use datagrams::SPAN;
pub use datagrams::{Checker, DiscoveryKey, Sealer, Stamp, Tag, Verdict};
pub use denied::{DenyList, DenyListEntryError};
pub use identity::{Identity, project_of, project_uri};
pub use peer::{Peer, PeerError, words};
pub use rustls::{self, pki_types::UnixTime};
pub use security_state::SecurityState;
pub use sinew_model::config::TimePolicy;
pub use times::{Judged, Validity, ValidityError, date};
pub use tls::{PROTOCOL, Tls};
