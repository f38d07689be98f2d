//! The table of channels: one place for each key, claimed without a lock, and never given back.
//!
//! ```text
//! word 0  hash of the key; 0: free      claimed by a compare-and-exchange
//!      1  1 once the key is there
//!      2  the key, three words
//!      5  seen: messages ever counted
//! ```
//!
//! The last place takes what has found no other one.

use std::sync::atomic::Ordering;

use super::{super::layout::PLACE_WORDS, AtomicU64};

/// Number of places that are searched for a key, from that of its hash.
pub(crate) const PROBES: usize = 16;
/// Words of a place, by their meaning.
pub(crate) const HASH: usize = 0;
pub(crate) const READY: usize = 1;
pub(crate) const KEY: usize = 2;
pub(crate) const SEEN: usize = 5;

/// The key of a channel: three words, of which this package knows no meaning.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ChannelKey(pub [u64; 3]);

impl ChannelKey {
    /// Returns a number that is never 0. Two keys have the same by chance once in 2^64 times.
    fn hash(self) -> u64 {
        // The finalizer of SplitMix64 (Steele, Lea and Flood 2014): each bit of a key changes half of the result's.
        let mix = |hash: u64, word: u64| {
            let mut z = (hash ^ word).wrapping_add(0x9E37_79B9_7F4A_7C15);
            z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
            z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
            z ^ (z >> 31)
        };
        self.0.into_iter().fold(0, mix).max(1)
    }
}

/// Counts `messages` of a channel. Returns its place, and the number of the last of them.
pub(crate) fn count(table: &[AtomicU64], key: ChannelKey, messages: u64) -> (u16, u64) {
    let place = find(table, key);
    let seen = &table[place * PLACE_WORDS + SEEN];
    // SYNC: Relaxed: each value is taken once, and no other data depends on it.
    let before = seen.fetch_add(messages, Ordering::Relaxed);
    (u16::try_from(place).expect("a table has at most 65,536 places"), before.wrapping_add(messages))
}

/// Returns the place of a key, and claims one if it has none.
fn find(table: &[AtomicU64], key: ChannelKey) -> usize {
    let (hash, others) = (key.hash(), table.len() / PLACE_WORDS - 1);
    for probe in 0..PROBES.min(others) {
        let place = (hash as usize).wrapping_add(probe) % others;
        let words = &table[place * PLACE_WORDS..][..PLACE_WORDS];
        let found = words[HASH].load(Ordering::Relaxed);
        let found = if found == 0 { claim(words, hash, key) } else { found };
        if found == hash && is_of(words, key) {
            return place;
        }
    }
    others
}

/// Claims a free place. Returns the hash that it has now: that of another key if that was faster.
fn claim(words: &[AtomicU64], hash: u64, key: ChannelKey) -> u64 {
    let claimed = words[HASH].compare_exchange(0, hash, Ordering::Relaxed, Ordering::Relaxed);
    if let Err(other) = claimed {
        return other;
    }
    for (target, word) in words[KEY..].iter().zip(key.0) {
        target.store(word, Ordering::Relaxed);
    }
    // SYNC: the key is there for `is_of`, and for a reader that fences after it has read this.
    words[READY].store(1_u64, Ordering::Release);
    hash
}

/// Whether a place with the hash of this key is that of the key. Its claimer may be about to write the key: nobody
/// waits for that, and the hash decides.
fn is_of(words: &[AtomicU64], key: ChannelKey) -> bool {
    // SYNC: with `claim`.
    words[READY].load(Ordering::Acquire) == 0
        || words[KEY..].iter().zip(key.0).all(|(word, own)| word.load(Ordering::Relaxed) == own)
}
