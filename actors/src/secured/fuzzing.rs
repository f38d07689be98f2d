//! A script of sealed datagrams of discovery: of honest nodes in several lives, forged, cut, lengthened, changed, joined from two, and
//! sent again. None is taken that an honest node did not make so, and of a life that has proven itself none twice.

use std::{
    collections::{BTreeMap, BTreeSet, VecDeque},
    hash::{DefaultHasher, Hasher},
    num::NonZeroUsize,
    time::Duration,
};

use bytes::BytesMut;
use sinew_runtime::{
    tid::{Incarnation, NodeAddress},
    time::Time,
};

use super::{SEAL_LEN, Seals};
use crate::{
    fuzzing::Script,
    security::{DiscoveryKey, SPAN, Stamp},
};

/// Two nodes seal, each is confirmed, each comes, comes again, comes damaged; one begins a new life.
pub(crate) const SOME_SEALS: &[u8] = &[
    0, 0, 3, b'a', b'b', b'c', 0, 1, 1, b'x', 5, 0, 5, 1, 0, 0, 2, 1, 2, 1, 2, 1, 2, 2, 2, 9, 1, 3, 2, 5, 4,
    2, 7, 8, 0, 2, 6, 0, 0, 0, 1, 7, 1, 3, 5, 0, 0, 0, 1, 8, 1, 4, 1, 4, 9, 40, 1, 1, 2, 5,
];

const NODES: [NodeAddress; 2] = [NodeAddress::new(0x0a00_0002), NodeAddress::new(0x0a00_0003)];
const PROJECT: &str = "walker";
/// Datagrams of honest nodes that can come again, at most.
const KEPT: usize = 64;

/// A datagram as an honest node sent it.
struct Sent {
    bytes: Vec<u8>,
    stamp: Stamp,
}

/// What is known of a life that has proven itself, in the plainest form.
struct Proven {
    incarnation: Incarnation,
    highest: u64,
    /// As said when it was confirmed; of these none counts.
    before: u64,
    taken: BTreeSet<u64>,
}

struct Play {
    receiver: Seals,
    nodes: [Seals; 2],
    forger: Seals,
    key: u64,
    lives: [Incarnation; 2],
    sent: VecDeque<Sent>,
    proven: BTreeMap<NodeAddress, Proven>,
    taken: usize,
}

/// Plays a script. Returns whether any datagram was taken.
pub(crate) fn seals(script: &[u8]) -> bool {
    let lives = [Incarnation(100), Incarnation(200)];
    let key = key_for(script);
    let mut play = Play {
        receiver: seals_of(key, NodeAddress::new(1), Incarnation(1)),
        nodes: [0, 1].map(|index| seals_of(key, NODES[index], lives[index])),
        forger: seals_of(!key, NODES[0], lives[0]),
        key,
        lives,
        sent: VecDeque::new(),
        proven: BTreeMap::new(),
        taken: 0,
    };
    let mut script = Script::new(script);
    while !script.is_over() {
        play.step(&mut script);
    }
    play.taken > 0
}

/// The key of all honest nodes of this script, and of no other one: whoever writes scripts reads what is compared, so he knows the tags of all
/// that was sealed in others, and with one key for all could write a datagram that an honest node is yet to make.
fn key_for(script: &[u8]) -> u64 {
    let mut hasher = DefaultHasher::new();
    hasher.write(script);
    hasher.finish()
}

fn seals_of(key: u64, node: NodeAddress, life: Incarnation) -> Seals {
    let digits = format!("{key:016x}").repeat(2 * DiscoveryKey::BYTES / 16);
    let key = DiscoveryKey::read(digits.as_bytes()).expect("these are digits");
    Seals::new(&key, PROJECT, node, life, NonZeroUsize::new(4).expect("it is not 0"))
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
                bytes.into_iter().for_each(|bytes| self.comes(&bytes));
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
                // Whether the clock has gone on, or begun anew: a life is never used twice.
                let Incarnation(life) = self.lives[index];
                self.lives[index] = Incarnation(if index == 0 { life + 1 } else { life.saturating_sub(1) });
                self.nodes[index] = seals_of(self.key, NODES[index], self.lives[index]);
            }
            7 => {
                let mut forged = BytesMut::from(&NODES[0].bits().to_le_bytes()[..]);
                forged.extend_from_slice(script.bytes(8));
                self.forger.seal(&mut forged);
                self.comes(&forged);
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
                self.comes(script.bytes(count));
            }
        }
    }

    fn send(&mut self, index: usize, text: &[u8]) {
        let (node, incarnation) = (NODES[index], self.lives[index]);
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
        self.comes(&bytes);
    }

    fn confirm(&mut self, index: usize) {
        let (node, incarnation) = (NODES[index], self.lives[index]);
        let number = self.nodes[index].made();
        self.receiver.confirm(Time::ZERO, Duration::ZERO, Stamp { node, incarnation, number });
        if self.proven.get(&node).is_none_or(|known| known.incarnation != incarnation) {
            let taken = BTreeSet::new();
            self.proven.insert(node, Proven { incarnation, highest: number, before: number, taken });
        }
    }

    /// These bytes come to the receiver, whoever made them.
    fn comes(&mut self, bytes: &[u8]) {
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
        let Some(proven) = self.proven.get_mut(&stamp.node) else { return true };
        if proven.incarnation != stamp.incarnation {
            // A hint.
            return true;
        }
        let is_late = stamp.number <= proven.before
            || proven.highest.checked_sub(stamp.number).is_some_and(|behind| behind >= SPAN);
        let counts = !is_late && proven.taken.insert(stamp.number);
        if counts {
            proven.highest = proven.highest.max(stamp.number);
        }
        counts
    }
}
