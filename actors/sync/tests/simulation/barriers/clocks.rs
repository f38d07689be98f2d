//! The clock of each process. It is the clock of its host, counts since the host booted, and agrees with no
//! other clock.

use sinew_sim::Clock;

use super::*;

/// The highest clock reading of a host that has just booted, in nanoseconds.
const BOOTED_MAX: u64 = 5_000_000;
/// The highest clock reading at the start of an incarnation: a month.
const UPTIME_MAX: u64 = 30 * 24 * 3_600 * 1_000_000_000;

/// The clocks of the processes.
pub(super) struct Clocks {
    /// A separate source of random numbers, so clocks do not change the other events of a seed.
    chance: Chance,
    clocks: BTreeMap<usize, Clock>,
}

impl Clocks {
    pub(super) fn new(seed: u64) -> Self {
        Self { chance: Chance::new(!seed), clocks: BTreeMap::new() }
    }

    /// Starts an incarnation of a process: its host has booted, or it is another host, or its clock
    /// continues.
    pub(super) fn begin(&mut self, process: usize, now: Time) {
        let reading = match self.chance.index(3) {
            0 => 1 + self.chance.below(BOOTED_MAX - 1),
            1 if self.clocks.contains_key(&process) => return,
            _ => 1 + self.chance.below(UPTIME_MAX - 1),
        };
        let signed = |nanos: u64| i64::try_from(nanos).expect("a month, or the time of one seed");
        let ahead = signed(reading) - signed(now.as_nanos());
        self.clocks.insert(process, Clock::new(now, ahead, 0));
    }

    /// Returns the clock reading of a process at a time of the simulation.
    pub(super) fn read(&self, process: usize, at: Time) -> Time {
        self.clocks[&process].read(at)
    }
}

impl World {
    /// Returns the present clock reading of a process.
    pub(super) fn clock(&self, process: usize) -> Time {
        self.clocks.read(process, self.now)
    }

    /// Returns the time of a process's next timer, in the simulation's time, not before now. The clocks have
    /// no drift, so it is exact.
    pub(super) fn next_wake(&self, process: usize) -> Option<Time> {
        let wake = self.cores[process].next_wake()?;
        Some(self.now + wake.since(self.clock(process)))
    }
}
