//! What happens to which bytes of a connection when, on one way. Pure: bytes and times in, bytes out.

use std::{collections::VecDeque, time::Duration};

use sinew::Time;

use super::faults::Faults;
use crate::dice::Dice;

/// Bytes that wait at most. When so many do, no more are to be taken.
pub(super) const HELD_MAX: usize = 256 << 10;
/// Pieces that wait at most: as many single bytes cost more than what they carry.
const PIECES_MAX: usize = 16 << 10;
/// Where the rate is limited, what passes at once is what it allows in this time.
const SLICE: Duration = Duration::from_millis(1);

/// One way of one connection.
#[derive(Debug)]
pub(super) struct StreamWay {
    faults: Faults,
    dice: Dice,
    held: VecDeque<Piece>,
    held_bytes: usize,
    /// No byte passes before the one that was taken before it.
    latest: Time,
    /// Where the rate is limited, when the next bytes may pass.
    free_at: Time,
    flips: u64,
}

#[derive(Debug)]
struct Piece {
    due: Time,
    bytes: Vec<u8>,
    passed: usize,
}

impl StreamWay {
    pub(super) fn new(faults: Faults, dice: Dice) -> Self {
        let (held, latest, free_at) = (VecDeque::new(), Time::ZERO, Time::ZERO);
        Self { faults, dice, held, held_bytes: 0, latest, free_at, flips: 0 }
    }

    /// From now on this goes wrong. What was delayed already stays so.
    pub(super) const fn set(&mut self, faults: Faults) {
        self.faults = faults;
    }

    /// Bytes that may be taken now.
    pub(super) fn room(&self) -> usize {
        if self.held.len() < PIECES_MAX { HELD_MAX - self.held_bytes } else { 0 }
    }

    /// Takes bytes that came; not more than there is [room](Self::room) for.
    pub(super) fn take(&mut self, now: Time, bytes: &[u8]) {
        debug_assert!(bytes.len() <= self.room(), "whoever reads looks for room first");
        let mut bytes = bytes.to_vec();
        self.flips += flip(&mut bytes, &self.faults, &mut self.dice);
        let late = self.faults.delay + self.dice.time_below(self.faults.jitter);
        self.latest = self.latest.max(now + late);
        self.held_bytes += bytes.len();
        self.held.push_back(Piece { due: self.latest, bytes, passed: 0 });
    }

    /// What may pass now; nothing if it is empty.
    pub(super) fn ready(&self, now: Time) -> &[u8] {
        let Some(piece) = self.held.front() else { return &[] };
        if self.faults.is_blocked() || now < piece.due || now < self.limit() {
            return &[];
        }
        let rest = &piece.bytes[piece.passed..];
        let segment_max = self.faults.segment_max.map_or(usize::MAX, usize::from);
        let slice = self.faults.bytes_per_second.map_or(usize::MAX, |rate| {
            usize::try_from(u128::from(rate.get()) * SLICE.as_nanos() / 1_000_000_000).unwrap_or(usize::MAX)
        });
        &rest[..rest.len().min(segment_max).min(slice.max(1))]
    }

    /// So many of the bytes that were ready have passed.
    pub(super) fn passed(&mut self, now: Time, count: usize) {
        let Some(piece) = self.held.front_mut() else { return };
        piece.passed += count;
        self.held_bytes -= count;
        if piece.passed == piece.bytes.len() {
            self.held.pop_front();
        }
        if let Some(rate) = self.faults.bytes_per_second {
            let nanos = (count as u128 * 1_000_000_000).div_ceil(u128::from(rate.get()));
            self.free_at = self.free_at.max(now) + Duration::from_nanos(nanos as u64);
        }
    }

    /// When something passes that may not pass now, if nothing else is said.
    pub(super) fn next_wake(&self) -> Option<Time> {
        let piece = self.held.front().filter(|_| !self.faults.is_blocked())?;
        Some(piece.due.max(self.limit()))
    }

    fn limit(&self) -> Time {
        self.faults.bytes_per_second.map_or(Time::ZERO, |_| self.free_at)
    }

    /// Whether everything has passed.
    pub(super) fn is_empty(&self) -> bool {
        self.held.is_empty()
    }

    /// Bits that were flipped since this was asked last.
    pub(super) const fn new_flips(&mut self) -> u64 {
        std::mem::replace(&mut self.flips, 0)
    }
}

/// Flips bits of `bytes`; returns how many.
pub(super) fn flip(bytes: &mut [u8], faults: &Faults, dice: &mut Dice) -> u64 {
    let Some(one_in) = faults.one_flip_in else { return 0 };
    let mut flips = 0;
    for byte in bytes {
        if dice.once_in(one_in.get()) {
            *byte ^= 1 << dice.below(8);
            flips += 1;
        }
    }
    flips
}
