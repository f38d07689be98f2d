//! The pace of round trips.

use std::{
    thread,
    time::{Duration, Instant},
};

use sinew_figures::Figures;

/// The pace of round trips.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Pace {
    BackToBack,
    EveryMillisecond,
}

impl Pace {
    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::BackToBack => "back_to_back",
            Self::EveryMillisecond => "1khz",
        }
    }

    /// Numbers of round trips: uncounted warm-up, and measured.
    const fn rounds(self) -> (u32, u32) {
        match self {
            Self::BackToBack => (1_000, 20_000),
            Self::EveryMillisecond => (50, 1_500),
        }
    }

    /// The times of round trips at this pace.
    pub(crate) fn time(self, mut round_trip: impl FnMut()) -> Figures {
        let mut times = Figures::new();
        let (warm_up, rounds) = self.rounds();
        for round in 0..warm_up + rounds {
            if self == Self::EveryMillisecond {
                thread::sleep(Duration::from_millis(1));
            }
            let start = Instant::now();
            round_trip();
            let time = start.elapsed();
            if round >= warm_up {
                times.record(time);
            }
        }
        times
    }
}
