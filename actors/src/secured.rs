//! What a node with keys proves itself and its datagrams with. Not there: it is open to everybody on its network.

#[cfg(feature = "fuzzing")]
pub(crate) mod fuzzing;
mod reminder;

use std::{
    num::NonZeroUsize,
    path::PathBuf,
    sync::{Arc, Mutex},
    time::Duration,
};

use bytes::BytesMut;
use rustls::{pki_types::UnixTime, time_provider::DefaultTimeProvider};
use sinew_runtime::{
    tid::{Incarnation, NodeAddress},
    time::Time,
};

use self::reminder::{Matter, Reminder};
use crate::{
    config::NodeConfig,
    security::{
        Checker, CredentialFaults, Credentials, DiscoveryKey, Identity, Sealer, Serial, Stamp, Tag,
        TimePolicy, Tls, Validity, Verdict,
    },
    stores::lock,
};

/// Bytes of a seal behind a datagram: the life of its maker, the datagram's number in that life, and the tag, little-endian.
pub(crate) const SEAL_LEN: usize = 8 + 8 + Tag::BYTES;

/// Of one life of a node; it outlives the layers that use it.
pub(crate) struct Secured {
    pub(crate) tls: Tls,
    /// From when until when the node's own certificate counts.
    pub(crate) validity: Validity,
    times: TimePolicy,
    seals: Mutex<Seals>,
    /// Where its files are.
    directory: PathBuf,
    /// The number of its own certificate.
    pub(crate) serial: Serial,
    /// Of two who have the deny list read again, the later one reads later.
    reading: Mutex<()>,
    /// When it was said last that its certificate ends.
    reminder: Mutex<Reminder>,
}

/// Why a node's deny list was not read again, or what else is to be done. Each says what is in force.
#[derive(Debug, thiserror::Error)]
pub enum DenyListError {
    /// The node was started without keys. Nothing changed.
    #[error("this node has no keys, and so no deny list: set security.keys, and start it again")]
    None,
    /// The file cannot be used; all that is wrong with it is listed. The list that was in force still is.
    #[error("the deny list cannot be used, and the one in force stays:\n{0}")]
    Faults(#[from] CredentialFaults),
    /// The list is in force for connections from now on, but those that stand were not looked at: the node is stopping, or a layer hangs.
    /// Ask again.
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
        /// Its number.
        serial: Serial,
        /// The list.
        summary: DenyListSummary,
    },
}

/// A deny list that was read and put in force.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DenyListSummary {
    /// Certificates that are on it.
    pub denied: usize,
    /// Those that were on the list before and are not on this one: they count again. If nobody took them out, only a part of the file was
    /// there when it was read.
    pub readmitted: usize,
}

/// The same, for the node itself.
pub(crate) struct Denied {
    pub(crate) summary: DenyListSummary,
    /// The number of this node's own certificate, if it is among them.
    pub(crate) own: Option<Serial>,
}

/// Puts seals behind datagrams, and looks at those of others.
struct Seals {
    sealer: Sealer,
    checker: Checker,
}

impl Secured {
    /// From the files that the configuration names, if it does.
    ///
    /// # Errors
    /// All that is wrong with them; rustls does not take the key.
    pub(crate) fn load(config: &NodeConfig, incarnation: Incarnation) -> Result<Option<Self>, KeyFault> {
        let Some(keys) = &config.security.keys else { return Ok(None) };
        let (project, name) = (config.project.clone(), config.name.clone());
        let identity = Identity { project, address: config.node_address(), name };
        let credentials = Credentials::load(keys, &identity, config.security.times, UnixTime::now())?;
        for warning in credentials.warnings() {
            crate::log::warn!("{warning}");
        }
        let tls = Tls::new(&credentials, Arc::new(DefaultTimeProvider))?;
        Ok(Some(Self::new(tls, &credentials, config.ndl.nodes_max, incarnation)))
    }

    pub(crate) fn new(
        tls: Tls,
        credentials: &Credentials,
        nodes_max: usize,
        incarnation: Incarnation,
    ) -> Self {
        let (key, identity) = (credentials.discovery(), credentials.identity());
        let nodes_max = NonZeroUsize::new(nodes_max).unwrap_or(NonZeroUsize::MIN);
        let seals = Seals::new(key, &identity.project, identity.address, incarnation, nodes_max);
        let (directory, serial) = (credentials.directory().to_owned(), credentials.serial().clone());
        let (validity, times, seals) = (credentials.validity(), credentials.policy(), Mutex::new(seals));
        let reminder = Mutex::new(Reminder::new(Time::now()));
        Self { tls, validity, times, seals, directory, serial, reading: Mutex::default(), reminder }
    }

    /// What is to be said again of the times of this node's own certificate at `at`, which the clock that may be set calls `now`. That
    /// times are not looked at is said at the start, and of each peer.
    pub(crate) fn reminder(&self, now: UnixTime, at: Time) -> Option<String> {
        if self.times == TimePolicy::Ignored {
            return None;
        }
        let warning = self.times.warning(self.validity, now)?;
        let matter = if now > self.validity.until { Matter::HasEnded } else { Matter::EndsSoon };
        lock(&self.reminder).is_due(matter, at).then_some(warning)
    }

    /// Reads the deny list again and puts it in force, for every handshake and every HELLO from now on. Connections that stand end when
    /// GNCL is told. Of certificates that were on the list and are not any more it is logged how many.
    ///
    /// # Errors
    /// It cannot be used; the list in force stays.
    pub(crate) fn reload_deny_list(&self) -> Result<Denied, CredentialFaults> {
        let _turn = lock(&self.reading);
        let list = Credentials::deny_list(&self.directory)?;
        let own = list.has(&self.serial).then(|| self.serial.clone());
        let (denied, before) = (list.len(), self.tls.denied());
        let readmitted = before.not_on(&list);
        self.tls.deny(list);
        if readmitted > 0 {
            crate::log::warn!(
                readmitted,
                "certificates that were on the deny list are not any more, and count again; if nobody took them out the file was read before all of it was \
                 there: copy it under another name, rename it, and have it read again"
            );
        }
        Ok(Denied { summary: DenyListSummary { denied, readmitted }, own })
    }

    /// Puts a seal behind a datagram of this node.
    pub(crate) fn seal(&self, datagram: &mut BytesMut) {
        lock(&self.seals).seal(datagram);
    }

    /// The datagram in front of a seal, as `maker` says who made it.
    ///
    /// # Errors
    /// Nobody of the project made it so, or it was taken before; in words.
    pub(crate) fn unseal<'a>(
        &self,
        now: Time,
        sealed: &'a [u8],
        maker: impl FnOnce(&[u8]) -> Option<NodeAddress>,
    ) -> Result<&'a [u8], &'static str> {
        lock(&self.seals).unseal(now, sealed, maker)
    }

    /// How many datagrams this life has made: what it says in its handshakes.
    pub(crate) fn made(&self) -> u64 {
        lock(&self.seals).made()
    }

    /// That life of that node has proven itself in a handshake that has `lasted` so long, and said in it how many datagrams it had made.
    pub(crate) fn confirm(&self, now: Time, lasted: Duration, said: Stamp) {
        lock(&self.seals).confirm(now, lasted, said);
    }
}

impl Seals {
    /// For this life of `node`; it keeps so many nodes in mind.
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

    /// As [`Secured::unseal`].
    fn unseal<'a>(
        &mut self,
        now: Time,
        sealed: &'a [u8],
        maker: impl FnOnce(&[u8]) -> Option<NodeAddress>,
    ) -> Result<&'a [u8], &'static str> {
        const FORGED: &str = "it was not made with this project's keys: a node there has those of another project, or older ones, or somebody pretends to be one; \
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
            // Of a life that has not proven itself it is a hint, and what follows from a hint has its bounds.
            Verdict::Fresh | Verdict::OtherLife => Ok(datagram),
            Verdict::Replayed => Err("it was taken before: somebody sends again what was recorded"),
            Verdict::Forged => Err(FORGED),
        }
    }

    const fn made(&self) -> u64 {
        self.sealer.made()
    }

    fn confirm(&mut self, now: Time, lasted: Duration, said: Stamp) {
        self.checker.confirm(now, lasted, said);
    }
}

/// Why a node has no keys that it is to have.
#[derive(Debug, thiserror::Error)]
pub enum KeyFault {
    /// Something is wrong with its files.
    #[error(transparent)]
    Files(#[from] CredentialFaults),
    /// rustls does not take its key.
    #[error("the key cannot be used ({0}); make a new one with `sinew keys issue`")]
    Key(#[from] rustls::Error),
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::security::tests::ground::{self, Authority};

    const NODE: NodeAddress = NodeAddress::new(7);

    fn secured(keys: &Authority, incarnation: u64) -> Secured {
        let identity = Identity { project: "walker".to_owned(), address: NODE, name: "hip".to_owned() };
        let credentials = keys.credentials_of(&identity);
        Secured::new(ground::tls(&credentials), &credentials, 8, Incarnation(incarnation))
    }

    fn sealed(by: &Secured, datagram: &[u8]) -> Vec<u8> {
        let mut bytes = BytesMut::from(datagram);
        by.seal(&mut bytes);
        bytes.to_vec()
    }

    fn opened<'a>(by: &Secured, bytes: &'a [u8]) -> Result<&'a [u8], &'static str> {
        by.unseal(Time::ZERO, bytes, |_| Some(NODE))
    }

    #[test]
    fn a_datagram_of_the_project_is_taken_and_what_anybody_else_made_is_not() {
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
        assert!(here.unseal(Time::ZERO, &right, |_| None).is_err(), "who says not who it is");
    }

    #[test]
    fn a_datagram_of_a_life_that_has_proven_itself_is_taken_once_and_one_from_before_never() {
        let keys = Authority::new("walker");
        let (here, there) = (secured(&keys, 1), secured(&keys, 2));
        let before = sealed(&there, b"before");
        let said = Stamp { node: NODE, incarnation: Incarnation(2), number: there.made() };
        here.confirm(Time::ZERO, Duration::ZERO, said);
        let after = sealed(&there, b"after");
        assert!(opened(&here, &before).is_err());
        assert_eq!(opened(&here, &after), Ok(&b"after"[..]));
        assert!(opened(&here, &after).is_err());
    }
}
