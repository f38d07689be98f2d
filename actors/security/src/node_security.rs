//! The credentials with which a node and its datagrams authenticate. Without them the node is open to its
//! whole network.

#[cfg(feature = "fuzzing")]
#[doc(hidden)]
pub mod fuzzing;
mod reminder;

use std::{
    num::NonZeroUsize,
    path::PathBuf,
    sync::{Arc, Mutex},
    time::Duration,
};

use bytes::BytesMut;
use rustls::{pki_types::UnixTime, time_provider::DefaultTimeProvider};
use sinew_model::config::{NodeConfig, TimePolicy};
use sinew_runtime::{
    lock,
    tid::{Incarnation, NodeAddress},
    time::Time,
};

use self::reminder::{Expiry, Reminder};
use crate::{
    Checker, Credentials, CredentialsError, DiscoveryKey, Identity, Sealer, Serial, Stamp, Tag, Tls,
    Validity, Verdict,
};

/// Bytes of a seal behind a datagram: the incarnation of its sender, the datagram's number in that
/// incarnation, and the tag, little-endian.
pub const SEAL_LEN: usize = 8 + 8 + Tag::BYTES;

/// The security state of one incarnation of a node; it outlives the layers that use it.
pub struct NodeSecurity {
    /// TLS with the node's own certificate.
    pub tls: Tls,
    /// The validity period of the node's own certificate.
    pub validity: Validity,
    times: TimePolicy,
    seals: Mutex<Seals>,
    /// The directory of its files.
    directory: PathBuf,
    /// The serial number of its own certificate.
    pub serial: Serial,
    /// Serializes reloads of the deny list.
    reading: Mutex<()>,
    /// When the expiry of its certificate was reported last.
    reminder: Mutex<Reminder>,
}

/// The reason why a node's deny list was not reloaded, or the further action that is needed. Each error
/// states the rules in force.
#[derive(Debug, thiserror::Error)]
pub enum DenyListError {
    /// The node was started without keys. Nothing changed.
    #[error("this node has no keys, and so no deny list: set security.keys, and start it again")]
    None,
    /// The file cannot be used; all faults are listed. The list that was in force still is.
    #[error("the deny list cannot be used, and the one in force stays:\n{0}")]
    Faults(#[from] CredentialsError),
    /// The list is in force for new connections, but existing ones were not checked: the node is stopping, or
    /// a layer hangs. Retry.
    #[error(
        "the deny list is in force for connections from now on, but those that stand were not looked at, as GNCL does not read its \
         events: ask again, and if that does not help start the node again"
    )]
    NotTold {
        /// The list.
        summary: DenyListSummary,
    },
    /// The list is in force, and this node's own certificate is on it.
    #[error(
        "the deny list is in force, and this node's own certificate, number {serial}, is on it: nodes with that list do not take it, and it \
         does not start again. Make a new one with `sinew keys issue`"
    )]
    Own {
        /// The serial number of the certificate.
        serial: Serial,
        /// The list.
        summary: DenyListSummary,
    },
}

/// A deny list that was read and put in force.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DenyListSummary {
    /// Number of certificates on the list.
    pub denied: usize,
    /// Number of certificates that were on the previous list and are not on this one: they are valid again.
    /// If they were not removed on purpose, the file was incomplete when it was read.
    pub readmitted: usize,
}

/// The same, for the node itself.
pub struct Denied {
    /// What was read.
    pub summary: DenyListSummary,
    /// The serial number of this node's own certificate, if it is on the list.
    pub own: Option<Serial>,
}

/// Appends seals to datagrams, and checks those of others.
struct Seals {
    sealer: Sealer,
    checker: Checker,
}

impl NodeSecurity {
    /// Loads the files that the configuration names, if any.
    ///
    /// # Errors
    /// All faults of the files, or a key that rustls does not accept.
    pub fn load(config: &NodeConfig, incarnation: Incarnation) -> Result<Option<Self>, KeyError> {
        let Some(keys) = &config.security.keys else { return Ok(None) };
        let (project, name) = (config.project.clone(), config.name.clone());
        let identity = Identity { project, address: config.node_address(), name };
        let credentials = Credentials::load(keys, &identity, config.security.times, UnixTime::now())?;
        for warning in credentials.warnings() {
            sinew_runtime::log::warn!("{warning}");
        }
        let tls = Tls::new(&credentials, Arc::new(DefaultTimeProvider))?;
        Ok(Some(Self::new(tls, &credentials, config.ndl.nodes_max, incarnation)))
    }

    /// Returns the state of an incarnation with these credentials, among at most `nodes_max` other nodes.
    pub fn new(tls: Tls, credentials: &Credentials, nodes_max: usize, incarnation: Incarnation) -> Self {
        let (key, identity) = (credentials.discovery(), credentials.identity());
        let nodes_max = NonZeroUsize::new(nodes_max).unwrap_or(NonZeroUsize::MIN);
        let seals = Seals::new(key, &identity.project, identity.address, incarnation, nodes_max);
        let (directory, serial) = (credentials.directory().to_owned(), credentials.serial().clone());
        let (validity, times, seals) = (credentials.validity(), credentials.policy(), Mutex::new(seals));
        let reminder = Mutex::new(Reminder::new(Time::now()));
        Self { tls, validity, times, seals, directory, serial, reading: Mutex::default(), reminder }
    }

    /// Returns a repeated warning about the validity of this node's own certificate at `at`, which the wall
    /// clock shows as `now`. That validity times are ignored is reported at the start, and for each peer.
    pub fn reminder(&self, now: UnixTime, at: Time) -> Option<String> {
        if self.times == TimePolicy::Ignored {
            return None;
        }
        let warning = self.validity.warning(self.times, now)?;
        let expiry = if now > self.validity.until { Expiry::HasEnded } else { Expiry::EndsSoon };
        lock(&self.reminder).is_due(expiry, at).then_some(warning)
    }

    /// Reloads the deny list and puts it in force, for every later handshake and HELLO. Existing connections
    /// end when GNCL is notified. The number of readmitted certificates is logged.
    ///
    /// # Errors
    /// The list cannot be used; the one in force stays.
    pub fn reload_deny_list(&self) -> Result<Denied, CredentialsError> {
        let _turn = lock(&self.reading);
        let list = Credentials::deny_list(&self.directory)?;
        let own = list.has(&self.serial).then(|| self.serial.clone());
        let (denied, before) = (list.len(), self.tls.denied());
        let readmitted = before.not_on(&list);
        self.tls.deny(list);
        if readmitted > 0 {
            sinew_runtime::log::warn!(
                readmitted,
                "certificates that were on the deny list are not any more, and count again; if nobody took them out the file was read before all of it was \
                 there: copy it under another name, rename it, and have it read again"
            );
        }
        Ok(Denied { summary: DenyListSummary { denied, readmitted }, own })
    }

    /// Appends a seal to a datagram of this node.
    pub fn seal(&self, datagram: &mut BytesMut) {
        lock(&self.seals).seal(datagram);
    }

    /// Returns the datagram before a seal, if `maker` is its authenticated sender.
    ///
    /// # Errors
    /// The seal is invalid for this project, or was used before; as text.
    pub fn unseal<'a>(
        &self,
        now: Time,
        sealed: &'a [u8],
        maker: impl FnOnce(&[u8]) -> Option<NodeAddress>,
    ) -> Result<&'a [u8], &'static str> {
        lock(&self.seals).unseal(now, sealed, maker)
    }

    /// Returns how many datagrams this incarnation has sealed: the number that it reports in its handshakes.
    pub fn made(&self) -> u64 {
        lock(&self.seals).made()
    }

    /// Records that an incarnation of a node has authenticated in a handshake that has `lasted` this long,
    /// and reported in it how many datagrams it had sealed.
    pub fn confirm(&self, now: Time, lasted: Duration, reported: Stamp) {
        lock(&self.seals).confirm(now, lasted, reported);
    }
}

impl Seals {
    /// Returns the seals for this incarnation of `node`, with state for this many nodes.
    fn new(
        key: &DiscoveryKey,
        project: &str,
        node: NodeAddress,
        incarnation: Incarnation,
        nodes_max: NonZeroUsize,
    ) -> Self {
        let sealer = Sealer::new(key, project, node, incarnation);
        Self { sealer, checker: Checker::new(key, project, nodes_max) }
    }

    fn seal(&mut self, datagram: &mut BytesMut) {
        let (stamp, tag) = self.sealer.seal(datagram);
        datagram.extend_from_slice(&stamp.incarnation.0.to_le_bytes());
        datagram.extend_from_slice(&stamp.number.to_le_bytes());
        datagram.extend_from_slice(&tag.0);
    }

    /// Same as [`NodeSecurity::unseal`].
    fn unseal<'a>(
        &mut self,
        now: Time,
        sealed: &'a [u8],
        maker: impl FnOnce(&[u8]) -> Option<NodeAddress>,
    ) -> Result<&'a [u8], &'static str> {
        const FORGED: &str = "it was not made with this project's keys: a node there has those of another project, or older ones, or an impostor sent it; \
             compare `sinew keys show --keys DIR` of both nodes";
        let (datagram, seal) = sealed.split_last_chunk::<SEAL_LEN>().ok_or(FORGED)?;
        let (incarnation, seal) = seal.split_first_chunk::<8>().ok_or(FORGED)?;
        let (number, tag) = seal.split_first_chunk::<8>().ok_or(FORGED)?;
        let tag = Tag(tag.try_into().map_err(|_| FORGED)?);
        let stamp = Stamp {
            node: maker(datagram).ok_or(FORGED)?,
            incarnation: Incarnation(u64::from_le_bytes(*incarnation)),
            number: u64::from_le_bytes(*number),
        };
        match self.checker.check(now, stamp, tag, datagram) {
            // From an unauthenticated incarnation it is only a hint, and the effects of hints are bounded.
            Verdict::Fresh | Verdict::OtherLife => Ok(datagram),
            Verdict::Replayed => Err("it is a replay of a datagram that was received before"),
            Verdict::Forged => Err(FORGED),
        }
    }

    const fn made(&self) -> u64 {
        self.sealer.made()
    }

    fn confirm(&mut self, now: Time, lasted: Duration, reported: Stamp) {
        self.checker.confirm(now, lasted, reported);
    }
}

/// Why a node's configured keys cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum KeyError {
    /// The files have faults.
    #[error(transparent)]
    Files(#[from] CredentialsError),
    /// rustls does not accept the key.
    #[error("the key cannot be used ({0}); make a new one with `sinew keys issue`")]
    Key(#[from] rustls::Error),
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{self, Authority};

    const NODE: NodeAddress = NodeAddress::new(7);

    fn secured(keys: &Authority, incarnation: u64) -> NodeSecurity {
        let identity = Identity { project: "walker".to_owned(), address: NODE, name: "hip".to_owned() };
        let credentials = keys.credentials_of(&identity);
        NodeSecurity::new(testing::tls(&credentials), &credentials, 8, Incarnation(incarnation))
    }

    fn sealed(by: &NodeSecurity, datagram: &[u8]) -> Vec<u8> {
        let mut bytes = BytesMut::from(datagram);
        by.seal(&mut bytes);
        bytes.to_vec()
    }

    fn opened<'a>(by: &NodeSecurity, bytes: &'a [u8]) -> Result<&'a [u8], &'static str> {
        by.unseal(Time::ZERO, bytes, |_| Some(NODE))
    }

    #[test]
    fn only_datagrams_of_the_project_are_accepted() {
        let keys = Authority::new("walker");
        let (here, there) = (secured(&keys, 1), secured(&keys, 2));
        let right = sealed(&there, b"who is there?");
        assert_eq!(opened(&here, &right), Ok(&b"who is there?"[..]));
        for at in 0..right.len() {
            let mut changed = right.clone();
            changed[at] ^= 1;
            assert!(opened(&here, &changed).is_err(), "byte {at}");
        }
        assert!(opened(&here, &sealed(&secured(&Authority::new("walker"), 2), b"who is there?")).is_err());
        for short in [&b""[..], b"who", &right[..SEAL_LEN]] {
            assert!(opened(&here, short).is_err());
        }
        assert!(here.unseal(Time::ZERO, &right, |_| None).is_err(), "a datagram without a sender");
    }

    #[test]
    fn confirmed_incarnations_datagram_is_accepted_once() {
        let keys = Authority::new("walker");
        let (here, there) = (secured(&keys, 1), secured(&keys, 2));
        let before = sealed(&there, b"before");
        let reported = Stamp { node: NODE, incarnation: Incarnation(2), number: there.made() };
        here.confirm(Time::ZERO, Duration::ZERO, reported);
        let after = sealed(&there, b"after");
        assert!(opened(&here, &before).is_err());
        assert_eq!(opened(&here, &after), Ok(&b"after"[..]));
        assert!(opened(&here, &after).is_err());
    }
}
