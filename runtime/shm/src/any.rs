//! Waiting for messages of several consumers at once: one thread, one system call, whoever rings first.

use std::{
    io, ptr,
    sync::atomic::{AtomicU32, Ordering},
    time::{Duration, Instant},
};

use crate::{
    bell::{Heard, Woken},
    consumer::Consumer,
    core::sleep::{Ear, fence_before_looking_again},
    error::AnyError,
    memory::fence,
    platform,
    spin::{Spin, Spinner},
    trust::Trust,
    wait::{HangUp, spin},
};

/// The most consumers that one call waits for: what the system takes.
pub const ENDS_MAX: usize = 128;

/// How often a sleeper looks whether the peers are still there: a futex and a descriptor cannot be waited for at once.
const HANG_UP_LOOK: Duration = Duration::from_millis(20);

/// Consumers that are waited for together, in an order that stays the same during the wait. Their bells are futexes
/// ([`BellKind::Futex`](crate::BellKind::Futex)).
pub trait Ends {
    /// How many there are; at most [`ENDS_MAX`].
    fn count(&self) -> usize;

    /// The one at `index`, which is below [`count`](Self::count).
    fn consumer(&self, index: usize) -> &Consumer;

    /// The one at `index`, which is below [`count`](Self::count).
    fn consumer_mut(&mut self, index: usize) -> &mut Consumer;

    /// How the end of the peer at `index` shows, if it does.
    fn hang_up(&self, index: usize) -> Option<HangUp<'_>>;
}

/// What a wait for several consumers ended with.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Any {
    /// The one at this index has a message.
    Message(usize),
    /// The peer at this index is gone, and nothing of it is left in its ring.
    HungUp(usize),
    /// The deadline passed.
    TimedOut,
}

/// The longest that a reactor looks at once: between two such looks others that it runs have their turn.
const SLICE: Duration = Duration::from_micros(10);

/// A look before a sleep that a reactor sleeps by itself: [`Waiter::begin`].
#[derive(Debug)]
pub struct Looking {
    started: Instant,
    budget: Duration,
}

/// What a reactor's look has found.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Looked {
    /// There is something.
    Something,
    /// There is nothing, and it is to look again.
    NotYet,
    /// There is nothing, and it is to sleep.
    Nothing,
}

impl Looking {
    /// Looks for 10 microseconds at most.
    pub fn look(&self, ends: &mut impl Ends) -> Looked {
        // Corrupt memory shows when it is read.
        if look(ends).map_or(true, |found| found.is_some()) {
            return Looked::Something;
        }
        let left = self.budget.saturating_sub(self.started.elapsed());
        if left.is_zero() {
            return Looked::Nothing;
        }
        if spin(left.min(SLICE), || (0..ends.count()).any(|index| ends.consumer(index).has_moved())) {
            return Looked::Something;
        }
        Looked::NotYet
    }
}

/// A thread that waits for several consumers: what it does before it sleeps, and what it has learned about that.
#[derive(Debug)]
pub struct Waiter {
    spinner: Spinner,
    trust: Trust,
}

impl Waiter {
    /// One that spins as `spin` says before it sleeps.
    #[must_use]
    pub const fn new(spin: Spin) -> Self {
        Self { spinner: Spinner::new(spin), trust: Trust::new() }
    }

    /// Waits until one of `ends` has a message, which is left there, or its peer is gone; until `deadline` at most. A
    /// deadline that is past means: look, and do not wait.
    ///
    /// Where all have one [`CommonBell`](crate::CommonBell) that costs one sleep at one word, else one at as many words.
    ///
    /// # Errors
    /// [`AnyError::Corrupt`] when a peer wrote what no peer of ours writes, [`AnyError::System`] when the system refused
    /// to wait, or one has no futex, or there are more than [`ENDS_MAX`].
    pub fn wait(&mut self, ends: &mut impl Ends, deadline: Instant) -> Result<Any, AnyError> {
        let mut left = deadline.saturating_duration_since(Instant::now());
        loop {
            let ended = self.wait_within(ends, left)?;
            left = deadline.saturating_duration_since(Instant::now());
            if ended != Any::TimedOut {
                return Ok(ended);
            }
            if left.is_zero() {
                return look_for_the_gone(ends);
            }
        }
    }

    /// As [`wait`](Self::wait), for `left` at most. It may say [`Any::TimedOut`] before, for no reason; so that it need not read
    /// the clock where something has come. For less than 20 ms it does not look whether a peer is gone, unless it is rung for nothing:
    /// where there are many peers that costs more than the wait.
    ///
    /// # Errors
    /// As [`wait`](Self::wait).
    pub fn wait_within(&mut self, ends: &mut impl Ends, left: Duration) -> Result<Any, AnyError> {
        let budget = self.spinner.begin();
        if budget.is_zero() && !self.spinner.learns() {
            // It is looked before the sleep.
            return self.sleep(ends, left);
        }
        if let Some(index) = look(ends)? {
            return Ok(Any::Message(index));
        }
        let started = self.spinner.learns().then(Instant::now);
        let ended = self.spin_or_sleep(ends, budget.min(left), left)?;
        if let Some(started) = started {
            self.spinner.learn(started.elapsed());
        }
        Ok(ended)
    }

    /// For a reactor, which sleeps by itself: the look before that. `None` if it is to sleep at once.
    pub fn begin(&mut self) -> Option<Looking> {
        let budget = self.spinner.begin();
        let looks = !budget.is_zero() || self.spinner.learns();
        looks.then(|| Looking { started: Instant::now(), budget })
    }

    /// The wait that began with this look is over, whether it slept or not.
    pub fn end(&mut self, looking: &Looking) {
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
        if spin(budget, || (0..ends.count()).any(|index| ends.consumer(index).has_moved()))
            && let Some(index) = look(ends)?
        {
            return Ok(Any::Message(index));
        }
        self.sleep(ends, left.saturating_sub(budget))
    }

    /// Sleeps once.
    fn sleep(&mut self, ends: &mut impl Ends, left: Duration) -> Result<Any, AnyError> {
        let ear = self.trust.ear(Instant::now);
        let woken = match sleep(ends, ear, left.min(HANG_UP_LOOK))? {
            Slept::Ready(index) => return Ok(Any::Message(index)),
            Slept::Ended(woken) => woken,
            Slept::Robbed => {
                self.trust.doubt(Instant::now());
                Woken::TimedOut
            }
        };
        // What was published before the end of the wait, or of the peer, is still a message.
        if let Some(index) = look(ends)? {
            return Ok(Any::Message(index));
        }
        if woken == Woken::TimedOut && left < HANG_UP_LOOK {
            return Ok(Any::TimedOut);
        }
        // Rung for nothing, the peer may ring because it goes; or a nap is over.
        look_for_the_gone(ends)
    }
}

/// How one sleep ended.
enum Slept {
    /// It did not begin: the one at this index has a message.
    Ready(usize),
    Ended(Woken),
    /// At its end, although a peer had rung: another one has undone that.
    Robbed,
}

/// Whether a peer has rung for the sleep that is over, and its bell is as it was before: who rings changes it first, and says that it
/// has rung afterwards.
fn has_been_robbed(ends: &impl Ends, heard: &Listened) -> bool {
    let was_rung = (0..ends.count()).any(|index| ends.consumer(index).was_rung());
    // SYNC: what a peer did before it said so is seen: `ProducerCore::say_rung`.
    fence(Ordering::Acquire);
    was_rung && heard.is_unchanged(ends)
}

fn sleep(ends: &mut impl Ends, ear: Ear, left: Duration) -> Result<Slept, AnyError> {
    let count = ends.count();
    if count > ENDS_MAX {
        return Err(AnyError::System(io::ErrorKind::InvalidInput.into()));
    }
    if left.is_zero() {
        return Ok(look(ends)?.map_or(Slept::Ended(Woken::TimedOut), Slept::Ready));
    }
    let heard = listen(ends, ear).ok_or_else(|| AnyError::System(io::ErrorKind::InvalidInput.into()))?;
    // Announced after the words were listened to: whoever rings from now on is heard.
    for index in 0..count {
        ends.consumer_mut(index).announce(ear);
    }
    fence_before_looking_again();
    let slept = look(ends).and_then(|found| match found {
        Some(index) => Ok(Slept::Ready(index)),
        None => match heard.sleep(ends, ear, left).map_err(AnyError::System)? {
            Woken::TimedOut if ear == Ear::Bell && has_been_robbed(ends, &heard) => Ok(Slept::Robbed),
            woken @ (Woken::Rung | Woken::TimedOut | Woken::HungUp) => Ok(Slept::Ended(woken)),
        },
    });
    for index in 0..count {
        ends.consumer_mut(index).withdraw();
    }
    slept
}

/// What was heard of the words that are slept at.
#[expect(clippy::large_enum_variant, reason = "it lies on the stack for one sleep, and is not moved")]
enum Listened {
    /// All have the same.
    One(Heard),
    Each([Heard; ENDS_MAX]),
}

/// `None` when one has no such word, or there are none.
fn listen(ends: &impl Ends, ear: Ear) -> Option<Listened> {
    let word = |index| (index < ends.count()).then(|| word_of(ends.consumer(index), ear)).flatten();
    let first = word(0)?;
    let listened = if (1..ends.count()).all(|index| word(index).is_some_and(|other| ptr::eq(other, first))) {
        Listened::One(Heard(first.load(Ordering::Relaxed)))
    } else {
        let mut heard = [Heard(0); ENDS_MAX];
        for (index, heard) in heard.iter_mut().enumerate().take(ends.count()) {
            *heard = Heard(word(index)?.load(Ordering::Relaxed));
        }
        Listened::Each(heard)
    };
    // SYNC: who heard a ring also sees what it was rung for: `FutexBell::ring`, `ProducerCore::say_rung`.
    fence(Ordering::Acquire);
    Some(listened)
}

fn word_of(consumer: &Consumer, ear: Ear) -> Option<&AtomicU32> {
    match ear {
        Ear::Bell => consumer.message_bell().word(),
        Ear::Own => Some(consumer.own_word()),
    }
}

impl Listened {
    /// Whether the one bell that all have has not been rung since.
    fn is_unchanged(&self, ends: &impl Ends) -> bool {
        match self {
            Self::One(heard) => word_of(ends.consumer(0), Ear::Bell)
                .is_some_and(|word| word.load(Ordering::Relaxed) == heard.0),
            // Each bell has one peer who can write it: that robs nobody else.
            Self::Each(_) => false,
        }
    }

    fn sleep(&self, ends: &impl Ends, ear: Ear, left: Duration) -> io::Result<Woken> {
        let no_word = || io::Error::from(io::ErrorKind::InvalidInput);
        match self {
            Self::One(heard) => {
                platform::sleep_at(word_of(ends.consumer(0), ear).ok_or_else(no_word)?, *heard, left)
            }
            Self::Each(heard) => {
                let mut ears = platform::Ears::new();
                for (index, heard) in heard.iter().enumerate().take(ends.count()) {
                    ears.add(word_of(ends.consumer(index), ear).ok_or_else(no_word)?, *heard);
                }
                ears.sleep(left)
            }
        }
    }
}

fn look(ends: &mut impl Ends) -> Result<Option<usize>, AnyError> {
    for index in 0..ends.count() {
        if ends.consumer_mut(index).is_ready().map_err(|cause| AnyError::Corrupt { index, cause })? {
            return Ok(Some(index));
        }
    }
    Ok(None)
}

fn look_for_the_gone(ends: &mut impl Ends) -> Result<Any, AnyError> {
    let Some(index) = hung_up(ends)? else { return Ok(Any::TimedOut) };
    // It may have said something before.
    Ok(look(ends)?.map_or(Any::HungUp(index), Any::Message))
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
    use crate::{Bell, BellKind, Capacity, CommonBell, Corrupt, Producer, Region, Terms, layout::Word};

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
    fn a_peer_that_writes_nonsense_is_named() {
        // given
        let (mut hostile, offer) = Region::create(Capacity::MIN, BellKind::Futex).expect("a region");
        let (side, _offer) = Region::create(Capacity::MIN, BellKind::Futex).expect("a region");
        let (_producer, consumer) = side.connect(offer, &Terms::default()).expect("an honest offer");
        // when: a tail that is no multiple of 8
        hostile.scribble(u32::try_from(Word::Tail.index()).expect("a small number"), 3);
        // then
        let ended = Waiter::new(Spin::Off).wait(&mut One(consumer), Instant::now() + Duration::from_secs(20));
        assert!(matches!(
            ended,
            Err(AnyError::Corrupt { index: 0, cause: Corrupt::Tail { tail: 3, seen: 0 } })
        ));
    }

    /// Its bells ring in a page that nobody listens to: each of its rings is robbed.
    fn robbed_peer(bell: &CommonBell) -> (One, Producer, (Producer, Consumer)) {
        let (side, mut offer) = Region::create(Capacity::MIN, Bell::Common(bell.clone())).expect("a region");
        let (other, theirs) = Region::create(Capacity::MIN, BellKind::Futex).expect("a region");
        let (_unheard, unheard) = Region::create(Capacity::MIN, BellKind::Futex).expect("a region");
        offer.descriptors.truncate(1);
        offer.descriptors.extend(unheard.descriptors.into_iter().skip(1));
        let (back, consumer) = side.connect(theirs, &Terms::default()).expect("an honest offer");
        let (producer, forth) = other.connect(offer, &Terms::default()).expect("an honest offer");
        (One(consumer), producer, (back, forth))
    }

    #[test]
    fn who_was_not_woken_by_a_ring_sleeps_where_nobody_can_take_a_ring_away() {
        // given
        let bell = CommonBell::create().expect("a page");
        let (mut end, mut producer, _rest) = robbed_peer(&bell);
        let (mut waiter, until) = (Waiter::new(Spin::Off), Instant::now() + Duration::from_secs(20));
        let sleeps = |producer: &Producer| producer.peer_sleeps();
        for (number, ear) in [(1, Ear::Bell), (2, Ear::Own), (3, Ear::Own)] {
            assert_eq!(waiter.trust.ear(Instant::now), ear, "before message {number}");
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
                assert!(matches!(waiter.wait(&mut end, until), Ok(Any::Message(0))), "message {number}");
            });
            end.0.receive().expect("an honest peer").expect("a message");
        }
    }
}
