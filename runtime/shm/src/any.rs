//! Waiting for messages of several consumers at once: one thread, one system call, whoever rings first.

use std::{
    io,
    time::{Duration, Instant},
};

use crate::{
    bell::{Heard, Woken},
    consumer::Consumer,
    error::AnyError,
    platform,
    spin::{Spin, Spinner},
    wait::{Armed, HangUp, spin},
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

/// A thread that waits for several consumers: what it does before it sleeps, and what it has learned about that.
#[derive(Debug)]
pub struct Waiter {
    spinner: Spinner,
}

impl Waiter {
    /// One that spins as `spin` says before it sleeps.
    #[must_use]
    pub const fn new(spin: Spin) -> Self {
        Self { spinner: Spinner::new(spin) }
    }

    /// Waits until one of `ends` has a message, which is left there, or its peer is gone; until `deadline` at most. A
    /// deadline that is past means: look, and do not wait.
    ///
    /// # Errors
    /// [`AnyError::Corrupt`] when a peer wrote what no peer of ours writes, [`AnyError::System`] when the system refused
    /// to wait, or one has no futex, or there are more than [`ENDS_MAX`].
    pub fn wait(&mut self, ends: &mut impl Ends, deadline: Instant) -> Result<Any, AnyError> {
        if let Some(index) = look(ends)? {
            return Ok(Any::Message(index));
        }
        let started = self.spinner.learns().then(Instant::now);
        let ended = self.spin_or_sleep(ends, deadline)?;
        if let Some(started) = started {
            self.spinner.learn(started.elapsed());
        }
        Ok(ended)
    }

    fn spin_or_sleep(&mut self, ends: &mut impl Ends, deadline: Instant) -> Result<Any, AnyError> {
        if spin(self.spinner.begin(), || (0..ends.count()).any(|index| ends.consumer(index).has_moved()))
            && let Some(index) = look(ends)?
        {
            return Ok(Any::Message(index));
        }
        loop {
            let woken = match sleep(ends, deadline)? {
                Slept::Ready(index) => return Ok(Any::Message(index)),
                Slept::Ended(woken) => woken,
            };
            // What was published before the end of the wait, or of the peer, is still a message.
            if let Some(index) = look(ends)? {
                return Ok(Any::Message(index));
            }
            // Rung for nothing: the peer may ring because it goes.
            if let Some(index) = hung_up(ends)? {
                // It may have said something between the two looks.
                return Ok(look(ends)?.map_or(Any::HungUp(index), Any::Message));
            }
            if woken == Woken::TimedOut && Instant::now() >= deadline {
                return Ok(Any::TimedOut);
            }
        }
    }
}

/// How one sleep ended.
enum Slept {
    /// It did not begin: the one at this index has a message.
    Ready(usize),
    Ended(Woken),
}

fn sleep(ends: &mut impl Ends, deadline: Instant) -> Result<Slept, AnyError> {
    if ends.count() > ENDS_MAX {
        return Err(AnyError::System(io::ErrorKind::InvalidInput.into()));
    }
    let mut heard = [Heard(0); ENDS_MAX];
    for (index, heard) in heard.iter_mut().enumerate().take(ends.count()) {
        *heard = ends.consumer(index).message_bell().listen();
    }
    // Announced after the bells were listened to: whoever rings from now on is heard.
    if let Some(index) = announce(ends)? {
        return Ok(Slept::Ready(index));
    }
    let mut ears = platform::Ears::new();
    let are_futexes =
        (0..ends.count()).all(|index| ears.add(ends.consumer(index).message_bell(), heard[index]));
    let left = deadline.saturating_duration_since(Instant::now());
    let slept = if are_futexes {
        ears.sleep(left.min(HANG_UP_LOOK))
    } else {
        Err(io::ErrorKind::InvalidInput.into())
    };
    withdraw(ends, ends.count());
    Ok(Slept::Ended(slept.map_err(AnyError::System)?))
}

/// Announces sleep to all peers. One that has a message calls it off.
fn announce(ends: &mut impl Ends) -> Result<Option<usize>, AnyError> {
    for index in 0..ends.count() {
        let armed = ends.consumer_mut(index).arm();
        if !matches!(armed, Ok(Armed::Sleep)) {
            withdraw(ends, index);
        }
        match armed.map_err(|cause| AnyError::Corrupt { index, cause })? {
            Armed::Sleep => {}
            Armed::Ready => return Ok(Some(index)),
        }
    }
    Ok(None)
}

/// Says to the first `count` peers that this side is awake.
fn withdraw(ends: &mut impl Ends, count: usize) {
    for index in 0..count {
        ends.consumer_mut(index).disarm();
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

fn hung_up(ends: &impl Ends) -> Result<Option<usize>, AnyError> {
    let shown = || (0..ends.count()).filter_map(|index| ends.hang_up(index).map(|hang_up| (index, hang_up)));
    let gone = platform::which_ended(shown().map(|(_, hang_up)| hang_up)).map_err(AnyError::System)?;
    Ok(gone.and_then(|gone| shown().nth(gone)).map(|(index, _)| index))
}

#[cfg(all(test, target_os = "linux", not(any(loom, miri))))]
mod tests {
    use super::*;
    use crate::{BellKind, Capacity, Corrupt, Region, Terms, layout::Word};

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
}
