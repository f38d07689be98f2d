//! A script of sealed discovery datagrams: from honest nodes in several incarnations, forged, cut, extended,
//! changed, joined from two, and repeated. No datagram is accepted that an honest node did not make, and none
//! of an authenticated incarnation is accepted twice.

use std::{
    collections::{BTreeMap, BTreeSet, VecDeque},
    hash::{DefaultHasher, Hasher},
    num::NonZeroUsize,
    time::Duration,
};

use bytes::BytesMut;
use sinew_runtime::{
    fuzzing::Script,
    tid::{Incarnation, NodeAddress},
    time::Time,
};

use super::{SEAL_LEN, Seals};
use crate::{DiscoveryKey, SPAN, Stamp};

/// Two nodes seal datagrams. Each one is confirmed, delivered, repeated and damaged; one node starts a
/// new incarnation.
pub const SOME_SEALS: &[u8] = &[
    0, 0, 3, b'a', b'b', b'c', 0, 1, 1, b'x', 5, 0, 5, 1, 0, 0, 2, 1, 2, 1, 2, 1, 2, 2, 2, 9, 1, 3, 2, 5, 4,
    2, 7, 8, 0, 2, 6, 0, 0, 0, 1, 7, 1, 3, 5, 0, 0, 0, 1, 8, 1, 4, 1, 4, 9, 40, 1, 1, 2, 5,
];

const NODES: [NodeAddress; 2] = [NodeAddress::new(0x0a00_0002), NodeAddress::new(0x0a00_0003)];
const PROJECT: &str = "walker";
/// Maximum number of kept datagrams of honest nodes, which may be replayed.
const KEPT: usize = 64;

/// A datagram as an honest node sent it.
struct Sent {
    bytes: Vec<u8>,
    stamp: Stamp,
}

/// The known state of an authenticated incarnation, in the simplest form.
struct Confirmed {
    incarnation: Incarnation,
    highest: u64,
    /// The number from its confirmation; numbers up to this one are never valid.
    before: u64,
    taken: BTreeSet<u64>,
}

struct Play {
    receiver: Seals,
    nodes: [Seals; 2],
    forger: Seals,
    key: u64,
    incarnations: [Incarnation; 2],
    sent: VecDeque<Sent>,
    confirmed: BTreeMap<NodeAddress, Confirmed>,
    taken: usize,
}

/// Plays a script. Returns whether any datagram was taken.
pub fn seals(script: &[u8]) -> bool {
    let incarnations = [Incarnation(100), Incarnation(200)];
    let key = key_for(script);
    let mut play = Play {
        receiver: seals_of(key, NodeAddress::new(1), Incarnation(1)),
        nodes: [0, 1].map(|index| seals_of(key, NODES[index], incarnations[index])),
        forger: seals_of(!key, NODES[0], incarnations[0]),
        key,
        incarnations,
        sent: VecDeque::new(),
        confirmed: BTreeMap::new(),
        taken: 0,
    };
    let mut script = Script::new(script);
    while !script.is_over() {
        play.step(&mut script);
    }
    play.taken > 0
}

/// The key of all honest nodes of this script, and of no others. A fuzzer that writes scripts reads the
/// compared bytes, so it knows the tags of all datagrams sealed in other scripts. With one key for all
/// scripts it could write a datagram that an honest node has not made yet.
fn key_for(script: &[u8]) -> u64 {
    let mut hasher = DefaultHasher::new();
    hasher.write(script);
    hasher.finish()
}

fn seals_of(key: u64, node: NodeAddress, incarnation: Incarnation) -> Seals {
    let digits = format!("{key:016x}").repeat(2 * DiscoveryKey::BYTES / 16);
    let key = DiscoveryKey::read(digits.as_bytes()).expect("these are digits");
    Seals::new(&key, PROJECT, node, incarnation, NonZeroUsize::new(4).expect("it is not 0"))
}

fn maker(datagram: &[u8]) -> Option<NodeAddress> {
    datagram.first_chunk().map(|node| NodeAddress::new(u32::from_le_bytes(*node)))
}

impl Play {
    fn step(&mut self, script: &mut Script<'_>) {
        match script.byte() % 10 {
            0 => {
                let (index, length) = (usize::from(script.byte() % 2), usize::from(script.byte() % 64));
                self.send(index, script.bytes(length));
            }
            1 => {
                let bytes = self.any(script).map(|sent| sent.bytes.clone());
                bytes.into_iter().for_each(|bytes| self.deliver(&bytes));
            }
            2 => self.changed(script, |bytes, script| {
                let at = usize::from(script.byte()) % bytes.len();
                bytes[at] ^= script.byte();
            }),
            3 => self.changed(script, |bytes, script| {
                bytes.truncate(bytes.len() - 1 - usize::from(script.byte()) % bytes.len());
            }),
            4 => self.changed(script, |bytes, script| bytes.push(script.byte())),
            5 => self.confirm(usize::from(script.byte() % 2)),
            6 => {
                let index = usize::from(script.byte() % 2);
                // The clock has advanced, or was reset: an incarnation is never used twice.
                let Incarnation(incarnation) = self.incarnations[index];
                self.incarnations[index] =
                    Incarnation(if index == 0 { incarnation + 1 } else { incarnation.saturating_sub(1) });
                self.nodes[index] = seals_of(self.key, NODES[index], self.incarnations[index]);
            }
            7 => {
                let mut forged = BytesMut::from(&NODES[0].bits().to_le_bytes()[..]);
                forged.extend_from_slice(script.bytes(8));
                self.forger.seal(&mut forged);
                self.deliver(&forged);
            }
            8 => {
                let other = self.any(script).map(|sent| sent.bytes.clone()).unwrap_or_default();
                let seal = other[other.len().saturating_sub(SEAL_LEN)..].to_vec();
                self.changed(script, |bytes, _| {
                    bytes.truncate(bytes.len().saturating_sub(SEAL_LEN));
                    bytes.extend_from_slice(&seal);
                });
            }
            _ => {
                let count = usize::from(script.byte());
                self.deliver(script.bytes(count));
            }
        }
    }

    fn send(&mut self, index: usize, text: &[u8]) {
        let (node, incarnation) = (NODES[index], self.incarnations[index]);
        let mut bytes = BytesMut::from(&node.bits().to_le_bytes()[..]);
        bytes.extend_from_slice(text);
        self.nodes[index].seal(&mut bytes);
        if self.sent.len() == KEPT {
            self.sent.pop_front();
        }
        let stamp = Stamp { node, incarnation, number: self.nodes[index].made() };
        self.sent.push_back(Sent { bytes: bytes.to_vec(), stamp });
    }

    fn any(&self, script: &mut Script<'_>) -> Option<&Sent> {
        let at = usize::from(script.byte());
        self.sent.get(at % self.sent.len().max(1))
    }

    fn changed(&mut self, script: &mut Script<'_>, change: impl FnOnce(&mut Vec<u8>, &mut Script<'_>)) {
        let Some(mut bytes) = self.any(script).map(|sent| sent.bytes.clone()) else { return };
        change(&mut bytes, script);
        self.deliver(&bytes);
    }

    fn confirm(&mut self, index: usize) {
        let (node, incarnation) = (NODES[index], self.incarnations[index]);
        let number = self.nodes[index].made();
        self.receiver.confirm(Time::ZERO, Duration::ZERO, Stamp { node, incarnation, number });
        if self.confirmed.get(&node).is_none_or(|known| known.incarnation != incarnation) {
            let taken = BTreeSet::new();
            self.confirmed.insert(node, Confirmed { incarnation, highest: number, before: number, taken });
        }
    }

    /// Delivers these bytes to the receiver, from any sender.
    fn deliver(&mut self, bytes: &[u8]) {
        let stamp = self.sent.iter().find(|sent| sent.bytes == bytes).map(|sent| sent.stamp);
        let is_right = stamp.is_some_and(|stamp| self.counts(stamp));
        let taken = self.receiver.unseal(Time::ZERO, bytes, maker);
        assert_eq!(taken.is_ok(), is_right, "{stamp:?}: {taken:?}");
        if let Ok(datagram) = taken {
            assert_eq!(datagram, &bytes[..bytes.len() - SEAL_LEN]);
            self.taken += 1;
        }
    }

    /// Whether a datagram that an honest node made so counts now.
    fn counts(&mut self, stamp: Stamp) -> bool {
        let Some(confirmed) = self.confirmed.get_mut(&stamp.node) else { return true };
        if confirmed.incarnation != stamp.incarnation {
            // A hint.
            return true;
        }
        let is_late = stamp.number <= confirmed.before
            || confirmed.highest.checked_sub(stamp.number).is_some_and(|behind| behind >= SPAN);
        let counts = !is_late && confirmed.taken.insert(stamp.number);
        if counts {
            confirmed.highest = confirmed.highest.max(stamp.number);
        }
        counts
    }
}
