//! Number and pace of round trips.

use std::{
    thread,
    time::{Duration, Instant},
};

use crate::Figures;

/// Pace of round trips.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pace {
    /// The next round trip starts as soon as the previous one ends.
    BackToBack,
    /// Each round trip is preceded by a pause of one millisecond.
    EveryMillisecond,
}

impl Pace {
    /// Both variants.
    pub const ALL: [Self; 2] = [Self::BackToBack, Self::EveryMillisecond];

    /// The name used in the output of the benches.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::BackToBack => "back_to_back",
            Self::EveryMillisecond => "1khz",
        }
    }

    /// The variant with this name.
    ///
    /// # Panics
    /// If there is none: a bench reads only names that it wrote itself.
    #[must_use]
    pub fn named(name: &str) -> Self {
        let found = Self::ALL.into_iter().find(|pace| pace.name() == name);
        found.expect("a name that this program wrote itself")
    }

    /// The pause before each round trip.
    #[must_use]
    pub const fn pause(self) -> Duration {
        match self {
            Self::BackToBack => Duration::ZERO,
            Self::EveryMillisecond => Duration::from_millis(1),
        }
    }
}

/// Number of round trips, payload size and pace.
#[derive(Clone, Copy, Debug)]
pub struct Rounds {
    /// Payload of a message, in bytes.
    pub bytes: usize,
    /// Pace of the round trips.
    pub pace: Pace,
    /// Round trips that are not recorded.
    pub warm_up: u32,
    /// Round trips that are recorded.
    pub counted: u32,
}

impl Rounds {
    /// Enough round trips for a stable figure, fewer for slow cases, and a tenth of them in a short run.
    #[must_use]
    pub const fn of(bytes: usize, pace: Pace, is_short: bool) -> Self {
        let (warm_up, counted) = match pace {
            Pace::EveryMillisecond if bytes == 1_000 => (100, 3_000),
            Pace::EveryMillisecond => (50, 300),
            Pace::BackToBack if bytes > 100_000 => (50, 500),
            Pace::BackToBack if bytes > 10_000 => (200, 4_000),
            Pace::BackToBack => (1_000, 20_000),
        };
        let part = if is_short { 10 } else { 1 };
        Self { bytes, pace, warm_up, counted: counted / part }
    }

    /// Runs these round trips and returns their times.
    pub fn time(self, mut round_trip: impl FnMut()) -> Figures {
        let mut times = Figures::new();
        for round in 0..self.warm_up + self.counted {
            if !self.pace.pause().is_zero() {
                thread::sleep(self.pace.pause());
            }
            let start = Instant::now();
            round_trip();
            let time = start.elapsed();
            if round >= self.warm_up {
                times.record(time);
            }
        }
        times
    }
}
