//! The receiving half: which value is newer than all of its flow before, and what is to be acknowledged.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::Duration,
};

use sinew_runtime::time::Time;

use super::packet::{Acknowledgement, RANGES_MAX, Range};

/// Flows of one peer whose last number is kept, at most. Of a further one the flow whose last number is the smallest is given up.
pub(super) const FLOWS_MAX: usize = 4_096;
/// Acknowledgements are sent so often at most, unless much is to be acknowledged.
const ACK_PERIOD: Duration = Duration::from_millis(1);
/// So many values are acknowledged at once.
const ACK_AT: usize = 32;

/// What of a peer's values has come.
#[derive(Clone, Debug)]
pub(super) struct Incoming<K> {
    /// The number of the last value of each flow that was handed on.
    last: BTreeMap<K, u64>,
    /// The same, the flow that has been silent longest first: whoever makes flows without end costs no look at all of them for each.
    by_number: BTreeSet<(u64, K)>,
    flows_max: usize,
    /// A value of a flow that is not among them counts as old up to this number.
    floor: u64,
    /// Values that came by datagram and were handed on.
    taken: u64,
    /// What came since the last acknowledgement.
    owed: Vec<Range>,
    owed_values: usize,
    /// The stamp of the last datagram that is to be answered, and when it came.
    echo: Option<(u32, Time)>,
    acknowledged: Time,
    #[cfg(test)]
    pub(super) planted: super::simulation::Planted,
}

impl<K: Ord + Copy> Incoming<K> {
    pub(super) fn new(flows_max: usize) -> Self {
        Self {
            last: BTreeMap::new(),
            by_number: BTreeSet::new(),
            flows_max,
            floor: 0,
            taken: 0,
            owed: Vec::with_capacity(RANGES_MAX),
            owed_values: 0,
            echo: None,
            acknowledged: Time::ZERO,
            #[cfg(test)]
            planted: super::simulation::Planted::Nothing,
        }
    }

    /// A value has come by datagram at `now`. Returns whether it is to be handed on.
    pub(super) fn came(&mut self, now: Time, stamp: u32, key: K, number: u64) -> bool {
        self.echo = Some((stamp, now));
        self.owe(number);
        let is_new = self.is_new(key, number);
        self.taken += u64::from(is_new);
        is_new
    }

    /// A value has come by the connection. Returns whether it is to be handed on.
    pub(super) fn came_by_connection(&mut self, key: K, number: u64) -> bool {
        self.is_new(key, number)
    }

    /// A probe has come, which is to be acknowledged at once.
    pub(super) fn asked(&mut self, now: Time, stamp: u32, number: u64) {
        self.echo = Some((stamp, now));
        self.owe(number);
        self.owed_values = ACK_AT;
    }

    /// The peer counts anew what was taken of it: it has forgotten us.
    pub(super) fn begin_anew(&mut self) {
        self.taken = 0;
        self.owed.clear();
        self.owed_values = 0;
        self.echo = None;
    }

    /// Once and in order: above the last one, or not at all.
    fn is_new(&mut self, key: K, number: u64) -> bool {
        #[cfg(test)]
        if self.planted == super::simulation::Planted::NumbersNotCompared {
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
            self.give_one_up();
        }
        self.last.insert(key, number);
        self.by_number.insert((number, key));
        true
    }

    /// What is known of the flow that has been silent longest is given up. Numbers are common to all flows, so no value of it that was sent
    /// before can be taken for a new one: it would be at the floor or below.
    fn give_one_up(&mut self) {
        if let Some((number, key)) = self.by_number.pop_first() {
            self.last.remove(&key);
            self.floor = self.floor.max(number);
        }
    }

    fn owe(&mut self, number: u64) {
        self.owed_values += 1;
        let wider =
            self.owed.iter().enumerate().rev().find_map(|(at, range)| Some((at, range.with(number)?)));
        match wider {
            Some((at, wider)) => self.owed[at] = wider,
            // What finds no room is sent again, and acknowledged then.
            None if self.owed.len() >= RANGES_MAX => {}
            None => self.owed.push(Range::of(number)),
        }
    }

    /// Whether an acknowledgement is to be sent now.
    pub(super) fn is_due(&self, now: Time) -> bool {
        self.due().is_some_and(|due| due <= now)
    }

    /// When one is to be sent.
    pub(super) fn due(&self) -> Option<Time> {
        let is_much = self.owed_values >= ACK_AT || self.owed.len() >= RANGES_MAX;
        self.echo.map(|_| if is_much { Time::ZERO } else { self.acknowledged + ACK_PERIOD })
    }

    /// What is to be acknowledged, in `ranges_max` ranges at most; `None` if there is nothing.
    pub(super) fn take(&mut self, now: Time, ranges_max: usize) -> Option<Acknowledgement> {
        let (echo, came) = self.echo?;
        let count = self.owed.len().min(ranges_max);
        let mut ranges = [Range::of(0); RANGES_MAX];
        for (place, range) in ranges.iter_mut().zip(self.owed.drain(..count)) {
            *place = range;
        }
        let held_us = u32::try_from(now.since(came).as_micros()).unwrap_or(u32::MAX);
        if self.owed.is_empty() {
            self.echo = None;
            self.owed_values = 0;
        }
        self.acknowledged = now;
        Some(Acknowledgement { echo, held_us, taken: self.taken, ranges, count })
    }

    #[cfg(test)]
    pub(super) fn flows(&self) -> usize {
        assert_eq!(self.last.len(), self.by_number.len(), "each flow is in both");
        self.last.len()
    }
}
