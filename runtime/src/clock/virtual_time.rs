//! A virtual clock: it stands still until its owner moves it, and then wakes what waits for that time.

use std::{
    collections::BTreeMap,
    sync::{
        Arc, Mutex,
        atomic::{AtomicU64, Ordering},
    },
    task::{Context, Waker},
};

use super::Clock;
use crate::{lock, time::Time};

/// A virtual clock, and the only way to move it.
///
/// Nothing moves it by itself: [`advance_to`](Self::advance_to) does. A caller runs all actors until none has work,
/// then moves the clock to [`next_wake`](Self::next_wake), and so on.
///
/// # Examples
///
/// ```
/// use std::time::Duration;
/// use sinew_runtime::{clock::VirtualTime, time::Time};
///
/// let time = VirtualTime::starting_at(Time::from_nanos(1_000));
/// let clock = time.clock();
/// time.advance_to(clock.now() + Duration::from_secs(3_600));
/// assert_eq!(clock.now(), Time::from_nanos(1_000) + Duration::from_secs(3_600));
/// assert_eq!(time.next_wake(), None);
/// ```
#[derive(Debug)]
pub struct VirtualTime(Arc<Shared>);

impl VirtualTime {
    /// Creates a clock that shows `start`.
    #[must_use]
    pub fn starting_at(start: Time) -> Self {
        let wake_ups = Mutex::new(Queue { waiting: BTreeMap::new(), next: 0 });
        Self(Arc::new(Shared { now_ns: AtomicU64::new(start.as_nanos()), wake_ups }))
    }

    /// Returns the clock for applications.
    #[must_use]
    pub fn clock(&self) -> Clock {
        Clock(Some(self.0.clone()))
    }

    /// Returns the current time of the clock.
    #[must_use]
    pub fn now(&self) -> Time {
        self.0.now()
    }

    /// Returns the time of the earliest wake-up; `None` if nothing waits.
    #[must_use]
    pub fn next_wake(&self) -> Option<Time> {
        lock(&self.0.wake_ups).waiting.first_key_value().map(|((at, _), _)| *at)
    }

    /// Moves the clock to `at`, never back, and wakes everything that is due then: in the order of the due
    /// times, and of their setting where these are equal. A caller that jumps over a wake-up makes it late.
    pub fn advance_to(&self, at: Time) {
        // SYNC: Release, with the Acquire in `now`: a thread that reads this time sees everything before it.
        self.0.now_ns.fetch_max(at.as_nanos(), Ordering::AcqRel);
        let now = self.0.now();
        while let Some(waker) = self.0.take_due(now) {
            waker.wake();
        }
    }
}

/// The state of a virtual clock.
#[derive(Debug)]
pub(super) struct Shared {
    now_ns: AtomicU64,
    /// One entry for each alarm and wake-up that is set, removed with its owner.
    wake_ups: Mutex<Queue>,
}

#[derive(Debug)]
struct Queue {
    waiting: BTreeMap<Key, Waker>,
    next: u64,
}

/// The due time, and the number of the entry: equal times keep the order in which they were set.
type Key = (Time, u64);

impl Shared {
    #[inline]
    pub(super) fn now(&self) -> Time {
        // SYNC: Acquire, with the Release in `advance_to`.
        Time::from_nanos(self.now_ns.load(Ordering::Acquire))
    }

    fn insert(&self, at: Time, waker: Waker) -> Key {
        let mut queue = lock(&self.wake_ups);
        let key = (at, queue.next);
        queue.next += 1;
        queue.waiting.insert(key, waker);
        key
    }

    fn remove(&self, key: Key) {
        let removed = lock(&self.wake_ups).waiting.remove(&key);
        // A waker is foreign code: it is dropped without the lock.
        drop(removed);
    }

    /// Returns whether the entry is still there, for this waker.
    fn holds(&self, key: Key, waker: &Waker) -> bool {
        lock(&self.wake_ups).waiting.get(&key).is_some_and(|own| own.will_wake(waker))
    }

    fn take_due(&self, now: Time) -> Option<Waker> {
        let mut queue = lock(&self.wake_ups);
        let first = queue.waiting.first_entry()?;
        (first.key().0 <= now).then(|| first.remove())
    }
}

/// The alarm of a task on a virtual clock.
#[derive(Debug)]
pub(crate) struct VirtualAlarm {
    shared: Arc<Shared>,
    set: Option<Key>,
}

impl VirtualAlarm {
    pub(super) const fn new(shared: Arc<Shared>) -> Self {
        Self { shared, set: None }
    }

    /// Wakes the task at `at`, or now if that has passed; never if `at` is `None`.
    pub(super) fn wake_at(&mut self, at: Option<Time>, task: &Context<'_>) {
        if let (Some(key), Some(at)) = (self.set, at)
            && key.0 == at
            && self.shared.holds(key, task.waker())
        {
            return;
        }
        self.clear();
        match at {
            Some(at) if at <= self.shared.now() => task.waker().wake_by_ref(),
            Some(at) => self.set = Some(self.shared.insert(at, task.waker().clone())),
            None => {}
        }
    }

    fn clear(&mut self) {
        self.set.take().into_iter().for_each(|key| self.shared.remove(key));
    }
}

impl Drop for VirtualAlarm {
    fn drop(&mut self) {
        self.clear();
    }
}

/// A wake-up on a virtual clock that any thread may set, for code that is no task: the deadline of a guarded
/// output.
#[derive(Debug)]
pub(crate) struct WakeUp {
    shared: Arc<Shared>,
    waker: Waker,
    set: Mutex<Option<Key>>,
}

impl WakeUp {
    pub(super) const fn new(shared: Arc<Shared>, waker: Waker) -> Self {
        Self { shared, waker, set: Mutex::new(None) }
    }

    /// Calls the waker at `at`; never if it is `None`. A time that has passed is due at the next move of the clock.
    pub(crate) fn set(&self, at: Option<Time>) {
        let mut set = lock(&self.set);
        if set.map(|(at, _)| at) == at && set.is_some_and(|key| self.shared.holds(key, &self.waker)) {
            return;
        }
        set.take().into_iter().for_each(|key| self.shared.remove(key));
        *set = at.map(|at| self.shared.insert(at, self.waker.clone()));
    }
}

impl Drop for WakeUp {
    fn drop(&mut self) {
        self.set(None);
    }
}

#[cfg(test)]
mod tests {
    use std::{sync::atomic::AtomicUsize, task::Wake, time::Duration};

    use super::*;

    const fn ms(ms: u64) -> Time {
        Time::from_nanos(ms * 1_000_000)
    }

    /// Notes the order of wakes, in one number: the digits of those that were woken.
    struct Digit(usize, Arc<AtomicUsize>);

    impl Wake for Digit {
        fn wake(self: Arc<Self>) {
            let _ = self.1.fetch_update(Ordering::Relaxed, Ordering::Relaxed, |all| Some(all * 10 + self.0));
        }
    }

    fn digits() -> (Arc<AtomicUsize>, impl Fn(usize) -> Waker) {
        let all = Arc::new(AtomicUsize::new(0));
        let own = all.clone();
        (all, move |digit| Waker::from(Arc::new(Digit(digit, own.clone()))))
    }

    #[test]
    fn wakes_are_ordered_by_time_then_by_setting() {
        let time = VirtualTime::starting_at(ms(1));
        let (woken, waker) = digits();
        let clock = time.clock();
        let wake_ups: Vec<_> = [(1, 9), (2, 5), (3, 5), (4, 20)]
            .into_iter()
            .map(|(digit, at)| {
                let wake_up = clock.wake_up(|| waker(digit)).expect("the clock is virtual");
                wake_up.set(Some(ms(at)));
                wake_up
            })
            .collect();
        assert_eq!(time.next_wake(), Some(ms(5)));
        time.advance_to(ms(4));
        assert_eq!((woken.load(Ordering::Relaxed), clock.now()), (0, ms(4)));
        time.advance_to(ms(9));
        assert_eq!((woken.load(Ordering::Relaxed), time.next_wake()), (231, Some(ms(20))));
        drop(wake_ups);
        assert_eq!(time.next_wake(), None, "a wake-up ends with its owner");
    }

    #[test]
    fn alarm_that_is_set_again_has_one_entry() {
        let time = VirtualTime::starting_at(ms(1));
        let (woken, waker) = digits();
        let mut alarm = time.clock().alarm().expect("a virtual clock has no descriptor");
        let (one, other) = (waker(1), waker(2));
        alarm.wake_at(Some(ms(5)), &mut Context::from_waker(&one)).expect("no kernel");
        alarm.wake_at(Some(ms(5)), &mut Context::from_waker(&other)).expect("no kernel");
        alarm.wake_at(Some(ms(7)), &mut Context::from_waker(&other)).expect("no kernel");
        time.advance_to(ms(7));
        assert_eq!((woken.load(Ordering::Relaxed), time.next_wake()), (2, None));
        alarm.wake_at(Some(ms(7)), &mut Context::from_waker(&one)).expect("no kernel");
        assert_eq!(woken.load(Ordering::Relaxed), 21, "a time that has passed wakes now");
    }

    #[test]
    fn clocks_of_one_process_are_independent() {
        let (one, other) = (VirtualTime::starting_at(ms(1)), VirtualTime::starting_at(ms(1)));
        one.advance_to(ms(1) + Duration::from_secs(60));
        assert_eq!((other.now(), other.clock().now()), (ms(1), ms(1)));
        one.advance_to(ms(2));
        assert_eq!(one.now(), ms(1) + Duration::from_secs(60), "it never moves back");
    }
}
