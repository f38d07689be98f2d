//! An output that is safe unless good commands come.

use std::{
    io,
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{Arc, Mutex, MutexGuard, PoisonError, TryLockError, atomic::Ordering},
    time::Duration,
};

use bytes::Bytes;

use super::{
    ArmError, Cause, DataId, State, Tally,
    envelope::look,
    keeper::{self, Tried, Watch, Watched, rouse},
    raw::{NotSafe, Protected, Reads, Released, or_panics},
    receiver::{Opened, Receiver, Verdict},
    said::{Said, What},
};
use crate::{tid::Tid, time::Time, wire::Payload};

/// Time after which what makes an output safe is called again, where it has failed.
const SAFE_RETRY: Duration = Duration::from_millis(1);

/// The only way to an output of type `O`: commands pass while it is live, and it is made safe as soon as it is not.
///
/// Clones have the same output. When the last one is dropped (its application has ended) the output is made safe.
///
/// # Examples
///
/// ```
/// use sinew::{Tid, prelude::*, protection::{Cause, Guard, Protection, State}};
/// use sinew::serde::{Deserialize, Serialize};
///
/// #[derive(Serialize, Deserialize)]
/// #[serde(crate = "sinew::serde")]
/// struct Torque { newton_metres: f32 }
/// impl Payload for Torque {
///     const NAME: &'static str = "demo.torque";
///     const PROTECTION: Option<Protection> = Some(Protection::of_period(Duration::from_millis(5)));
/// }
///
/// // In an application it is made by `ctx.guard`, in a program apart by `Endpoint::guard`.
/// let (control, drive): (Tid, Tid) = ("10.0.0.2/1001".parse()?, "10.0.0.3/1001".parse()?);
/// let guard = Guard::new::<Torque>(control, drive, 0.0_f32, |motor, _| *motor = 0.0)?;
/// assert_eq!(guard.state(), State::Safe(Cause::NotArmed));
/// assert!(guard.apply(|motor| *motor = 3.0).is_err()); // nothing moves
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub struct Guard<O: Send + 'static> {
    /// Counts the clones, without the hold that a context has.
    owners: Arc<Owners<O>>,
}

struct Owners<O: Send + 'static>(Arc<Shared<O>>);

struct Shared<O> {
    data_id: DataId,
    inner: Mutex<Inner<O>>,
    watch: Arc<Watch>,
}

struct Inner<O> {
    data_id: DataId,
    receiver: Receiver,
    output: O,
    safe: MakeSafe<O>,
    owes: Option<Owed>,
    /// What is to be said when nobody has the output in hand any more.
    said: Option<Said>,
}

/// The output was to be made safe, and that has panicked, or says that it has failed.
#[derive(Clone, Copy)]
struct Owed {
    cause: Cause,
    /// When it is tried again: what comes meanwhile puts it off no further.
    retry: Time,
}

type MakeSafe<O> = Box<dyn FnMut(&mut O, Cause) -> Result<(), NotSafe> + Send>;

impl<O> Inner<O> {
    /// Lets the receiver change its mind, and makes the output safe if it did.
    fn let_decide<R>(&mut self, now: Time, decide: impl FnOnce(&mut Receiver) -> R) -> R {
        let before = self.receiver.state();
        let decided = decide(&mut self.receiver);
        if let (State::Live, State::Safe(cause)) = (before, self.receiver.state()) {
            self.make_safe(cause, now);
        }
        decided
    }

    fn make_safe(&mut self, cause: Cause, now: Time) {
        let Self { output, safe, owes, said, data_id: DataId { source, name, .. }, .. } = self;
        let (source, name) = (*source, *name);
        let is_news = owes.is_none();
        if matches!(catch_unwind(AssertUnwindSafe(|| safe(output, cause))), Ok(Ok(()))) {
            *owes = None;
            if cause != Cause::NotArmed && cause != Cause::Dropped {
                *said = Some(Said { source, name, cause, what: What::IsSafe });
            }
            return;
        }
        *owes = Some(Owed { cause, retry: now + SAFE_RETRY });
        if is_news {
            *said = Some(Said { source, name, cause, what: What::HasFailed });
        }
    }

    /// When the thread has to look.
    fn deadline(&self) -> u64 {
        let owed = self.owes.map(|owed| owed.retry);
        owed.or_else(|| self.receiver.deadline()).map_or(u64::MAX, Time::as_nanos)
    }
}

impl<O: Send + 'static> Guard<O> {
    /// The output of what `receiver` does with the values of type `P` from `source`, both absolute. `safe` is called with it now, and each
    /// time that it is not live any more: on the thread `safe-output`, on that of a message, or of whoever trips or drops the guard. It
    /// must be short and wait for nobody, as the outputs of all guards wait for it; of other guards it may [trip](Self::trip) any. One that
    /// panics is called again. The first guard of a process waits until that thread runs.
    ///
    /// # Errors
    /// The thread cannot be started, or this one has a real-time priority as high as that was granted, or higher: it would not run while this one hangs.
    pub fn new<P: Payload>(
        source: Tid,
        receiver: Tid,
        output: O,
        safe: impl FnMut(&mut O, Cause) + Send + 'static,
    ) -> io::Result<Self> {
        Self::of((source, receiver), Protected::of::<P>(), output, or_panics(safe))
    }

    /// The same for who knows the type at run time alone. `safe` says whether it has failed; then it is called again, as one that panics.
    ///
    /// # Errors
    /// Those of [`new`](Self::new), and that no good message would be needed to arm the output.
    #[doc(hidden)]
    pub fn of(
        (source, destination): (Tid, Tid),
        protected: Protected,
        output: O,
        safe: impl FnMut(&mut O, Cause) -> Result<(), NotSafe> + Send + 'static,
    ) -> io::Result<Self> {
        if protected.protection.good_min == 0 {
            let words = "an output is armed by good messages: `good_min` is at least 1";
            return Err(io::Error::new(io::ErrorKind::InvalidInput, words));
        }
        let data_id = DataId { source, destination, name: protected.name };
        let receiver = Receiver::new(protected.protection);
        let mut inner = Inner { data_id, receiver, output, safe: Box::new(safe), owes: None, said: None };
        inner.make_safe(Cause::NotArmed, Time::now());
        inner.said.take().into_iter().for_each(Said::log);
        let watch = Watch::new(inner.deadline(), inner.owes.is_some());
        let shared = Arc::new(Shared { data_id, inner: Mutex::new(inner), watch: Arc::new(watch) });
        let output: Arc<dyn Watched> = shared.clone();
        keeper::begun()?.keep(shared.watch.clone(), Arc::downgrade(&output));
        Ok(Self { owners: Arc::new(Owners(shared)) })
    }

    fn shared(&self) -> &Arc<Shared<O>> {
        &self.owners.0
    }

    /// Moves the output, if it is live.
    ///
    /// # Errors
    /// It is not, since this; it was not moved.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::protection::Guard;
    ///
    /// struct Motor { newton_metres: f32 }
    ///
    /// fn drive(guard: &Guard<Motor>, newton_metres: f32) {
    ///     if let Err(cause) = guard.apply(|motor| motor.newton_metres = newton_metres) {
    ///         eprintln!("not moved: {cause}");
    ///     }
    /// }
    /// ```
    pub fn apply<R>(&self, command: impl FnOnce(&mut O) -> R) -> Result<R, Cause> {
        self.shared().with(|inner| {
            self.shared().decide_locked(inner, |receiver, now| receiver.expire(now));
            match inner.receiver.state() {
                State::Live => Ok(command(&mut inner.output)),
                State::Safe(cause) => Err(cause),
            }
        })
    }

    /// Makes the output live: from now on commands pass. Somebody has seen that it is safe to; nothing does this by itself.
    ///
    /// # Errors
    /// Too few good messages have come, or the output could not be made safe.
    pub fn arm(&self) -> Result<(), ArmError> {
        self.shared().with(|inner| {
            self.shared().pay(inner, Time::now());
            if inner.owes.is_some() {
                return Err(ArmError::SafeFails);
            }
            let is_released = self.is_released();
            self.shared().decide_locked(inner, |receiver, now| {
                if is_released {
                    // Nothing that has come is good enough: who armed it was on the way when it was released.
                    receiver.trip(Cause::Dropped);
                }
                receiver.arm(now)
            })
        })?;
        // The thread sleeps, as there was no deadline.
        rouse();
        Ok(())
    }

    /// Makes the output safe: at once, or, while its application or another thread has it in hand, as soon as it has not.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::protection::Guard;
    ///
    /// /// The drive's own limit: a torque that the joint does not bear trips the output.
    /// fn check<O: Send>(guard: &Guard<O>, newton_metres: f32) {
    ///     if newton_metres.abs() > 40.0 {
    ///         guard.trip();
    ///     }
    /// }
    /// ```
    pub fn trip(&self) {
        self.shared().trip();
    }

    /// Whether commands pass.
    #[must_use]
    pub fn state(&self) -> State {
        self.shared().decide(|receiver, now| {
            receiver.expire(now);
            receiver.state()
        })
    }

    /// What has been counted.
    #[must_use]
    pub fn tally(&self) -> Tally {
        self.shared().lock().receiver.tally()
    }

    /// Takes in a message that has come.
    #[doc(hidden)]
    #[must_use]
    pub fn check(&self, sealed: &[u8], reads: Reads) -> Verdict<()> {
        let guarded: &dyn Guarded = &**self.shared();
        guarded.check(sealed, reads)
    }

    /// The time that the sender is to quote.
    #[doc(hidden)]
    #[must_use]
    pub fn echo(&self) -> Time {
        self.shared().echo()
    }

    /// Makes the output safe for good, as the drop of the last clone does, and says whether it is. Where it is not, that is tried on, and the guard is
    /// released as soon as it is.
    #[doc(hidden)]
    #[must_use]
    pub fn release(&self) -> Released {
        let shared = self.shared();
        shared.with(|inner| {
            if self.is_released() {
                return Released::Before;
            }
            shared.watch.is_to_go.store(true, Ordering::Release);
            shared.pay(inner, Time::now());
            shared.decide_locked(inner, |receiver, _| receiver.trip(Cause::Dropped));
            if self.is_released() { Released::Now } else { Released::NotSafe }
        })
    }

    /// The same for who may not wait, as he has an output in hand: trips the guard, which is released at once or, while somebody has its output in
    /// hand, as soon as nobody has, and the output is safe.
    #[doc(hidden)]
    pub fn release_later(&self) {
        let shared = self.shared();
        // SYNC: before the trip. Who makes the output live between the two finds it tripped, and who does so behind it that it is released.
        shared.watch.is_to_go.store(true, Ordering::Release);
        shared.trip();
    }

    /// Whether the output was to be made safe, and that has failed until now.
    #[doc(hidden)]
    #[must_use]
    pub fn is_owed(&self) -> bool {
        self.shared().watch.owes.load(Ordering::Acquire)
    }

    /// Whether it is released.
    #[doc(hidden)]
    #[must_use]
    pub fn is_released(&self) -> bool {
        self.shared().is_orphan()
    }

    /// What an application's context knows of it.
    pub(crate) fn guarded(&self) -> Arc<dyn Guarded> {
        self.shared().clone()
    }
}

impl<O: Send + 'static> Clone for Guard<O> {
    fn clone(&self) -> Self {
        Self { owners: self.owners.clone() }
    }
}

impl<O: Send + 'static> std::fmt::Debug for Guard<O> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Guard({:?})", self.shared().data_id)
    }
}

impl<O: Send + 'static> Drop for Owners<O> {
    fn drop(&mut self) {
        if self.0.is_orphan() {
            // It was released, and is safe for good. Whoever lets go of it waits for nobody: it may be somebody who trips another one.
            return;
        }
        self.0.decide(|receiver, _| receiver.trip(Cause::Dropped));
        self.0.watch.is_orphan.store(true, Ordering::Release);
        if self.0.watch.owes.load(Ordering::Acquire) {
            // Nobody else has it any more, and it is not safe yet.
            keeper::keep_owing(self.0.clone());
        }
    }
}

impl<O> Shared<O> {
    /// A command that panics has left its output as it is: the next one that is bad, late or missing makes it safe.
    fn lock(&self) -> MutexGuard<'_, Inner<O>> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn decide<R>(&self, decide: impl FnOnce(&mut Receiver, Time) -> R) -> R {
        self.with(|inner| self.decide_locked(inner, decide))
    }

    /// Has the output in hand, and says then what is to be said.
    fn with<R>(&self, step: impl FnOnce(&mut Inner<O>) -> R) -> R {
        let mut inner = self.lock();
        let result = step(&mut inner);
        let said = inner.said.take();
        drop(inner);
        said.into_iter().for_each(Said::log);
        result
    }

    /// Calls again what has failed.
    fn pay(&self, inner: &mut Inner<O>, now: Time) {
        let Some(Owed { cause, .. }) = inner.owes else { return };
        inner.make_safe(cause, now);
        self.let_go(inner);
    }

    /// Whoever is to go goes when it is safe.
    fn let_go(&self, inner: &Inner<O>) {
        let is_safe = inner.owes.is_none() && inner.receiver.state() != State::Live;
        if is_safe && self.watch.is_to_go.load(Ordering::Acquire) {
            self.watch.is_orphan.store(true, Ordering::Release);
        }
    }

    fn decide_locked<R>(&self, inner: &mut Inner<O>, decide: impl FnOnce(&mut Receiver, Time) -> R) -> R {
        let (now, asleep) = Time::now_and_asleep();
        let (is_tripped, owed) = (self.watch.is_tripped.swap(false, Ordering::AcqRel), inner.owes.is_some());
        let decided = inner.let_decide(now, |receiver| {
            receiver.has_slept(asleep);
            if is_tripped {
                receiver.trip(Cause::Tripped);
            }
            decide(receiver, now)
        });
        self.watch.deadline.store(inner.deadline(), Ordering::Release);
        self.watch.owes.store(inner.owes.is_some(), Ordering::Release);
        if inner.owes.is_some() && !owed {
            // The thread sleeps until the deadline that was, if there was any.
            rouse();
        }
        self.let_go(inner);
        decided
    }
}

/// A guard, whatever its output is, as its application's context sees it.
pub(crate) trait Guarded: Send + Sync {
    /// Who sends what to whom.
    fn data_id(&self) -> DataId;
    /// Whether nobody has the guard any more.
    fn is_orphan(&self) -> bool;
    /// Makes the output safe: at once, or as soon as nobody has it in hand.
    fn trip(&self);
    /// Takes in a message that is out of its envelope.
    fn judge(&self, opened: Opened) -> Verdict<()>;
    /// The time that the sender is to quote.
    fn echo(&self) -> Time;
    /// The one that it was told last.
    fn last_echo(&self) -> Time;
    /// Time between two of them.
    fn echo_period(&self) -> Duration;
}

impl dyn Guarded {
    /// Takes a message in. One that `read` makes no value of is a bad one. That is the user's code: the output's lock is not held meanwhile.
    pub(crate) fn take<T>(&self, bytes: &Bytes, read: impl FnOnce(Bytes) -> Option<T>) -> Verdict<T> {
        let (opened, value) = Opened::of(&self.data_id(), bytes, read);
        self.judge(opened).of(value)
    }

    /// The same of memory that is not to be kept.
    pub(crate) fn check(&self, sealed: &[u8], reads: Reads) -> Verdict<()> {
        let (opened, _) = Opened::read(look(&self.data_id(), sealed), |payload: &[u8]| {
            reads.is_value(payload).then_some(())
        });
        self.judge(opened)
    }
}

impl<O: Send + 'static> Guarded for Shared<O> {
    fn data_id(&self) -> DataId {
        self.data_id
    }

    fn is_orphan(&self) -> bool {
        self.watch.is_orphan.load(Ordering::Acquire)
    }

    fn trip(&self) {
        self.watch.is_tripped.store(true, Ordering::Release);
        match self.try_expire() {
            Tried::Held => rouse(),
            Tried::Done(said) => said.into_iter().for_each(Said::log),
        }
    }

    fn judge(&self, opened: Opened) -> Verdict<()> {
        self.decide(|receiver, now| receiver.take(now, opened))
    }

    fn echo(&self) -> Time {
        self.decide(|receiver, now| receiver.echo(now))
    }

    fn last_echo(&self) -> Time {
        self.lock().receiver.last_echo()
    }

    fn echo_period(&self) -> Duration {
        self.lock().receiver.echo_period()
    }
}

impl<O: Send + 'static> Watched for Shared<O> {
    fn try_expire(&self) -> Tried {
        let mut inner = match self.inner.try_lock() {
            Ok(inner) => inner,
            Err(TryLockError::Poisoned(poisoned)) => poisoned.into_inner(),
            Err(TryLockError::WouldBlock) => return Tried::Held,
        };
        self.pay(&mut inner, Time::now());
        self.decide_locked(&mut inner, |receiver, now| receiver.expire(now));
        Tried::Done(inner.said.take())
    }

    fn watch(&self) -> &Watch {
        &self.watch
    }
}

#[cfg(test)]
mod tests {
    use std::{
        sync::{
            atomic::AtomicBool,
            mpsc::{Receiver as Receives, sync_channel},
        },
        thread,
    };

    use super::*;
    use crate::{
        protection::Protection,
        tid::{AppAddress, NodeAddress},
    };

    /// Time after which a test that waits fails.
    const WATCHDOG: Duration = Duration::from_secs(30);

    #[derive(serde::Serialize, serde::Deserialize)]
    struct Torque;

    impl Payload for Torque {
        const NAME: &'static str = "test.guard.torque";
        const PROTECTION: Option<Protection> = Some(Protection::of_period(Duration::from_millis(20)));
    }

    #[test]
    fn messages_do_not_put_off_the_next_try_of_what_has_panicked() {
        let tid = |app| Tid::new(NodeAddress::new(7), AppAddress::new(app));
        let data_id = DataId { source: tid(1), destination: tid(2), name: "test.torque" };
        let receiver = Receiver::new(Protection::of_period(SAFE_RETRY));
        let safe = Box::new(|(): &mut (), _| panic!("a planted panic"));
        let mut inner = Inner { data_id, receiver, output: (), safe, owes: None, said: None };
        let begun = Time::from_nanos(1_000_000_000);
        inner.make_safe(Cause::Tripped, begun);
        let due = (begun + SAFE_RETRY).as_nanos();
        for tenth in 0..20 {
            let now = begun + SAFE_RETRY / 10 * tenth;
            inner.let_decide(now, |receiver| receiver.take(now, Opened::Corrupt));
            assert_eq!(inner.deadline(), due);
        }
    }

    fn output(app: u32, safe: impl FnMut(&mut (), Cause) + Send + 'static) -> Guard<()> {
        let tid = |app| Tid::new(NodeAddress::new(7), AppAddress::new(app));
        Guard::new::<Torque>(tid(1), tid(app), (), safe).expect("there is the thread")
    }

    /// An output that is due all the time, and is made safe as soon as it is allowed; says so then.
    fn due(app: u32) -> (Guard<()>, Arc<AtomicBool>, Receives<()>) {
        let (is_allowed, (done, is_done)) = (Arc::new(AtomicBool::new(false)), sync_channel(1));
        let (may, (tries, tried)) = (is_allowed.clone(), sync_channel(1));
        let guard = output(app, move |(), _| {
            let _ = tries.try_send(thread::current().name().map(str::to_owned));
            assert!(may.load(Ordering::Acquire), "a planted panic");
            let _ = done.try_send(());
        });
        // The thread has it from then on.
        while tried.recv_timeout(WATCHDOG).expect("it is tried").as_deref() != Some("safe-output") {}
        (guard, is_allowed, is_done)
    }

    #[test]
    fn an_output_is_made_safe_while_who_makes_a_guard_is_kept_from_going_on() {
        // given: an ordinary thread that was interrupted while it hands its guard to the thread
        let (_guard, is_allowed, is_done) = due(11);
        let interrupted = keeper::begun().expect("there is a guard").lock();
        // when
        is_allowed.store(true, Ordering::Release);
        // then
        is_done.recv_timeout(WATCHDOG).expect("it waits for no ordinary thread");
        drop(interrupted);
    }

    #[test]
    fn an_output_is_made_safe_while_who_holds_one_that_is_owed_is_kept_from_going_on() {
        // given: an output that nobody has any more, that is not safe, and that its application judges a message for
        let (_guard, is_allowed, is_done) = due(12);
        let is_paid = Arc::new(AtomicBool::new(false));
        let may = is_paid.clone();
        let orphan = output(13, move |(), _| assert!(may.load(Ordering::Acquire), "a planted panic"));
        let shared = orphan.shared().clone();
        drop(orphan);
        let interrupted = shared.lock();
        // when
        is_allowed.store(true, Ordering::Release);
        // then
        is_done.recv_timeout(WATCHDOG).expect("it waits for no ordinary thread");
        is_paid.store(true, Ordering::Release);
        drop(interrupted);
    }
}
