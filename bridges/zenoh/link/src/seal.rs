//! Encryption of packets from end to end, so that a router reads nothing and alters nothing unnoticed.
//!
//! ```text
//! plain      00 | packet
//! encrypted  01 | instance (16 bytes) | number (8, little-endian) | packet, encrypted | tag (16)
//!
//! key    = HKDF-SHA256 (RFC 5869), salt "sinew", from the project's discovery key,
//!          info "sinew zenoh link 1" 00 project 00 source address (4) instance (16)
//! cipher = ChaCha20-Poly1305 (RFC 8439), nonce: 4 zero bytes and the number,
//!          additional data: source address (4), target address (4; all ones for all hosts)
//! ```
//!
//! Each run of the program draws a random instance. So no key is used for two sequences of numbers. Every node
//! of the project holds the project's key: a stolen host can read and forge packets of others. The connections
//! inside are TLS with the identity of each node, which it cannot forge.

use std::{collections::BTreeMap, fmt, net::Ipv4Addr};

use ring::{
    aead::{Aad, CHACHA20_POLY1305, LessSafeKey, Nonce, UnboundKey},
    hkdf,
};

use crate::{DropCause, Instance, ReplayWindow, Target};

const PLAIN: u8 = 0;
const ENCRYPTED: u8 = 1;
const LABEL: &[u8] = b"sinew zenoh link 1\0";
const INSTANCE: usize = 16;
const NUMBER: usize = 8;
const TAG: usize = 16;
/// Bytes that encryption adds to a packet.
pub const SEAL_BYTES: usize = 1 + INSTANCE + NUMBER + TAG;
/// Maximum number of senders with a kept window, each of 400 bytes. A further one replaces the one that was
/// received from longest ago.
const SENDERS_MAX: usize = 4_096;

/// The project's discovery key, from which the keys of packets are derived.
#[derive(Clone)]
pub struct ProjectKey(hkdf::Prk);

impl ProjectKey {
    /// Length of the key in bytes.
    pub const BYTES: usize = 32;

    /// Reads the file `discovery.key` of a node's keys: 64 hexadecimal digits. Returns `None` if it is anything
    /// else.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew_zenoh_link::ProjectKey;
    ///
    /// assert!(ProjectKey::parse("0f".repeat(32).as_bytes()).is_some());
    /// assert!(ProjectKey::parse(b"0f").is_none());
    /// ```
    #[must_use]
    pub fn parse(text: &[u8]) -> Option<Self> {
        let digits = text.trim_ascii();
        if digits.len() != 2 * Self::BYTES {
            return None;
        }
        let mut bytes = [0; Self::BYTES];
        for (byte, pair) in bytes.iter_mut().zip(digits.chunks_exact(2)) {
            let &[high, low] = pair else { return None };
            let digit = |digit: u8| char::from(digit).to_digit(16).and_then(|value| u8::try_from(value).ok());
            *byte = digit(high)? << 4 | digit(low)?;
        }
        Some(Self(hkdf::Salt::new(hkdf::HKDF_SHA256, b"sinew").extract(&bytes)))
    }

    fn key_of(&self, project: &str, source: Ipv4Addr, instance: Instance) -> LessSafeKey {
        let source = source.octets();
        let info = [LABEL, project.as_bytes(), &[0], &source, &instance.0];
        let key = self.0.expand(&info, &CHACHA20_POLY1305).expect("HKDF gives up to 255 times 32 bytes");
        LessSafeKey::new(UnboundKey::from(key))
    }
}

impl fmt::Debug for ProjectKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("ProjectKey")
    }
}

/// A sender of authentic packets.
#[derive(Debug)]
struct Sender {
    key: LessSafeKey,
    window: ReplayWindow,
    used: u64,
}

/// Encrypts the packets of one host, and decrypts those of others.
#[derive(Debug)]
pub(crate) struct Seal {
    project: String,
    address: Ipv4Addr,
    instance: Instance,
    keys: Option<(ProjectKey, LessSafeKey)>,
    number: u64,
    senders: BTreeMap<(Ipv4Addr, Instance), Sender>,
    uses: u64,
}

impl Seal {
    pub(crate) fn new(
        project: &str,
        address: Ipv4Addr,
        instance: Instance,
        key: Option<&ProjectKey>,
    ) -> Self {
        let keys = key.map(|key| (key.clone(), key.key_of(project, address, instance)));
        let project = project.to_owned();
        Self { project, address, instance, keys, number: 0, senders: BTreeMap::new(), uses: 0 }
    }

    /// Returns the payload of a put with this packet. // spec: ZLINK-4
    pub(crate) fn seal(&mut self, target: Target, packet: &[u8]) -> Vec<u8> {
        let Some((_, key)) = &self.keys else {
            return [&[PLAIN][..], packet].concat();
        };
        self.number += 1;
        let mut payload = Vec::with_capacity(SEAL_BYTES + packet.len());
        payload.push(ENCRYPTED);
        payload.extend_from_slice(&self.instance.0);
        payload.extend_from_slice(&self.number.to_le_bytes());
        let mut bytes = packet.to_vec();
        let data = additional_data(self.address, target);
        key.seal_in_place_append_tag(nonce(self.number), data, &mut bytes)
            .expect("a packet is shorter than the cipher's limit of 256 GiB");
        payload.append(&mut bytes);
        payload
    }

    /// Returns the packet of a put from `source` to `target`.
    ///
    /// # Errors
    /// Returns the cause for which the put is dropped.
    // spec: ZLINK-4, ZLINK-4.1, ZLINK-4.2
    pub(crate) fn open(
        &mut self,
        source: Ipv4Addr,
        target: Target,
        payload: &[u8],
    ) -> Result<Vec<u8>, DropCause> {
        let Some((project_key, _)) = &self.keys else {
            let plain = payload.strip_prefix(&[PLAIN]);
            return plain.map(<[u8]>::to_vec).ok_or(DropCause::OtherMode);
        };
        let rest = payload.strip_prefix(&[ENCRYPTED]).ok_or(DropCause::OtherMode)?;
        let (instance, rest) = rest.split_first_chunk().ok_or(DropCause::Forged)?;
        let (number, sealed) = rest.split_first_chunk().ok_or(DropCause::Forged)?;
        let (instance, number) = (Instance(*instance), u64::from_le_bytes(*number));
        let known = self.senders.get_mut(&(source, instance));
        let mut bytes = sealed.to_vec();
        let decrypt = |key: &LessSafeKey, bytes: &mut Vec<u8>| {
            let opened = key.open_in_place(nonce(number), additional_data(source, target), bytes);
            opened.map(|packet| packet.len()).map_err(|_| DropCause::Forged)
        };
        self.uses += 1;
        if let Some(sender) = known {
            let length = decrypt(&sender.key, &mut bytes)?;
            bytes.truncate(length);
            sender.used = self.uses;
            return if sender.window.admit(number) { Ok(bytes) } else { Err(DropCause::Replayed) };
        }
        let key = project_key.key_of(&self.project, source, instance);
        let length = decrypt(&key, &mut bytes)?;
        bytes.truncate(length);
        let mut window = ReplayWindow::default();
        window.admit(number);
        self.keep((source, instance), Sender { key, window, used: self.uses });
        Ok(bytes)
    }

    /// Keeps a sender. A put that is not authentic never reaches this.
    fn keep(&mut self, at: (Ipv4Addr, Instance), sender: Sender) {
        if self.senders.len() >= SENDERS_MAX
            && let Some(oldest) = self.senders.iter().min_by_key(|(_, sender)| sender.used).map(|(at, _)| *at)
        {
            self.senders.remove(&oldest);
        }
        self.senders.insert(at, sender);
    }
}

fn nonce(number: u64) -> Nonce {
    let mut bytes = [0; 12];
    bytes[4..].copy_from_slice(&number.to_le_bytes());
    Nonce::assume_unique_for_key(bytes)
}

fn additional_data(source: Ipv4Addr, target: Target) -> Aad<[u8; 8]> {
    let target = match target {
        Target::Host(address) => address,
        Target::All => Ipv4Addr::BROADCAST,
    };
    let mut bytes = [0; 8];
    bytes[..4].copy_from_slice(&source.octets());
    bytes[4..].copy_from_slice(&target.octets());
    Aad::from(bytes)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const A: Ipv4Addr = Ipv4Addr::new(10, 99, 0, 1);
    const B: Ipv4Addr = Ipv4Addr::new(10, 99, 0, 2);
    const C: Ipv4Addr = Ipv4Addr::new(10, 99, 0, 3);

    fn key(digits: &str) -> ProjectKey {
        ProjectKey::parse(digits.repeat(32).as_bytes()).expect("64 digits")
    }

    fn seal_of(address: Ipv4Addr) -> Seal {
        Seal::new("leg", address, Instance([address.octets()[3]; 16]), Some(&key("5a")))
    }

    #[test]
    fn opened_packet_is_the_sealed_one() {
        let (mut a, mut b) = (seal_of(A), seal_of(B));
        for target in [Target::Host(B), Target::All] {
            let payload = a.seal(target, b"a packet");
            assert_eq!(payload.len(), SEAL_BYTES + 8);
            assert!(!payload.windows(8).any(|bytes| bytes == b"a packet"));
            assert_eq!(b.open(A, target, &payload), Ok(b"a packet".to_vec()));
            assert_eq!(b.open(A, target, &payload), Err(DropCause::Replayed));
        }
    }

    #[test]
    fn packet_for_another_end_is_forged() {
        let (mut a, mut b) = (seal_of(A), seal_of(B));
        let payload = a.seal(Target::Host(B), b"a packet");
        assert_eq!(b.open(C, Target::Host(B), &payload), Err(DropCause::Forged), "from another host");
        assert_eq!(b.open(A, Target::Host(C), &payload), Err(DropCause::Forged), "to another host");
        assert_eq!(b.open(A, Target::All, &payload), Err(DropCause::Forged));
        let mut other = Seal::new("arm", B, Instance([9; 16]), Some(&key("5a")));
        assert_eq!(other.open(A, Target::Host(B), &payload), Err(DropCause::Forged), "in another project");
        let mut other = Seal::new("leg", B, Instance([9; 16]), Some(&key("5b")));
        assert_eq!(other.open(A, Target::Host(B), &payload), Err(DropCause::Forged), "with another key");
    }

    #[test]
    fn modes_do_not_mix() {
        let mut plain = Seal::new("leg", B, Instance([2; 16]), None);
        let payload = seal_of(A).seal(Target::Host(B), b"a packet");
        assert_eq!(plain.open(A, Target::Host(B), &payload), Err(DropCause::OtherMode));
        let payload = plain.seal(Target::Host(A), b"a packet");
        assert_eq!(seal_of(A).open(B, Target::Host(A), &payload), Err(DropCause::OtherMode));
        let mut other = Seal::new("leg", A, Instance([1; 16]), None);
        assert_eq!(other.open(B, Target::Host(A), &payload), Ok(b"a packet".to_vec()));
    }

    proptest! {
        #[test]
        fn changed_bit_is_noticed(at in 0_usize..SEAL_BYTES + 8, bit in 0_u32..8) {
            let (mut a, mut b) = (seal_of(A), seal_of(B));
            let mut payload = a.seal(Target::Host(B), b"a packet");
            payload[at] ^= 1 << bit;
            prop_assert!(b.open(A, Target::Host(B), &payload).is_err());
            prop_assert!(b.senders.is_empty(), "a forged put costs no memory");
        }

        #[test]
        fn no_bytes_make_it_panic(bytes in proptest::collection::vec(any::<u8>(), 0..80)) {
            let _ = seal_of(B).open(A, Target::Host(B), &bytes);
        }
    }
}
