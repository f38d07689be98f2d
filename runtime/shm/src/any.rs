//! Waiting for messages of several consumers at once: one thread, one system call, until the first ring.

use std::{
    io,
    sync::atomic::{AtomicU32, Ordering},
    time::{Duration, Instant},
};

use crate::{
    bell::{BellState, Woken},
    consumer::Consumer,
    core::sleep::fence_before_recheck,
    error::AnyError,
    memory::fence,
    platform,
    spin::{Spin, Spinner},
    trust::Trust,
    wait::{HangUp, spin},
    wait_set::WaitSet,
};

/// The most consumers that one call waits for: the limit of the system.
pub const ENDS_MAX: usize = 128;

/// The most rings of a set of which a spinning thread reads the tails. A peer stores the tail first, so the message is
/// found earlier than by its report, which costs two more transfers of a cache line between the CPUs.
const TAILS_MAX: usize = 8;

/// Interval at which a sleeper checks whether the peers are still present: one call cannot wait for a futex
/// and a descriptor.
pub(crate) const HANG_UP_CHECK: Duration = Duration::from_millis(20);

/// Consumers that are waited for together, in an order that stays the same during the wait. Their bells are
/// futexes ([`BellKind::Futex`](crate::BellKind::Futex)), or all are of one [`WaitSet`].
pub trait Ends {
    /// Number of consumers; at most [`ENDS_MAX`].
    fn count(&self) -> usize;

    /// Returns the consumer at `index`, which is below [`count`](Self::count).
    fn consumer(&self, index: usize) -> &Consumer;

    /// Returns the consumer at `index`, which is below [`count`](Self::count).
    fn consumer_mut(&mut self, index: usize) -> &mut Consumer;

    /// Returns the descriptor that shows the end of the peer at `index`, if there is one.
    fn hang_up(&self, index: usize) -> Option<HangUp<'_>>;
}

/// The result of a wait for several consumers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Any {
    /// The consumer at this index has a message.
    Message(usize),
    /// Consumers of the [`WaitSet`] have messages: [`WaitSet::ready`]. After a spin they may be empty, if their
    /// messages were taken before they were reported.
    Ready,
    /// The peer at this index is gone, and its ring is empty.
    HungUp(usize),
    /// The deadline passed.
    TimedOut,
}

/// The longest poll of a reactor: between two polls its other tasks run.
const SLICE: Duration = Duration::from_micros(10);

/// The polling phase before a sleep in a reactor: [`Waiter::begin`].
#[derive(Debug)]
pub struct Polling {
    started: Instant,
    budget: Duration,
}

/// The result of a reactor's poll.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PollResult {
    /// A consumer has a message.
    Ready,
    /// No message; poll again.
    NotYet,
    /// No message; sleep.
    Idle,
}

impl Polling {
    /// Polls for 10 microseconds at most.
    pub fn poll(&self, ends: &mut impl Ends) -> PollResult {
        // Corrupt memory is reported when it is read.
        if check(ends).map_or(true, |found| found.is_some()) {
            return PollResult::Ready;
        }
        let left = self.budget.saturating_sub(self.started.elapsed());
        if left.is_zero() {
            return PollResult::Idle;
        }
        if spin(left.min(SLICE), || (0..ends.count()).any(|index| ends.consumer(index).has_moved())) {
            return PollResult::Ready;
        }
        PollResult::NotYet
    }
}

/// A thread that waits for several consumers: its spinning before a sleep, and the statistics for it.
#[derive(Debug)]
pub struct Waiter {
    spinner: Spinner,
    pub(crate) trust: Trust,
    set: Option<WaitSet>,
}

impl Waiter {
    /// Creates a waiter that spins as `spin` specifies before it sleeps.
    #[must_use]
    pub const fn new(spin: Spin) -> Self {
        Self { spinner: Spinner::new(spin), trust: Trust::new(), set: None }
    }

    /// Waits for consumers of this set from now on, and for no others.
    #[must_use]
    pub fn of_set(self, set: WaitSet) -> Self {
        Self { set: Some(set), ..self }
    }

    /// Checks the rings of a set one by one. Until then a message of a peer whose report was undone by another peer is
    /// not found if this side never sleeps; so this is to be called every 20 ms.
    ///
    /// # Errors
    /// [`AnyError::Corrupt`].
    pub fn check_all(&mut self, ends: &mut impl Ends) -> Result<(), AnyError> {
        if let Some(set) = self.set.clone() {
            self.find_unreported(&set, ends)?;
        }
        Ok(())
    }

    /// Waits until one of `ends` has a message, which stays there, or its peer is gone; until `deadline` at
    /// most. A deadline in the past means: check, and do not wait.
    ///
    /// For a [`WaitSet`] that costs one look and one sleep at one word, otherwise one at as many words.
    ///
    /// # Errors
    /// [`AnyError::Corrupt`] when a peer wrote values that no valid peer writes. [`AnyError::System`] when
    /// the system refused to wait, or one has no futex, or there are more than [`ENDS_MAX`].
    pub fn wait(&mut self, ends: &mut impl Ends, deadline: Instant) -> Result<Any, AnyError> {
        let mut left = deadline.saturating_duration_since(Instant::now());
        loop {
            let ended = self.wait_within(ends, left)?;
            left = deadline.saturating_duration_since(Instant::now());
            if ended != Any::TimedOut {
                return Ok(ended);
            }
            if left.is_zero() {
                return self.check_hang_ups(ends);
            }
        }
    }

    /// Same as [`wait`](Self::wait), for `left` at most. It may return [`Any::TimedOut`] early, without a
    /// reason: so it need not read the clock if a message is already present. For less than 20 ms it does not
    /// check whether a peer is gone, unless it is rung without a message: with many peers that costs more
    /// than the wait.
    ///
    /// # Errors
    /// As [`wait`](Self::wait).
    pub fn wait_within(&mut self, ends: &mut impl Ends, left: Duration) -> Result<Any, AnyError> {
        let budget = self.spinner.begin();
        if budget.is_zero() && !self.spinner.learns() {
            // The consumers are checked before the sleep.
            return self.sleep(ends, left);
        }
        if let Some(found) = self.find(ends)? {
            return Ok(found);
        }
        let started = self.spinner.learns().then(Instant::now);
        let ended = self.spin_or_sleep(ends, budget.min(left), left)?;
        if let Some(started) = started {
            self.spinner.learn(started.elapsed());
        }
        Ok(ended)
    }

    /// Starts a wait of a reactor, which sleeps by itself: the polling phase before the sleep. `None` if it
    /// must sleep at once.
    pub fn begin(&mut self) -> Option<Polling> {
        let budget = self.spinner.begin();
        let polls = !budget.is_zero() || self.spinner.learns();
        polls.then(|| Polling { started: Instant::now(), budget })
    }

    /// Ends the wait that began with this polling phase, whether it slept or not.
    pub fn end(&mut self, looking: &Polling) {
        if self.spinner.learns() {
            self.spinner.learn(looking.started.elapsed());
        }
    }

    fn spin_or_sleep(
        &mut self,
        ends: &mut impl Ends,
        budget: Duration,
        left: Duration,
    ) -> Result<Any, AnyError> {
        let count = ends.count();
        let many = self.set.as_ref().filter(|_| count > TAILS_MAX);
        let has_moved = || match many {
            Some(set) => set.has_reports(),
            None => (0..count).any(|index| ends.consumer(index).has_moved()),
        };
        if spin(budget, has_moved)
            && let Some(found) = self.find_moved(ends)?
        {
            return Ok(found);
        }
        self.sleep(ends, left.saturating_sub(budget))
    }

    /// Looks for a message.
    fn find(&self, ends: &mut impl Ends) -> Result<Option<Any>, AnyError> {
        match &self.set {
            Some(set) => Ok(set.look().then_some(Any::Ready)),
            None => Ok(check(ends)?.map(Any::Message)),
        }
    }

    /// The same after a spin: a message that a spin has found may not be reported yet.
    fn find_moved(&mut self, ends: &mut impl Ends) -> Result<Option<Any>, AnyError> {
        match self.set.clone() {
            Some(set) if ends.count() <= TAILS_MAX => {
                Ok(self.find_unreported(&set, ends)?.then_some(Any::Ready))
            }
            Some(_) | None => self.find(ends),
        }
    }

    pub(crate) fn check_hang_ups(&mut self, ends: &mut impl Ends) -> Result<Any, AnyError> {
        let Some(index) = hung_up(ends)? else { return Ok(Any::TimedOut) };
        // It may have published a message before.
        let found = match self.set.clone() {
            Some(set) => self.find_unreported(&set, ends)?.then_some(Any::Ready),
            None => check(ends)?.map(Any::Message),
        };
        Ok(found.unwrap_or(Any::HungUp(index)))
    }

    /// Sleeps once.
    fn sleep(&mut self, ends: &mut impl Ends, left: Duration) -> Result<Any, AnyError> {
        if let Some(set) = self.set.clone() {
            return self.sleep_for_set(&set, ends, left);
        }
        let woken = match sleep(ends, left.min(HANG_UP_CHECK))? {
            Slept::Ready(index) => return Ok(Any::Message(index)),
            Slept::Ended(woken) => woken,
        };
        // A message published before the end of the wait, or of the peer, is still received.
        if let Some(index) = check(ends)? {
            return Ok(Any::Message(index));
        }
        if woken == Woken::TimedOut && left < HANG_UP_CHECK {
            return Ok(Any::TimedOut);
        }
        // The peer may ring without a message because it leaves; or a nap is over.
        self.check_hang_ups(ends)
    }
}

/// The result of one sleep.
enum Slept {
    /// No sleep: the consumer at this index has a message.
    Ready(usize),
    Ended(Woken),
}

fn sleep(ends: &mut impl Ends, left: Duration) -> Result<Slept, AnyError> {
    let count = ends.count();
    if count > ENDS_MAX {
        return Err(AnyError::System(io::ErrorKind::InvalidInput.into()));
    }
    if left.is_zero() {
        return Ok(check(ends)?.map_or(Slept::Ended(Woken::TimedOut), Slept::Ready));
    }
    let seen = Words::read(ends, Consumer::bell_word)?;
    // Announced after the words were read: every ring from now on ends the sleep.
    for index in 0..count {
        ends.consumer_mut(index).announce();
    }
    fence_before_recheck();
    let slept = check(ends).and_then(|found| match found {
        Some(index) => Ok(Slept::Ready(index)),
        None => seen.sleep(ends, Consumer::bell_word, left).map(Slept::Ended),
    });
    for index in 0..count {
        ends.consumer_mut(index).withdraw();
    }
    slept
}

/// Words to sleep at, one of each consumer, with their values.
pub(crate) struct Words([BellState; ENDS_MAX]);

/// Returns the word of a consumer at which its peer wakes.
pub(crate) type WordOf = fn(&Consumer) -> Option<&AtomicU32>;

impl Words {
    /// Reads them.
    pub(crate) fn read(ends: &impl Ends, word_of: WordOf) -> Result<Self, AnyError> {
        if !(1..=ENDS_MAX).contains(&ends.count()) {
            return Err(no_word());
        }
        let mut seen = [BellState(0); ENDS_MAX];
        for (index, seen) in seen.iter_mut().enumerate().take(ends.count()) {
            *seen = BellState(word_of(ends.consumer(index)).ok_or_else(no_word)?.load(Ordering::Relaxed));
        }
        // SYNC: a ring that is seen here makes the stores before it visible: `FutexBell::ring`,
        // `ProducerCore::report_ring`.
        fence(Ordering::Acquire);
        Ok(Self(seen))
    }

    pub(crate) fn sleep(&self, ends: &impl Ends, word_of: WordOf, left: Duration) -> Result<Woken, AnyError> {
        if ends.count() == 1 {
            let word = word_of(ends.consumer(0)).ok_or_else(no_word)?;
            return platform::sleep_at(word, self.0[0], left).map_err(AnyError::System);
        }
        let mut futexes = platform::FutexSet::new();
        for (index, seen) in self.0.iter().enumerate().take(ends.count()) {
            futexes.add(word_of(ends.consumer(index)).ok_or_else(no_word)?, *seen);
        }
        futexes.sleep(left).map_err(AnyError::System)
    }
}

fn no_word() -> AnyError {
    AnyError::System(io::ErrorKind::InvalidInput.into())
}

fn check(ends: &mut impl Ends) -> Result<Option<usize>, AnyError> {
    for index in 0..ends.count() {
        if ends.consumer_mut(index).is_ready().map_err(|cause| AnyError::Corrupt { index, cause })? {
            return Ok(Some(index));
        }
    }
    Ok(None)
}

fn hung_up(ends: &impl Ends) -> Result<Option<usize>, AnyError> {
    let shown = || (0..ends.count()).filter_map(|index| ends.hang_up(index).map(|hang_up| (index, hang_up)));
    let gone = platform::which_ended(shown().map(|(_, hang_up)| hang_up)).map_err(AnyError::System)?;
    Ok(gone.and_then(|gone| shown().nth(gone)).map(|(index, _)| index))
}

#[cfg(all(test, target_os = "linux", not(any(loom, miri))))]
mod tests {
    use std::thread;

    use super::*;
    use crate::core::sleep::WakePlace;
    use crate::{Bell, BellKind, Capacity, CorruptError, Producer, Region, Terms, layout::Word};

    struct One(Consumer);

    impl Ends for One {
        fn count(&self) -> usize {
            1
        }

        fn consumer(&self, _: usize) -> &Consumer {
            &self.0
        }

        fn consumer_mut(&mut self, _: usize) -> &mut Consumer {
            &mut self.0
        }

        fn hang_up(&self, _: usize) -> Option<HangUp<'_>> {
            None
        }
    }

    #[test]
    fn invalid_tail_is_reported_with_its_peer() {
        // given
        let (mut hostile, offer) = Region::create(Capacity::MIN, BellKind::Futex).expect("a region");
        let (side, _offer) = Region::create(Capacity::MIN, BellKind::Futex).expect("a region");
        let (_producer, consumer) = side.connect(offer, &Terms::default()).expect("an honest offer");
        // when: a tail that is not a multiple of 8
        hostile.scribble(u32::try_from(Word::Tail.index()).expect("a small number"), 3);
        // then
        let ended = Waiter::new(Spin::Off).wait(&mut One(consumer), Instant::now() + Duration::from_secs(20));
        assert!(matches!(
            ended,
            Err(AnyError::Corrupt { index: 0, cause: CorruptError::Tail { tail: 3, seen: 0 } })
        ));
    }

    /// A peer that reports and rings in a page where nobody looks: each of its reports is lost.
    fn unheard_peer(set: &WaitSet) -> (One, Producer, (Producer, Consumer)) {
        let (side, mut offer) = Region::create(Capacity::MIN, Bell::Set(set.clone())).expect("a region");
        let (other, theirs) = Region::create(Capacity::MIN, BellKind::Futex).expect("a region");
        let elsewhere = WaitSet::create().expect("pages");
        let (_unheard, unheard) = Region::create(Capacity::MIN, Bell::Set(elsewhere)).expect("a region");
        offer.descriptors[1] = unheard.descriptors.into_iter().nth(1).expect("the shared page");
        let (back, consumer) = side.connect(theirs, &Terms::default()).expect("an honest offer");
        let (producer, forth) = other.connect(offer, &Terms::default()).expect("an honest offer");
        set.set_open(&consumer, true);
        (One(consumer), producer, (back, forth))
    }

    #[test]
    fn spinning_thread_finds_a_message_before_its_report() {
        let set = WaitSet::create().expect("pages");
        let (mut end, mut producer, _rest) = unheard_peer(&set);
        let long = Duration::from_secs(20);
        let mut waiter = Waiter::new(Spin::For(long)).of_set(set.clone());
        let started = Instant::now();
        thread::scope(|scope| {
            scope.spawn(|| producer.send(&[1]).expect("room"));
            assert!(matches!(waiter.wait_within(&mut end, long), Ok(Any::Ready)));
        });
        assert!(started.elapsed() < long, "the message is found during the spin");
        assert_eq!(set.only_ready(), end.0.slot());
    }

    #[test]
    fn sleeper_avoids_a_bell_that_lost_a_report() {
        // given
        let set = WaitSet::create().expect("pages");
        let (mut end, mut producer, _rest) = unheard_peer(&set);
        let mut waiter = Waiter::new(Spin::Off).of_set(set.clone());
        let until = Instant::now() + Duration::from_secs(20);
        let sleeps = |producer: &Producer| producer.peer_sleeps();
        for (number, wake_place) in [(1, WakePlace::Bell), (2, WakePlace::Own), (3, WakePlace::Own)] {
            assert_eq!(waiter.trust.wake_place(Instant::now), wake_place, "before message {number}");
            // when
            thread::scope(|scope| {
                scope.spawn(|| {
                    while !sleeps(&producer) {
                        assert!(Instant::now() < until, "waited for the sleep before message {number}");
                        thread::yield_now();
                    }
                    producer.send(&[number]).expect("room");
                });
                // then
                assert!(matches!(waiter.wait(&mut end, until), Ok(Any::Ready)), "message {number}");
            });
            assert!(set.is_ready(&end.0), "message {number}");
            drop(end.0.receive().expect("an honest peer").expect("a message"));
            set.was_emptied(&end.0);
        }
    }
}
