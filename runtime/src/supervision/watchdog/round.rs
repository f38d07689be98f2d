//! One check of all incarnations: its time, and the accounts of threads that it has read.

use std::time::Duration;

use super::{processor, rest::Pace};
use crate::time::Time;

/// One check of all incarnations.
pub(super) struct Round {
    pub(super) now: Time,
    pub(super) late: Duration,
    pub(super) period: Duration,
    pub(super) pace: Pace,
    /// The threads of actors at rest whose accounts were read in this round, and how long each has waited for a CPU.
    waited: Vec<(i32, Option<u64>)>,
}

impl Round {
    pub(super) const fn new(now: Time, late: Duration, period: Duration, pace: Pace) -> Self {
        Self { now, late, period, pace, waited: Vec::new() }
    }

    pub(super) fn waited(&mut self, tid: i32) -> Option<u64> {
        if let Some((_, known)) = self.waited.iter().find(|(of, _)| *of == tid) {
            return *known;
        }
        let new = processor::waited(tid);
        self.waited.push((tid, new));
        new
    }
}
