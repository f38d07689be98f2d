//! How many round trips, at which pace.

use std::{
    thread,
    time::{Duration, Instant},
};

use crate::Figures;

/// How round trips follow each other.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pace {
    /// The next one begins where one ends.
    BackToBack,
    /// A millisecond passes before each.
    EveryMillisecond,
}

impl Pace {
    /// Both.
    pub const ALL: [Self; 2] = [Self::BackToBack, Self::EveryMillisecond];

    /// As it stands in the benches' lines.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::BackToBack => "back_to_back",
            Self::EveryMillisecond => "1khz",
        }
    }

    /// The one with that name.
    ///
    /// # Panics
    /// If there is none: a bench reads the names that it wrote itself.
    #[must_use]
    pub fn named(name: &str) -> Self {
        let found = Self::ALL.into_iter().find(|pace| pace.name() == name);
        found.expect("a name that this program wrote itself")
    }

    /// What passes before each round trip.
    #[must_use]
    pub const fn pause(self) -> Duration {
        match self {
            Self::BackToBack => Duration::ZERO,
            Self::EveryMillisecond => Duration::from_millis(1),
        }
    }
}

/// How many round trips of how many bytes, at which pace.
#[derive(Clone, Copy, Debug)]
pub struct Rounds {
    /// What a message carries.
    pub bytes: usize,
    /// How they follow each other.
    pub pace: Pace,
    /// Not counted.
    pub warm_up: u32,
    /// Counted.
    pub counted: u32,
}

impl Rounds {
    /// As many as make a figure, fewer of what takes longer; a tenth of them in a short run.
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

    /// The times of these round trips.
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
