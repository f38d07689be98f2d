//! The payload types that a sender has sent.

use std::sync::atomic::{AtomicU64, Ordering};

use crate::wire::{PLACES, PayloadType};

const BITS: usize = u64::BITS as usize;

/// One bit for each place in the table of types.
#[derive(Debug, Default)]
pub(super) struct SentTypes([AtomicU64; PLACES / BITS]);

impl SentTypes {
    /// Returns whether the type was recorded. It is one load and a branch.
    #[inline]
    pub(super) fn contains(&self, one: PayloadType) -> bool {
        let (word, bit) = Self::at(one);
        // SYNC: Relaxed; no other data depends on it.
        self.0[word].load(Ordering::Relaxed) & bit != 0
    }

    /// Records the type. Returns whether it is new.
    pub(super) fn insert(&self, one: PayloadType) -> bool {
        let (word, bit) = Self::at(one);
        // SYNC: as in `contains`.
        self.0[word].fetch_or(bit, Ordering::Relaxed) & bit == 0
    }

    #[inline]
    const fn at(one: PayloadType) -> (usize, u64) {
        (one.place() / BITS % (PLACES / BITS), 1 << (one.place() % BITS))
    }
}

#[cfg(test)]
mod tests {
    use serde::{Deserialize, Serialize};

    use super::*;
    use crate::wire::{Payload, remember};

    #[derive(Serialize, Deserialize)]
    struct Angle {}

    impl Payload for Angle {
        const NAME: &'static str = "test.sent_types.angle";
    }

    #[derive(Serialize, Deserialize)]
    struct Speed {}

    impl Payload for Speed {
        const NAME: &'static str = "test.sent_types.speed";
    }

    #[test]
    fn type_is_new_once() {
        let sent = SentTypes::default();
        let [angle, speed] =
            [remember::<Angle>(), remember::<Speed>()].map(|one| one.expect("there is room"));
        assert!(!sent.contains(angle));
        assert!(sent.insert(angle) && !sent.insert(angle) && sent.contains(angle));
        assert!(!sent.contains(speed) && sent.insert(speed));
    }
}
