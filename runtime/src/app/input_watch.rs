//! Input watchdogs: when an input is silent, or too old. Pure.

use std::{fmt, time::Duration};

use crate::{
    tid::Tid,
    time::Time,
    wire::{Header, Kind},
};

/// The criterion by which an input watchdog judges.
///
/// # Examples
///
/// ```
/// use sinew::events::{InputCriterion, InputTimeout};
///
/// fn cause(timeout: &InputTimeout) -> &'static str {
///     match timeout.criterion {
///         InputCriterion::Arrival => "the sender, its node or the network is silent",
///         InputCriterion::Age if timeout.is_silent() => "no value arrives",
///         InputCriterion::Age => "values arrive too late",
///     }
/// }
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum InputCriterion {
    /// Arrival: each value that is handled feeds the watchdog, however old it is.
    Arrival,
    /// Age: a value feeds the watchdog until the value is as old as the limit. One of unknown age does not feed it.
    Age,
}

/// The report of an input watchdog: an input is silent, or its values are too old.
///
/// # Examples
///
/// ```
/// use sinew::prelude::*;
///
/// payload!("demo.setpoint", Stream => struct Setpoint { newton_metres: f32 });
///
/// struct Drive { newton_metres: f32 }
/// # impl Actor for Drive { type Context = AppContext<Self>; }
///
/// fn to_safe_state(drive: &mut Drive, timeout: InputTimeout, _: &mut AppContext<Drive>) {
///     drive.newton_metres = 0.0;
///     eprintln!("{timeout}; noticed {:?} late", timeout.lateness);
/// }
///
/// fn begin(ctx: &mut AppContext<Drive>) {
///     ctx.watch_input::<Setpoint>(None, Duration::from_millis(15), to_safe_state);
/// }
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct InputTimeout {
    /// The sender that the watchdog expects; `None`: any sender.
    pub source: Option<Tid>,
    /// The type that the watchdog expects.
    pub kind: Kind,
    /// The criterion of the watchdog.
    pub criterion: InputCriterion,
    /// The limit of the watchdog.
    pub limit: Duration,
    /// Time since a value arrived, or since the watchdog was set.
    pub silent: Duration,
    /// The maximum age that the value which arrived last can have now: its age plus the error of the age.
    /// `None` if its age is unknown, or if no value has arrived.
    pub age: Option<Duration>,
    /// Time from the limit to the detection of this timeout.
    pub lateness: Duration,
}

impl InputTimeout {
    /// Returns whether values fail to arrive. Otherwise they arrive, but are too old or of unknown age.
    #[must_use]
    pub fn is_silent(&self) -> bool {
        self.silent >= self.limit
    }
}

impl fmt::Display for InputTimeout {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.kind.type_name() {
            Some(name) => write!(f, "{name}")?,
            None => write!(f, "kind {}", self.kind)?,
        }
        if let Some(source) = self.source {
            write!(f, " from {source}")?;
        }
        match self.age {
            _ if self.is_silent() => write!(f, ": nothing has arrived for {:?}", self.silent)?,
            Some(age) => write!(f, ": values arrive too late, the newest may be {age:?} old")?,
            None => write!(f, ": values arrive, but their age is not known")?,
        }
        write!(f, " (limit {:?})", self.limit)
    }
}

/// One input watchdog.
#[derive(Clone, Copy, Debug)]
pub(super) struct InputWatch {
    source: Option<Tid>,
    kind: Kind,
    criterion: InputCriterion,
    limit: Duration,
    /// When the last value arrived, or when the watchdog was set.
    arrived: Time,
    /// The earliest time at which that value can have been sent, if it is known.
    sent: Option<Time>,
    /// The time from which the limit counts.
    fed: Time,
    /// Whether a timeout was reported and no value has fed the watchdog since.
    is_over: bool,
}

/// The result of a check of a watchdog.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum WatchCheck {
    /// The watchdog was fed; its next check is due at this time.
    DueAt(Time),
    /// The watchdog timed out.
    TimedOut(InputTimeout),
}

impl InputWatch {
    /// Creates a watchdog; its limit counts from `now`.
    pub(super) const fn new(
        source: Option<Tid>,
        kind: Kind,
        (criterion, limit): (InputCriterion, Duration),
        now: Time,
    ) -> Self {
        Self { source, kind, criterion, limit, arrived: now, sent: None, fed: now, is_over: false }
    }

    /// Records a message that is handled. Returns when to check the watchdog, if no check was scheduled until now.
    pub(super) fn note(&mut self, header: &Header, now: Time) -> Option<Time> {
        if self.kind != header.kind || self.source.is_some_and(|source| source != header.source) {
            return None;
        }
        (self.arrived, self.sent) = (now, header.age_at_most(now).map(|age| now - age));
        let fed = match self.criterion {
            InputCriterion::Arrival => Some(now),
            InputCriterion::Age => self.sent,
        };
        self.fed = self.fed.max(fed?);
        let is_fresh = self.criterion == InputCriterion::Arrival || self.deadline() > now;
        if !self.is_over || !is_fresh {
            return None;
        }
        self.is_over = false;
        Some(self.deadline())
    }

    /// Checks the watchdog at its due time.
    pub(super) fn check(&mut self, now: Time) -> WatchCheck {
        let deadline = self.deadline();
        if now < deadline {
            return WatchCheck::DueAt(deadline);
        }
        self.is_over = true;
        WatchCheck::TimedOut(InputTimeout {
            source: self.source,
            kind: self.kind,
            criterion: self.criterion,
            limit: self.limit,
            silent: now.since(self.arrived),
            age: self.sent.map(|sent| now.since(sent)),
            lateness: now.since(deadline),
        })
    }

    /// Resumes after a pause of this length: the limit counts as if the pause had not occurred.
    pub(super) fn resume(&mut self, pause: Duration) {
        self.arrived = self.arrived + pause;
        self.fed = self.fed + pause;
    }

    fn deadline(&self) -> Time {
        self.fed + self.limit
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::tid::{AppAddress, NodeAddress};

    const KIND: Kind = Kind::named("test.input_watch.angle");
    const LIMIT: Duration = Duration::from_millis(10);
    const BY_BOTH: [InputCriterion; 2] = [InputCriterion::Arrival, InputCriterion::Age];

    const fn ms(ms: u64) -> Time {
        Time::from_nanos(1_000_000_000 + ms * 1_000_000)
    }

    fn sender(app: u32) -> Tid {
        Tid::new(NodeAddress::new(1), AppAddress::new(app))
    }

    /// A value that is sent at `sent`; `error` is `None` while the clock of the sender's host is not
    /// measured.
    fn value(sent: Time, error: Option<Duration>) -> Header {
        let mut header = Header::new(KIND, sender(7), Tid::NONE);
        header.sent = sent;
        header.set_sent_error(error);
        header
    }

    fn watch(criterion: InputCriterion) -> InputWatch {
        InputWatch::new(None, KIND, (criterion, LIMIT), ms(0))
    }

    fn over(watch: &mut InputWatch, now: Time) -> InputTimeout {
        match watch.check(now) {
            WatchCheck::TimedOut(timeout) => timeout,
            WatchCheck::DueAt(at) => panic!("due at {at:?} only"),
        }
    }

    /// One value for each millisecond, each `late` after it was sent.
    fn stream(watch: &mut InputWatch, (from, to): (u64, u64), late: u64, error: Option<Duration>) {
        for at in from..to {
            watch.note(&value(ms(at - late), error), ms(at));
        }
    }

    #[test]
    fn silence_trips_either_watchdog_once() {
        for criterion in BY_BOTH {
            let mut watch = watch(criterion);
            assert_eq!(watch.check(ms(9)), WatchCheck::DueAt(ms(10)));
            let timeout = over(&mut watch, ms(11));
            assert_eq!((timeout.criterion, timeout.silent), (criterion, Duration::from_millis(11)));
            assert_eq!((timeout.age, timeout.lateness), (None, Duration::from_millis(1)));
            assert!(timeout.is_silent());
        }
    }

    #[test]
    fn late_values_trip_only_the_watchdog_by_age() {
        let [mut by_arrival, mut by_age] = BY_BOTH.map(watch);
        for watch in [&mut by_arrival, &mut by_age] {
            stream(watch, (15, 100), 15, Some(Duration::ZERO));
        }
        assert_eq!(by_arrival.check(ms(100)), WatchCheck::DueAt(ms(109)));
        let timeout = over(&mut by_age, ms(100));
        assert_eq!(timeout.criterion, InputCriterion::Age);
        assert_eq!(
            (timeout.silent, timeout.age),
            (Duration::from_millis(1), Some(Duration::from_millis(16)))
        );
        assert!(!timeout.is_silent());
        assert!(
            timeout.to_string().contains("values arrive too late, the newest may be 16ms old"),
            "{timeout}"
        );
    }

    #[test]
    fn values_within_the_limit_feed_the_watchdog_by_age() {
        let mut watch = watch(InputCriterion::Age);
        stream(&mut watch, (5, 50), 4, Some(Duration::from_millis(1)));
        // The last one was sent at 45, or 1 ms before.
        assert_eq!(watch.check(ms(50)), WatchCheck::DueAt(ms(54)));
        assert_eq!(over(&mut watch, ms(54)).age, Some(LIMIT));
    }

    #[test]
    fn clock_error_counts_as_age() {
        let mut watch = watch(InputCriterion::Age);
        stream(&mut watch, (5, 50), 4, Some(Duration::from_millis(7)));
        assert_eq!(over(&mut watch, ms(50)).age, Some(Duration::from_millis(12)));
    }

    #[test]
    fn unknown_age_trips_the_watchdog_by_age() {
        let [mut by_arrival, mut by_age] = BY_BOTH.map(watch);
        for watch in [&mut by_arrival, &mut by_age] {
            stream(watch, (1, 20), 1, Some(Duration::ZERO));
            stream(watch, (20, 40), 1, None);
        }
        assert_eq!(by_arrival.check(ms(40)), WatchCheck::DueAt(ms(49)));
        let timeout = over(&mut by_age, ms(40));
        assert_eq!((timeout.silent, timeout.age), (Duration::from_millis(1), None));
        assert!(timeout.to_string().contains("their age is not known"), "{timeout}");
        // It is reported once; then a fresh value of known age begins a new count.
        assert_eq!(by_age.note(&value(ms(40), None), ms(41)), None);
        assert_eq!(by_age.note(&value(ms(20), Some(Duration::ZERO)), ms(42)), None, "it is too old");
        assert_eq!(by_age.note(&value(ms(42), Some(Duration::ZERO)), ms(43)), Some(ms(52)));
        assert_eq!(by_age.note(&value(ms(43), Some(Duration::ZERO)), ms(44)), None, "a look is due already");
        assert_eq!(by_age.check(ms(52)), WatchCheck::DueAt(ms(53)));
    }

    #[test]
    fn other_types_and_senders_feed_no_watchdog() {
        let mut watch = InputWatch::new(Some(sender(8)), KIND, (InputCriterion::Arrival, LIMIT), ms(0));
        watch.note(&value(ms(5), Some(Duration::ZERO)), ms(5));
        let mut other = value(ms(5), Some(Duration::ZERO));
        (other.source, other.kind) = (sender(8), Kind::named("test.input_watch.other"));
        watch.note(&other, ms(5));
        assert_eq!(over(&mut watch, ms(10)).silent, LIMIT);
    }

    #[test]
    fn pause_is_no_silence() {
        for criterion in BY_BOTH {
            let mut watch = watch(criterion);
            watch.resume(Duration::from_secs(1));
            assert_eq!(watch.check(ms(1_009)), WatchCheck::DueAt(ms(1_010)));
        }
    }

    proptest! {
        /// For any arrivals, the watchdog by age is quiet exactly as long as a value is present that is
        /// certainly not older than the limit.
        #[test]
        fn fresh_value_keeps_the_watchdog_by_age_quiet(
            arrivals in prop::collection::vec((0..8u64, 0..20u64, prop::option::of(0..5u64)), 1..50),
        ) {
            let (mut watch, mut now) = (watch(InputCriterion::Age), 100);
            watch = InputWatch { arrived: ms(now), fed: ms(now), ..watch };
            // The earliest possible send time of the youngest value; at first the time when the watchdog was
            // set.
            let mut youngest = now;
            for (later, late, error) in arrivals {
                now += later;
                let is_over = matches!(watch.check(ms(now)), WatchCheck::TimedOut(_));
                prop_assert_eq!(is_over, now - youngest >= 10);
                watch.note(&value(ms(now - late), error.map(Duration::from_millis)), ms(now));
                if let Some(error) = error {
                    youngest = youngest.max(now - late - error);
                }
            }
        }
    }
}
