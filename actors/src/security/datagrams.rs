//! Datagrams of discovery that only nodes of the project can make, and that count once.
//!
//! ```text
//! key of tags = HKDF-SHA256 (RFC 5869), salt "sinew", from the project's key,
//!               info "sinew discovery 1" 00 project
//! tag         = the first 16 bytes of HMAC-SHA256 (RFC 2104, RFC 4868) with that key over
//!               node (4 bytes) | incarnation (8) | number (8) | datagram        little-endian
//! ```
//!
//! What a tag proves: somebody who holds the project's key made this datagram, for this node, life and number. Every node of the project
//! holds it, so a node that was stolen can still make tags for others. Therefore a datagram is never more than a hint: the only life of a
//! node that counts is one that proved itself in a handshake ([`Checker::confirm`]).
//!
//! | a datagram | is | it may at most cause |
//! | --- | --- | --- |
//! | whose tag is wrong | [`Verdict::Forged`] | a count |
//! | of a confirmed life, with a new number | [`Verdict::Fresh`] | what discovery does with it |
//! | of a confirmed life, with a number that was taken, or is older by 1,984 and more | [`Verdict::Replayed`] | a count |
//! | of another life, or of a node that is not confirmed | [`Verdict::OtherLife`] | one dial, whose rate the caller limits |
//!
//! Whether another life is later or earlier is not asked: a robot without a battery for its clock may come back with a smaller number.

use std::{collections::BTreeMap, fmt, num::NonZeroUsize, time::Duration};

use ring::{
    hkdf, hmac,
    rand::{SecureRandom, SystemRandom},
};
use sinew_runtime::{
    tid::{Incarnation, NodeAddress},
    time::Time,
};
use subtle::ConstantTimeEq;
use zeroize::Zeroizing;

use super::replay::Window;

/// So many numbers up to the highest one that was taken of a life may still be taken.
#[cfg(feature = "fuzzing")]
pub(crate) const SPAN: u64 = Window::SPAN;

/// A datagram takes its maker so long at least: one thread makes them all, with an HMAC and a call of the system for each. So no life makes more
/// than a million in a second.
const EACH_TAKES: Duration = Duration::from_micros(1);

/// The project's key for datagrams, the same on all nodes.
#[derive(Clone)]
pub struct DiscoveryKey(Zeroizing<[u8; Self::BYTES]>);

/// Which datagram of which life of which node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stamp {
    /// The node that made it.
    pub node: NodeAddress,
    /// The life of it.
    pub incarnation: Incarnation,
    /// How many that life had made, with this one; it begins with 1.
    pub number: u64,
}

/// Proves that a holder of the project's key made a datagram.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Tag(pub [u8; Self::BYTES]);

/// Makes the tags of one life of a node. It outlives the layer that uses it: a number that is used twice is refused as replayed.
pub struct Sealer {
    key: hmac::Key,
    next: Stamp,
}

/// Checks tags, and keeps in mind which numbers were taken, of so many nodes at most.
pub struct Checker {
    key: hmac::Key,
    nodes_max: NonZeroUsize,
    confirmed: BTreeMap<NodeAddress, Confirmed>,
}

/// A life that proved itself.
struct Confirmed {
    incarnation: Incarnation,
    window: Window,
    /// When it was confirmed, or heard last.
    heard: Time,
}

/// What is to be thought of a datagram.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// Of the life that proved itself, and not taken before.
    Fresh,
    /// Made with the project's key, but by a life that has not proved itself, or long ago: dial, no more.
    OtherLife,
    /// It was taken before, or is so old that nobody knows.
    Replayed,
    /// Not made with the project's key, or changed on the way.
    Forged,
}

impl DiscoveryKey {
    /// Its length.
    pub const BYTES: usize = 32;

    /// A new one, from the system's randomness.
    ///
    /// # Errors
    /// The system gives none.
    pub fn generate() -> std::io::Result<Self> {
        let mut bytes = Zeroizing::new([0; Self::BYTES]);
        let filled = SystemRandom::new().fill(&mut bytes[..]);
        filled.map_err(|_| std::io::Error::other("the system gives no randomness (getrandom)"))?;
        Ok(Self(bytes))
    }

    /// From its file: 64 hexadecimal digits. `None` if it is none.
    #[must_use]
    pub fn read(text: &[u8]) -> Option<Self> {
        let digits = text.trim_ascii();
        let mut bytes = Zeroizing::new([0; Self::BYTES]);
        if digits.len() != 2 * Self::BYTES {
            return None;
        }
        for (byte, pair) in bytes.iter_mut().zip(digits.chunks_exact(2)) {
            let [high, low] = pair else { return None };
            let digit =
                |digit: &u8| char::from(*digit).to_digit(16).and_then(|value| u8::try_from(value).ok());
            *byte = digit(high)? << 4 | digit(low)?;
        }
        Some(Self(bytes))
    }

    /// As it stands in its file.
    #[must_use]
    pub fn text(&self) -> Zeroizing<String> {
        // Room for all of it at once: a buffer that grows leaves copies of the secret behind.
        let mut text = Zeroizing::new(String::with_capacity(2 * Self::BYTES + 1));
        for digit in self.0.iter().flat_map(|byte| [byte >> 4, byte & 15]) {
            text.push(char::from_digit(digit.into(), 16).expect("four bits are a digit"));
        }
        text.push('\n');
        text
    }

    /// The key of the tags of `project`.
    fn of_tags(&self, project: &str) -> hmac::Key {
        const LABEL: &[u8] = b"sinew discovery 1\0";
        let secret = hkdf::Salt::new(hkdf::HKDF_SHA256, b"sinew").extract(&self.0[..]);
        let info = [LABEL, project.as_bytes()];
        let key = secret.expand(&info, hmac::HMAC_SHA256).expect("HKDF gives up to 255 times 32 bytes");
        hmac::Key::from(key)
    }
}

impl Tag {
    /// Its length: what RFC 4868 has of HMAC-SHA256 on the wire.
    pub const BYTES: usize = 16;

    fn of(key: &hmac::Key, stamp: Stamp, datagram: &[u8]) -> Self {
        let mut context = hmac::Context::with_key(key);
        context.update(&stamp.node.bits().to_le_bytes());
        context.update(&stamp.incarnation.0.to_le_bytes());
        context.update(&stamp.number.to_le_bytes());
        context.update(datagram);
        let mut tag = [0; Self::BYTES];
        tag.copy_from_slice(&context.sign().as_ref()[..Self::BYTES]);
        Self(tag)
    }
}

impl Sealer {
    /// For this life of `node`.
    #[must_use]
    pub fn new(key: &DiscoveryKey, project: &str, node: NodeAddress, incarnation: Incarnation) -> Self {
        Self { key: key.of_tags(project), next: Stamp { node, incarnation, number: 1 } }
    }

    /// How many datagrams have been made: what a handshake says to the other end, for its [`Checker::confirm`].
    #[must_use]
    pub const fn made(&self) -> u64 {
        self.next.number - 1
    }

    /// The stamp and the tag of one more datagram.
    ///
    /// # Panics
    /// After 2^64 datagrams: at a million a second, after half a million years.
    #[must_use]
    pub fn seal(&mut self, datagram: &[u8]) -> (Stamp, Tag) {
        let stamp = self.next;
        self.next.number = stamp.number.checked_add(1).expect("no life makes 2^64 datagrams");
        (stamp, Tag::of(&self.key, stamp, datagram))
    }
}

impl Checker {
    /// One that keeps `nodes_max` nodes in mind: 290 bytes and a place in a tree for each.
    #[must_use]
    pub fn new(key: &DiscoveryKey, project: &str, nodes_max: NonZeroUsize) -> Self {
        Self { key: key.of_tags(project), nodes_max, confirmed: BTreeMap::new() }
    }

    /// What is to be thought of `datagram`, which came with this stamp and tag. It costs one HMAC, whoever made it; what is forged, replayed
    /// or of another life changes nothing here.
    #[must_use]
    pub fn check(&mut self, now: Time, stamp: Stamp, tag: Tag, datagram: &[u8]) -> Verdict {
        let own = Tag::of(&self.key, stamp, datagram);
        if !bool::from(own.0.ct_eq(&tag.0)) {
            return Verdict::Forged;
        }
        match self.confirmed.get_mut(&stamp.node) {
            Some(life) if life.incarnation == stamp.incarnation => {
                if !life.window.take(stamp.number) {
                    return Verdict::Replayed;
                }
                life.heard = now;
                Verdict::Fresh
            }
            Some(_) | None => Verdict::OtherLife,
        }
    }

    /// A handshake has proven that this life of this node is there, and it has said in it how many datagrams it had made (`said.number`): of
    /// these none counts any more, whoever recorded them. Of a life that was confirmed already nothing is forgotten, unless a number was taken
    /// that it cannot have come near to since the handshake began, so long ago as this has `lasted`: somebody else made that one, to have it
    /// taken for repeating itself. Its word may have been held up for all that time, and what it made meanwhile is its own. Where there is no
    /// room, the node that was silent longest is no longer confirmed, which costs it a dial.
    // spec: NDL-1.3
    pub fn confirm(&mut self, now: Time, lasted: Duration, said: Stamp) {
        let Stamp { node, incarnation, number } = said;
        if let Some(life) = self.confirmed.get_mut(&node)
            && life.incarnation == incarnation
        {
            life.heard = now;
            let meanwhile = lasted.as_nanos() / EACH_TAKES.as_nanos();
            if life.window.is_beyond(number, u64::try_from(meanwhile).unwrap_or(u64::MAX)) {
                life.window = Window::after(number);
            }
            return;
        }
        self.confirmed.remove(&node);
        if self.confirmed.len() >= self.nodes_max.get() {
            let silent = self.confirmed.iter().min_by_key(|(_, life)| life.heard).map(|(node, _)| *node);
            silent.and_then(|node| self.confirmed.remove(&node));
        }
        self.confirmed.insert(node, Confirmed { incarnation, window: Window::after(number), heard: now });
    }

    /// How many nodes are kept in mind.
    #[must_use]
    pub fn len(&self) -> usize {
        self.confirmed.len()
    }

    /// Whether none is.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.confirmed.is_empty()
    }
}

/// No secret.
impl fmt::Debug for DiscoveryKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("DiscoveryKey(..)")
    }
}

/// No secret.
impl fmt::Debug for Sealer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Sealer({:?})", self.next)
    }
}

/// No secret.
impl fmt::Debug for Checker {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Checker({} of {} nodes)", self.confirmed.len(), self.nodes_max)
    }
}

#[cfg(test)]
#[path = "tests/datagrams.rs"]
mod tests;
