//! The receiving half: which values are newer than the earlier ones of their flow, and which numbers to acknowledge.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::Duration,
};

use sinew_runtime::time::Time;

use super::packet::{Acknowledgement, RANGES_MAX, Range};

/// Maximum number of flows of one peer with a kept last number. For a further flow, the flow with the smallest last
/// number is dropped.
pub const FLOWS_MAX: usize = 4_096;
/// Time that a received value waits for a datagram to the peer that can carry its acknowledgement; then the
/// acknowledgement is sent alone. A loop of 1 kHz on this side sends one in time, also if it is half a
/// millisecond late. The reactor's timer adds a millisecond, and the peer repeats its value after 4 ms.
const ACK_DELAY: Duration = Duration::from_micros(1_500);
/// Number of values that are acknowledged at once.
const ACK_AT: usize = 32;

/// The receive state of a peer's values.
#[derive(Clone, Debug)]
pub struct Incoming<K> {
    /// The number of the last forwarded value of each flow.
    last: BTreeMap<K, u64>,
    /// The same entries, the flow that has been silent longest first. Dropping a flow therefore needs no
    /// search, even if a peer creates flows without end.
    by_number: BTreeSet<(u64, K)>,
    flows_max: usize,
    /// A value of an unknown flow counts as old up to this number.
    floor: u64,
    /// Number of values that arrived by datagram and were forwarded.
    taken: u64,
    /// Numbers received since the last acknowledgement.
    unacknowledged: Vec<Range>,
    unacknowledged_values: usize,
    /// The stamp of the last datagram to acknowledge, and its receive time.
    echo: Option<(u32, Time)>,
    /// The receive time of the first datagram since the last acknowledgement.
    waits_since: Time,
    #[cfg(feature = "testing")]
    pub(super) planted: Option<super::Fault>,
}

impl<K: Ord + Copy> Incoming<K> {
    pub fn new(flows_max: usize) -> Self {
        Self {
            last: BTreeMap::new(),
            by_number: BTreeSet::new(),
            flows_max,
            floor: 0,
            taken: 0,
            unacknowledged: Vec::with_capacity(RANGES_MAX),
            unacknowledged_values: 0,
            echo: None,
            waits_since: Time::ZERO,
            #[cfg(feature = "testing")]
            planted: None,
        }
    }

    /// Processes a value received by datagram at `now`. Returns whether to forward it.
    pub fn on_value(&mut self, now: Time, stamp: u32, key: K, number: u64) -> bool {
        self.arrived(now, stamp);
        self.add_unacknowledged(number);
        let is_new = self.is_new(key, number);
        self.taken += u64::from(is_new);
        is_new
    }

    /// Processes a value received over the connection. Returns whether to forward it.
    pub fn on_connection_value(&mut self, key: K, number: u64) -> bool {
        self.is_new(key, number)
    }

    /// Processes a probe, which must be acknowledged at once.
    pub(super) fn on_probe(&mut self, now: Time, stamp: u32, number: u64) {
        self.arrived(now, stamp);
        self.add_unacknowledged(number);
        self.unacknowledged_values = ACK_AT;
    }

    fn arrived(&mut self, now: Time, stamp: u32) {
        if self.echo.replace((stamp, now)).is_none() {
            self.waits_since = now;
        }
    }

    /// Resets the acknowledgement state for a peer that has lost its send state.
    pub fn begin_anew(&mut self) {
        self.taken = 0;
        self.unacknowledged.clear();
        self.unacknowledged_values = 0;
        self.echo = None;
    }

    /// Returns whether the number is above the last one of its flow. Each value is so forwarded once and in order.
    fn is_new(&mut self, key: K, number: u64) -> bool {
        #[cfg(feature = "testing")]
        if self.planted == Some(super::Fault::NumbersNotCompared) {
            return true;
        }
        if let Some(last) = self.last.get_mut(&key) {
            let is_new = number > *last;
            if is_new {
                self.by_number.remove(&(*last, key));
                self.by_number.insert((number, key));
                *last = number;
            }
            return is_new;
        }
        if number <= self.floor {
            return false;
        }
        if self.last.len() >= self.flows_max {
            self.evict_oldest();
        }
        self.last.insert(key, number);
        self.by_number.insert((number, key));
        true
    }

    /// Drops the flow that has been silent longest. Numbers are common to all flows, so an earlier value of
    /// it never counts as new: its number is at or below the floor.
    fn evict_oldest(&mut self) {
        if let Some((number, key)) = self.by_number.pop_first() {
            self.last.remove(&key);
            self.floor = self.floor.max(number);
        }
    }

    fn add_unacknowledged(&mut self, number: u64) {
        self.unacknowledged_values += 1;
        let wider = self
            .unacknowledged
            .iter()
            .enumerate()
            .rev()
            .find_map(|(at, range)| Some((at, range.with(number)?)));
        match wider {
            Some((at, wider)) => self.unacknowledged[at] = wider,
            // A value that finds no room is sent again, and acknowledged then.
            None if self.unacknowledged.len() >= RANGES_MAX => {}
            None => self.unacknowledged.push(Range::of(number)),
        }
    }

    /// Whether an acknowledgement must be sent now.
    pub(super) fn is_due(&self, now: Time) -> bool {
        self.due().is_some_and(|due| due <= now)
    }

    /// Returns when the next acknowledgement is due.
    pub(super) fn due(&self) -> Option<Time> {
        let is_much = self.unacknowledged_values >= ACK_AT || self.unacknowledged.len() >= RANGES_MAX;
        self.echo.map(|_| if is_much { Time::ZERO } else { self.waits_since + ACK_DELAY })
    }

    /// Takes the pending acknowledgement, with at most `ranges_max` ranges; `None` if there is none.
    pub fn take(&mut self, now: Time, ranges_max: usize) -> Option<Acknowledgement> {
        let (echo, received_at) = self.echo?;
        let count = self.unacknowledged.len().min(ranges_max);
        let mut ranges = [Range::of(0); RANGES_MAX];
        for (place, range) in ranges.iter_mut().zip(self.unacknowledged.drain(..count)) {
            *place = range;
        }
        let held_us = u32::try_from(now.since(received_at).as_micros()).unwrap_or(u32::MAX);
        if self.unacknowledged.is_empty() {
            self.echo = None;
            self.unacknowledged_values = 0;
        }
        Some(Acknowledgement { echo, held_us, taken: self.taken, ranges, count })
    }

    #[cfg(test)]
    pub(super) fn flows(&self) -> usize {
        assert_eq!(self.last.len(), self.by_number.len(), "each flow is in both");
        self.last.len()
    }
}
