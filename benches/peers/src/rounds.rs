//! How many round trips, at which pace, and how a process hands their times to the one that prints them.

use std::{
    io::Write,
    thread,
    time::{Duration, Instant},
};

use sinew_figures::Figures;

/// No wait of this program is longer.
pub(crate) const DEADLINE: Duration = Duration::from_secs(60);

/// How round trips follow each other.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Pace {
    BackToBack,
    EveryMillisecond,
}

impl Pace {
    pub(crate) const ALL: [Self; 2] = [Self::BackToBack, Self::EveryMillisecond];

    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::BackToBack => "back_to_back",
            Self::EveryMillisecond => "1khz",
        }
    }

    pub(crate) const fn pause(self) -> Duration {
        match self {
            Self::BackToBack => Duration::ZERO,
            Self::EveryMillisecond => Duration::from_millis(1),
        }
    }
}

/// How many round trips of how many bytes, at which pace.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Rounds {
    pub(crate) bytes: usize,
    pub(crate) pace: Pace,
    /// Not counted.
    pub(crate) warm_up: u32,
    pub(crate) counted: u32,
}

impl Rounds {
    pub(crate) const fn of(bytes: usize, pace: Pace, is_short: bool) -> Self {
        let (warm_up, counted) = match pace {
            Pace::EveryMillisecond => (100, 3_000),
            Pace::BackToBack if bytes > 10_000 => (200, 4_000),
            Pace::BackToBack => (1_000, 20_000),
        };
        let part = if is_short { 10 } else { 1 };
        Self { bytes, pace, warm_up, counted: counted / part }
    }

    /// The times of these round trips.
    pub(crate) fn time(self, mut round_trip: impl FnMut()) -> Times {
        let mut times = Times::default();
        for round in 0..self.warm_up + self.counted {
            if !self.pace.pause().is_zero() {
                thread::sleep(self.pace.pause());
            }
            let start = Instant::now();
            round_trip();
            if round >= self.warm_up {
                times.0.push(start.elapsed());
            }
        }
        times
    }
}

/// The times of round trips, in the order in which they were made.
#[derive(Clone, Debug, Default)]
pub(crate) struct Times(pub(crate) Vec<Duration>);

impl Times {
    /// Prints them for the process that asked for them: nanoseconds, one a line.
    pub(crate) fn hand_over(&self) {
        let lines: String = self.0.iter().map(|time| format!("{}\n", time.as_nanos())).collect();
        std::io::stdout().write_all(lines.as_bytes()).expect("the process that asked for them reads");
    }

    /// What [`hand_over`](Self::hand_over) has printed; `None` if these are no such lines.
    pub(crate) fn taken(printed: &[u8]) -> Option<Figures> {
        let mut figures = Figures::new();
        for line in str::from_utf8(printed).ok()?.lines() {
            figures.record(Duration::from_nanos(line.parse().ok()?));
        }
        (figures.rounds() > 0).then_some(figures)
    }
}
