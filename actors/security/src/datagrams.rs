//! Authentication and replay protection for discovery datagrams.
//!
//! ```text
//! key of tags = HKDF-SHA256 (RFC 5869), salt "sinew", from the project's key,
//!               info "sinew discovery 1" 00 project
//! tag         = the first 16 bytes of HMAC-SHA256 (RFC 2104, RFC 4868) with that key over
//!               node (4 bytes) | incarnation (8) | number (8) | datagram        little-endian
//! ```
//!
//! A tag proves that a holder of the project's key made this datagram for this node, incarnation and number.
//! Every node of the project holds the key, so a stolen node can still make tags for others. Therefore a
//! datagram is never more than a hint. The only valid incarnation of a node is one that authenticated itself
//! in a handshake ([`Checker::confirm`]).
//!
//! | datagram | verdict | maximum effect |
//! | --- | --- | --- |
//! | with a wrong tag | [`Verdict::Forged`] | a count |
//! | of a confirmed incarnation, with a new number | [`Verdict::Fresh`] | its normal handling in discovery |
//! | of a confirmed incarnation, with a number that was accepted before, or is older by 1,984 and more | [`Verdict::Replayed`] | a count |
//! | of another incarnation, or of a node that is not confirmed | [`Verdict::OtherLife`] | one dial; the caller limits the rate |
//!
//! The order of incarnations is not checked: a robot without a clock battery may come back with a smaller number.

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

/// Size of the window of numbers below the highest accepted one of an incarnation that may still be accepted.
#[cfg(feature = "fuzzing")]
pub const SPAN: u64 = Window::SPAN;

/// Minimum time to make a datagram. One thread makes all datagrams, with an HMAC and a system call for each.
/// So no incarnation makes more than a million per second.
const TIME_PER_DATAGRAM: Duration = Duration::from_micros(1);

/// The project's key for datagrams, the same on all nodes.
#[derive(Clone)]
pub struct DiscoveryKey(Zeroizing<[u8; Self::BYTES]>);

/// The node, the incarnation and the number of a datagram.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stamp {
    /// The node that made the datagram.
    pub node: NodeAddress,
    /// Incarnation of the node.
    pub incarnation: Incarnation,
    /// Number of the datagram within the incarnation. It starts at 1.
    pub number: u64,
}

/// A tag that proves that a holder of the project's key made a datagram.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Tag(pub [u8; Self::BYTES]);

/// Makes the tags of one incarnation of a node. It outlives the layer that uses it: a number that is used
/// twice is rejected as replayed.
pub struct Sealer {
    key: hmac::Key,
    next: Stamp,
}

/// Checks tags and tracks accepted numbers, for a bounded number of nodes.
pub struct Checker {
    key: hmac::Key,
    nodes_max: NonZeroUsize,
    confirmed: BTreeMap<NodeAddress, Confirmed>,
}

/// An incarnation that authenticated itself.
struct Confirmed {
    incarnation: Incarnation,
    window: Window,
    /// Time of the confirmation or of the last accepted datagram.
    last_seen: Time,
}

/// The result of the check of a datagram.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// The datagram is of the confirmed incarnation and was not received before.
    Fresh,
    /// The datagram was made with the project's key, by an unconfirmed incarnation, or long ago. It may cause
    /// a dial, no more.
    OtherLife,
    /// The datagram was received before, or is too old to know.
    Replayed,
    /// The datagram was not made with the project's key, or was changed in transit.
    Forged,
}

impl DiscoveryKey {
    /// Length of the key in bytes.
    pub const BYTES: usize = 32;

    /// Generates a key from the system's randomness.
    ///
    /// # Errors
    /// Returns an error if the system provides no randomness.
    pub fn generate() -> std::io::Result<Self> {
        let mut bytes = Zeroizing::new([0; Self::BYTES]);
        let filled = SystemRandom::new().fill(&mut bytes[..]);
        filled.map_err(|_| std::io::Error::other("the system gives no randomness (getrandom)"))?;
        Ok(Self(bytes))
    }

    /// Parses a key from the content of its file, 64 hexadecimal digits. Returns `None` if the text is not a key.
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

    /// Returns the content of the key's file.
    #[must_use]
    pub fn text(&self) -> Zeroizing<String> {
        // Reserves the full capacity at once: a buffer that grows leaves copies of the secret behind.
        let mut text = Zeroizing::new(String::with_capacity(2 * Self::BYTES + 1));
        for digit in self.0.iter().flat_map(|byte| [byte >> 4, byte & 15]) {
            text.push(char::from_digit(digit.into(), 16).expect("four bits are a digit"));
        }
        text.push('\n');
        text
    }

    /// Derives the key for the tags of `project`.
    fn of_tags(&self, project: &str) -> hmac::Key {
        const LABEL: &[u8] = b"sinew discovery 1\0";
        let secret = hkdf::Salt::new(hkdf::HKDF_SHA256, b"sinew").extract(&self.0[..]);
        let info = [LABEL, project.as_bytes()];
        let key = secret.expand(&info, hmac::HMAC_SHA256).expect("HKDF gives up to 255 times 32 bytes");
        hmac::Key::from(key)
    }
}

impl Tag {
    /// Length of a tag in bytes: the truncated length of HMAC-SHA256 in RFC 4868.
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
    /// Creates the sealer of this incarnation of `node`.
    #[must_use]
    pub fn new(key: &DiscoveryKey, project: &str, node: NodeAddress, incarnation: Incarnation) -> Self {
        Self { key: key.of_tags(project), next: Stamp { node, incarnation, number: 1 } }
    }

    /// Returns the number of datagrams made. A handshake sends it to the other end for its [`Checker::confirm`].
    #[must_use]
    pub const fn made(&self) -> u64 {
        self.next.number - 1
    }

    /// Returns the stamp and the tag of the next datagram.
    ///
    /// # Panics
    /// Panics after 2^64 datagrams: at a million a second, after half a million years.
    #[must_use]
    pub fn seal(&mut self, datagram: &[u8]) -> (Stamp, Tag) {
        let stamp = self.next;
        self.next.number = stamp.number.checked_add(1).expect("no incarnation makes 2^64 datagrams");
        (stamp, Tag::of(&self.key, stamp, datagram))
    }
}

impl Checker {
    /// Creates a checker that tracks `nodes_max` nodes, with 290 bytes and a tree entry for each.
    #[must_use]
    pub fn new(key: &DiscoveryKey, project: &str, nodes_max: NonZeroUsize) -> Self {
        Self { key: key.of_tags(project), nodes_max, confirmed: BTreeMap::new() }
    }

    /// Checks `datagram`, which was received with this stamp and tag. A check costs one HMAC for any sender.
    /// A forged or replayed datagram, or one of another incarnation, changes no state.
    #[must_use]
    pub fn check(&mut self, now: Time, stamp: Stamp, tag: Tag, datagram: &[u8]) -> Verdict {
        let own = Tag::of(&self.key, stamp, datagram);
        if !bool::from(own.0.ct_eq(&tag.0)) {
            return Verdict::Forged;
        }
        match self.confirmed.get_mut(&stamp.node) {
            Some(entry) if entry.incarnation == stamp.incarnation => {
                if !entry.window.take(stamp.number) {
                    return Verdict::Replayed;
                }
                entry.last_seen = now;
                Verdict::Fresh
            }
            Some(_) | None => Verdict::OtherLife,
        }
    }

    /// Confirms the incarnation of a node that authenticated itself in a handshake. `reported.number` is the
    /// number of datagrams that it reported there. Datagrams up to that number are not accepted afterwards,
    /// so recorded ones are void. If the incarnation was confirmed already, its window is kept. Exception: a
    /// number was accepted that it cannot have come near since the handshake began, `lasted` ago. Another
    /// node made that number, to have the incarnation's datagrams rejected as replayed. The report may have
    /// been delayed for all of `lasted`, and the datagrams made meanwhile are genuine. If the table is full,
    /// the node that was silent longest becomes unconfirmed, which costs it a dial.
    // spec: NDL-1.3
    pub fn confirm(&mut self, now: Time, lasted: Duration, reported: Stamp) {
        let Stamp { node, incarnation, number } = reported;
        if let Some(entry) = self.confirmed.get_mut(&node)
            && entry.incarnation == incarnation
        {
            entry.last_seen = now;
            let meanwhile = lasted.as_nanos() / TIME_PER_DATAGRAM.as_nanos();
            if entry.window.is_beyond(number, u64::try_from(meanwhile).unwrap_or(u64::MAX)) {
                entry.window = Window::after(number);
            }
            return;
        }
        self.confirmed.remove(&node);
        if self.confirmed.len() >= self.nodes_max.get() {
            let silent =
                self.confirmed.iter().min_by_key(|(_, entry)| entry.last_seen).map(|(node, _)| *node);
            silent.and_then(|node| self.confirmed.remove(&node));
        }
        self.confirmed.insert(node, Confirmed { incarnation, window: Window::after(number), last_seen: now });
    }

    /// Returns the number of tracked nodes.
    #[must_use]
    pub fn len(&self) -> usize {
        self.confirmed.len()
    }

    /// Returns whether no node is tracked.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.confirmed.is_empty()
    }
}

/// Shows no secret.
impl fmt::Debug for DiscoveryKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("DiscoveryKey(..)")
    }
}

/// Shows no secret.
impl fmt::Debug for Sealer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Sealer({:?})", self.next)
    }
}

/// Shows no secret.
impl fmt::Debug for Checker {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Checker({} of {} nodes)", self.confirmed.len(), self.nodes_max)
    }
}

#[cfg(test)]
#[path = "tests/datagrams.rs"]
mod tests;
