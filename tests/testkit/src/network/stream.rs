//! Fault logic for the bytes of a connection in one direction. Pure: bytes and times in, bytes out.

use std::{collections::VecDeque, time::Duration};

use sinew::Time;

use super::faults::Faults;
use crate::random::SeededRandom;

/// Maximum number of waiting bytes. Beyond it no more are accepted.
pub(super) const HELD_MAX: usize = 256 << 10;
/// Maximum number of waiting pieces, because many single bytes cost more memory than their content.
const PIECES_MAX: usize = 16 << 10;
/// With a rate limit, the bytes of this time are forwarded at once.
const SLICE: Duration = Duration::from_millis(1);

/// One direction of one connection.
#[derive(Debug)]
pub(super) struct StreamWay {
    faults: Faults,
    random: SeededRandom,
    held: VecDeque<Piece>,
    held_bytes: usize,
    /// The latest due time: no byte passes before an earlier one.
    latest: Time,
    /// With a rate limit, the time at which the next bytes may pass.
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
    pub(super) fn new(faults: Faults, random: SeededRandom) -> Self {
        let (held, latest, free_at) = (VecDeque::new(), Time::ZERO, Time::ZERO);
        Self { faults, random, held, held_bytes: 0, latest, free_at, flips: 0 }
    }

    /// Sets the faults from now on. Bytes already delayed stay so.
    pub(super) const fn set(&mut self, faults: Faults) {
        self.faults = faults;
    }

    /// Number of bytes that may be accepted now.
    pub(super) fn room(&self) -> usize {
        if self.held.len() < PIECES_MAX { HELD_MAX - self.held_bytes } else { 0 }
    }

    /// Accepts bytes, at most as many as there is [room](Self::room) for.
    pub(super) fn take(&mut self, now: Time, bytes: &[u8]) {
        debug_assert!(bytes.len() <= self.room(), "a reader checks the room first");
        let mut bytes = bytes.to_vec();
        self.flips += flip(&mut bytes, &self.faults, &mut self.random);
        let late = self.faults.delay + self.random.time_below(self.faults.jitter);
        self.latest = self.latest.max(now + late);
        self.held_bytes += bytes.len();
        self.held.push_back(Piece { due: self.latest, bytes, passed: 0 });
    }

    /// The bytes that may pass now; may be empty.
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

    /// Records that this many of the ready bytes have passed.
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

    /// The time at which the next bytes may pass, if the faults do not change.
    pub(super) fn next_wake(&self) -> Option<Time> {
        let piece = self.held.front().filter(|_| !self.faults.is_blocked())?;
        Some(piece.due.max(self.limit()))
    }

    fn limit(&self) -> Time {
        self.faults.bytes_per_second.map_or(Time::ZERO, |_| self.free_at)
    }

    /// Returns whether all bytes have passed.
    pub(super) fn is_empty(&self) -> bool {
        self.held.is_empty()
    }

    /// Bits flipped since the last call.
    pub(super) const fn new_flips(&mut self) -> u64 {
        std::mem::replace(&mut self.flips, 0)
    }
}

/// Flips bits of `bytes`, and returns their number.
pub(super) fn flip(bytes: &mut [u8], faults: &Faults, random: &mut SeededRandom) -> u64 {
    let Some(one_in) = faults.one_flip_in else { return 0 };
    let mut flips = 0;
    for byte in bytes {
        if random.once_in(one_in.get()) {
            *byte ^= 1 << random.below(8);
            flips += 1;
        }
    }
    flips
}
