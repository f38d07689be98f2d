//! Fault logic for datagrams in one direction. Pure: datagrams and times in, datagrams out.

use std::{collections::BTreeMap, time::Duration};

use sinew::Time;

use super::{faults::Faults, stream::flip};
use crate::random::SeededRandom;

/// Maximum number of waiting datagrams. Further ones are lost, as in any router.
pub(super) const HELD_MAX: usize = 1_024;

/// One direction of one listener. `A` is the destination of a datagram.
#[derive(Debug)]
pub(super) struct DatagramWay<A> {
    faults: Faults,
    random: SeededRandom,
    /// By due time, then by order of arrival.
    held: BTreeMap<(Time, u64), (A, Vec<u8>)>,
    taken: u64,
    free_at: Time,
    lost: u64,
    flips: u64,
}

impl<A> DatagramWay<A> {
    pub(super) fn new(faults: Faults, random: SeededRandom) -> Self {
        let (held, free_at) = (BTreeMap::new(), Time::ZERO);
        Self { faults, random, held, taken: 0, free_at, lost: 0, flips: 0 }
    }

    /// Sets the faults from now on. Datagrams already delayed stay so; datagrams on a cut cable are lost.
    pub(super) fn set(&mut self, faults: Faults) {
        self.faults = faults;
        if faults.parted {
            self.lost += self.held.len() as u64;
            self.held.clear();
        }
    }

    /// Accepts a datagram.
    pub(super) fn take(&mut self, now: Time, to: A, mut datagram: Vec<u8>) {
        let is_unlucky = self.faults.one_loss_in.is_some_and(|one_in| self.random.once_in(one_in.get()));
        if self.faults.parted || is_unlucky || self.held.len() >= HELD_MAX {
            self.lost += 1;
            return;
        }
        self.flips += flip(&mut datagram, &self.faults, &mut self.random);
        let late = self.faults.delay + self.random.time_below(self.faults.jitter);
        self.taken += 1;
        self.held.insert((now + late, self.taken), (to, datagram));
    }

    /// The next datagram that is due now.
    pub(super) fn pass(&mut self, now: Time) -> Option<(A, Vec<u8>)> {
        if self.next_wake()? > now {
            return None;
        }
        let (_, passing) = self.held.pop_first()?;
        if let Some(rate) = self.faults.bytes_per_second {
            let nanos = (passing.1.len() as u128 * 1_000_000_000).div_ceil(u128::from(rate.get()));
            self.free_at = self.free_at.max(now) + Duration::from_nanos(nanos as u64);
        }
        Some(passing)
    }

    /// The due time of the next datagram, if the faults do not change.
    pub(super) fn next_wake(&self) -> Option<Time> {
        let ((due, _), _) = self.held.first_key_value().filter(|_| !self.faults.is_blocked())?;
        let limit = self.faults.bytes_per_second.map_or(Time::ZERO, |_| self.free_at);
        Some((*due).max(limit))
    }

    /// Datagrams lost and bits flipped since the last call.
    pub(super) const fn new_lost_and_flips(&mut self) -> (u64, u64) {
        (std::mem::replace(&mut self.lost, 0), std::mem::replace(&mut self.flips, 0))
    }
}
