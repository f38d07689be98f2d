//! What happens to which datagram when, on one way. Pure: datagrams and times in, datagrams out.

use std::{collections::BTreeMap, time::Duration};

use sinew::Time;

use super::{faults::Faults, stream::flip};
use crate::dice::Dice;

/// Datagrams that wait at most. A further one is lost, as in any router.
pub(super) const HELD_MAX: usize = 1_024;

/// One way of one door. `A` says where a datagram goes.
#[derive(Debug)]
pub(super) struct DatagramWay<A> {
    faults: Faults,
    dice: Dice,
    /// By when they may pass, then by when they came.
    held: BTreeMap<(Time, u64), (A, Vec<u8>)>,
    taken: u64,
    free_at: Time,
    lost: u64,
    flips: u64,
}

impl<A> DatagramWay<A> {
    pub(super) fn new(faults: Faults, dice: Dice) -> Self {
        let (held, free_at) = (BTreeMap::new(), Time::ZERO);
        Self { faults, dice, held, taken: 0, free_at, lost: 0, flips: 0 }
    }

    /// From now on this goes wrong. What is delayed already stays so, and what is on a cable that is cut is lost.
    pub(super) fn set(&mut self, faults: Faults) {
        self.faults = faults;
        if faults.parted {
            self.lost += self.held.len() as u64;
            self.held.clear();
        }
    }

    /// Takes one that came.
    pub(super) fn take(&mut self, now: Time, to: A, mut datagram: Vec<u8>) {
        let is_unlucky = self.faults.one_loss_in.is_some_and(|one_in| self.dice.once_in(one_in.get()));
        if self.faults.parted || is_unlucky || self.held.len() >= HELD_MAX {
            self.lost += 1;
            return;
        }
        self.flips += flip(&mut datagram, &self.faults, &mut self.dice);
        let late = self.faults.delay + self.dice.time_below(self.faults.jitter);
        self.taken += 1;
        self.held.insert((now + late, self.taken), (to, datagram));
    }

    /// The next one that passes now.
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

    /// When the next one passes, if nothing else is said.
    pub(super) fn next_wake(&self) -> Option<Time> {
        let ((due, _), _) = self.held.first_key_value().filter(|_| !self.faults.is_blocked())?;
        let limit = self.faults.bytes_per_second.map_or(Time::ZERO, |_| self.free_at);
        Some((*due).max(limit))
    }

    /// Datagrams that were lost, and bits that were flipped, since this was asked last.
    pub(super) const fn new_lost_and_flips(&mut self) -> (u64, u64) {
        (std::mem::replace(&mut self.lost, 0), std::mem::replace(&mut self.flips, 0))
    }
}
