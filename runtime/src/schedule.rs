//! The timers of one actor, as a pure table: due times, and lateness.

use std::{collections::BTreeMap, time::Duration};

use crate::time::Time;

/// The ID of one entry of a [`Schedule`].
///
/// # Examples
///
/// ```
/// use sinew::{prelude::*, time::TimerId};
///
/// struct Brake { release: Option<TimerId> }
/// # impl Actor for Brake { type Context = AppContext<Self>; }
///
/// impl Brake {
///     /// Releases the brake in 200 ms, whatever was planned before.
///     fn release_soon(&mut self, ctx: &mut AppContext<Self>) {
///         if let Some(timer) = self.release.take() {
///             ctx.cancel(timer);
///         }
///         self.release = Some(ctx.after(Duration::from_millis(200), |_, _, _| println!("released")));
///     }
/// }
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct TimerId(u64);

/// One firing of a timer.
///
/// # Examples
///
/// ```
/// use sinew::prelude::*;
///
/// struct Gait { missed: u64 }
/// # impl Actor for Gait { type Context = AppContext<Self>; }
///
/// fn begin(ctx: &mut AppContext<Gait>) {
///     ctx.every(Duration::from_millis(1), |gait, tick, _| {
///         gait.missed += tick.missed;
///         if tick.lateness > Duration::from_micros(500) {
///             eprintln!("turn {} is {:?} late", tick.number, tick.lateness);
///         }
///     });
/// }
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Tick {
    /// When the timer was due.
    pub scheduled: Time,
    /// Time from then to its firing.
    pub lateness: Duration,
    /// Number of periods without a firing of their own, because an earlier one took too long.
    pub missed: u64,
    /// The number of the firing, from 1.
    pub number: u64,
}

/// A table of timers, in the order in which they are due.
#[derive(Debug)]
pub struct Schedule<T> {
    entries: BTreeMap<(Time, TimerId), Entry<T>>,
    next_id: u64,
}

#[derive(Debug)]
struct Entry<T> {
    action: T,
    period: Option<Duration>,
    fired: u64,
}

/// A due entry, taken out of its schedule so that the action can borrow the schedule's owner.
#[derive(Debug)]
pub struct Due<T> {
    /// The action that is due.
    pub action: T,
    /// The due time and the lateness.
    pub tick: Tick,
    id: TimerId,
    entry: (Time, Option<Duration>),
}

impl<T> Due<T> {
    /// Returns the ID of the entry.
    #[must_use]
    pub const fn id(&self) -> TimerId {
        self.id
    }
}

impl<T> Default for Schedule<T> {
    fn default() -> Self {
        Self { entries: BTreeMap::new(), next_id: 0 }
    }
}

impl<T> Schedule<T> {
    /// Adds an action that is due once, at `at`.
    pub fn once(&mut self, at: Time, action: T) -> TimerId {
        self.insert(at, None, action)
    }

    /// Adds an action that is due at `first` and each `period` (at least 1 microsecond) after it.
    pub fn every(&mut self, first: Time, period: Duration, action: T) -> TimerId {
        self.insert(first, Some(period.max(Duration::from_micros(1))), action)
    }

    fn insert(&mut self, at: Time, period: Option<Duration>, action: T) -> TimerId {
        self.next_id += 1;
        let id = TimerId(self.next_id);
        self.entries.insert((at, id), Entry { action, period, fired: 0 });
        id
    }

    /// Removes an entry. Returns `false` if there is none: a one-time entry has fired, or the entry is firing now.
    pub fn cancel(&mut self, id: TimerId) -> bool {
        let key = self.entries.keys().find(|(_, other)| *other == id).copied();
        key.is_some_and(|key| self.entries.remove(&key).is_some())
    }

    /// Returns when the next entry is due.
    #[must_use]
    pub fn next_due(&self) -> Option<Time> {
        self.entries.first_key_value().map(|((at, _), _)| *at)
    }

    /// Takes the earliest entry that is due at `now`.
    pub fn take_due(&mut self, now: Time) -> Option<Due<T>> {
        if self.next_due()? > now {
            return None;
        }
        let ((scheduled, id), Entry { action, period, fired }) = self.entries.pop_first()?;
        let lateness = now.since(scheduled);
        let missed = period.map_or(0, |period| (lateness.as_nanos() / period.as_nanos()) as u64);
        let tick = Tick { scheduled, lateness, missed, number: fired + 1 };
        Some(Due { action, tick, id, entry: (scheduled, period) })
    }

    /// Moves periodic entries that are due by `now` to their next time on the grid after it. The skipped
    /// turns are neither repeated nor counted as missed. One-time entries stay due.
    pub fn skip_to(&mut self, now: Time) {
        let is_late = |at: &Time, entry: &Entry<T>| *at <= now && entry.period.is_some();
        let late: Vec<_> =
            self.entries.iter().filter(|((at, _), entry)| is_late(at, entry)).map(|(key, _)| *key).collect();
        for (at, id) in late {
            let Some(entry) = self.entries.remove(&(at, id)) else { continue };
            let period = entry.period.unwrap_or_default();
            let turns = now.since(at).as_nanos() / period.as_nanos().max(1) + 1;
            let next = at + period * u32::try_from(turns).unwrap_or(u32::MAX);
            self.entries.insert((next, id), entry);
        }
    }

    /// Puts a periodic entry back for its next turn, on the grid of its period. Missed turns are skipped, not
    /// repeated in a burst. A one-time entry is dropped.
    pub fn put_back(&mut self, due: Due<T>) {
        let (scheduled, Some(period)) = due.entry else { return };
        let turns = u32::try_from(due.tick.missed + 1).unwrap_or(u32::MAX);
        let next = scheduled + period * turns;
        self.entries.insert(
            (next, due.id),
            Entry { action: due.action, period: Some(period), fired: due.tick.number },
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const fn us(us: u64) -> Time {
        Time::from_nanos(us * 1_000)
    }

    #[test]
    fn late_tick_is_marked_and_the_grid_is_kept() {
        let mut schedule = Schedule::default();
        schedule.every(us(1_000), Duration::from_micros(1_000), ());
        let due = schedule.take_due(us(1_030)).unwrap();
        assert_eq!((due.tick.lateness, due.tick.missed), (Duration::from_micros(30), 0));
        schedule.put_back(due);
        assert_eq!(schedule.next_due(), Some(us(2_000)));
    }

    #[test]
    fn missed_periods_are_counted_and_not_repeated() {
        let mut schedule = Schedule::default();
        schedule.every(us(1_000), Duration::from_micros(1_000), ());
        let due = schedule.take_due(us(4_500)).unwrap();
        assert_eq!(due.tick.missed, 3);
        schedule.put_back(due);
        assert_eq!(schedule.next_due(), Some(us(5_000)));
        assert!(schedule.take_due(us(4_999)).is_none());
    }

    #[test]
    fn periods_keep_their_grid_after_a_pause() {
        let mut schedule = Schedule::default();
        schedule.every(us(1_000), Duration::from_micros(1_000), 'p');
        schedule.once(us(1_500), 'o');
        schedule.skip_to(us(4_500));
        let due = schedule.take_due(us(4_500)).unwrap();
        assert_eq!((due.action, due.tick.lateness), ('o', Duration::from_micros(3_000)));
        assert!(schedule.take_due(us(4_999)).is_none());
        let due = schedule.take_due(us(5_000)).unwrap();
        assert_eq!((due.action, due.tick.missed, due.tick.number), ('p', 0, 1));
    }

    #[test]
    fn cancelled_entry_never_fires() {
        let mut schedule = Schedule::default();
        let id = schedule.once(us(1), ());
        assert!(schedule.cancel(id));
        assert!(schedule.take_due(us(9)).is_none());
    }
}
