//! The clock of each process: that of its host, which counts since the host booted, and agrees with no other one.

use super::*;

/// What the clock of a host that has just booted says, at most, in nanoseconds.
const BOOTED_MAX: u64 = 5_000_000;
/// What any clock says when a life begins, at most: a month.
const UPTIME_MAX: u64 = 30 * 24 * 3_600 * 1_000_000_000;

/// What the clocks of processes say.
pub(super) struct Clocks {
    /// Of its own, so that the same happens in a seed whatever clocks say.
    chance: Chance,
    /// How far the clock of each process is ahead of the simulation's time, in nanoseconds.
    ahead: BTreeMap<usize, i64>,
}

impl Clocks {
    pub(super) fn new(seed: u64) -> Self {
        Self { chance: Chance::new(!seed), ahead: BTreeMap::new() }
    }

    /// A life of a process begins: its host has booted, or it is another one, or its clock goes on.
    pub(super) fn begin(&mut self, process: usize, now: Time) {
        let says = match self.chance.below(3) {
            0 => self.chance.0.u64(1..BOOTED_MAX),
            1 if self.ahead.contains_key(&process) => return,
            _ => self.chance.0.u64(1..UPTIME_MAX),
        };
        let signed = |nanos: u64| i64::try_from(nanos).expect("a month, or the time of one seed");
        self.ahead.insert(process, signed(says) - signed(now.as_nanos()));
    }

    /// What the clock of a process says at a time of the simulation.
    pub(super) fn read(&self, process: usize, at: Time) -> Time {
        at.shifted(self.ahead[&process])
    }

    /// When the clock of a process says this.
    pub(super) fn when(&self, process: usize, says: Time) -> Time {
        says.shifted(-self.ahead[&process])
    }
}

impl World {
    /// What the clock of a process says.
    pub(super) fn clock(&self, process: usize) -> Time {
        self.clocks.read(process, self.now)
    }

    /// When a process wants to run, in the simulation's time.
    pub(super) fn next_wake(&self, process: usize) -> Option<Time> {
        Some(self.clocks.when(process, self.cores[process].next_wake()?))
    }
}
