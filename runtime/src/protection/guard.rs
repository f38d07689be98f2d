//! A guarded output, which is safe unless good commands arrive.

mod arming;
mod dry_run;
mod guarded;
#[cfg(test)]
mod stop_tests;
#[cfg(test)]
mod tests;
mod virtual_deadline;

use std::{
    io,
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{Arc, Mutex, MutexGuard, PoisonError, TryLockError, atomic::Ordering},
    time::Duration,
};

use self::dry_run::DryRun;
pub(crate) use self::guarded::Guarded;
use super::{
    ArmError, Cause, DataId, State, Tally,
    log_queue::{LogEntry, OutputEvent},
    raw::{NotSafeError, Protected, Reads, Released, or_panics},
    receiver::{Opened, Receiver, Verdict},
    safe_output::{self, CheckResult, WatchState, WatchedOutput, wake},
    stop_latch::StopLatch,
};
use crate::{
    clock::{Clock, WakeUp},
    tid::Tid,
    time::Time,
    wire::Payload,
};

/// Time after which a failed safe function is called again.
const SAFE_RETRY: Duration = Duration::from_millis(1);

/// The only access to an output of type `O`: commands pass while it is live, and it is made safe as soon as
/// it is not.
///
/// Clones share the output. When the last one is dropped (its application has ended) the output is made safe.
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
    /// Counts the clones, without the reference that a context keeps.
    owners: Arc<Owners<O>>,
}

struct Owners<O: Send + 'static>(Arc<Shared<O>>);

struct Shared<O> {
    data_id: DataId,
    inner: Mutex<Inner<O>>,
    watch: Arc<WatchState>,
    clock: Clock,
    /// Makes the output safe at its deadline on a virtual clock; `None`: the thread `safe-output` does.
    wake_up: Option<WakeUp>,
}

struct Inner<O> {
    data_id: DataId,
    receiver: Receiver,
    output: O,
    safe: MakeSafe<O>,
    retry: Option<SafeRetry>,
    /// The dry run that has not ended yet.
    dry_run: Option<DryRun>,
    /// The log entry to write after the lock is released.
    log_entry: Option<LogEntry>,
}

/// A safe function that has panicked or reported a failure.
#[derive(Clone, Copy)]
struct SafeRetry {
    cause: Cause,
    /// When it is called again: other events do not delay this time.
    at: Time,
}

type MakeSafe<O> = Box<dyn FnMut(&mut O, Cause) -> Result<(), NotSafeError> + Send>;

impl<O> Inner<O> {
    /// Lets the receiver change its state, and makes the output safe if it is no longer live.
    fn let_decide<R>(&mut self, now: Time, decide: impl FnOnce(&mut Receiver) -> R) -> R {
        let before = self.receiver.state();
        let decided = decide(&mut self.receiver);
        if let (State::Live, State::Safe(cause)) = (before, self.receiver.state()) {
            self.make_safe(cause, now);
        }
        decided
    }

    fn make_safe(&mut self, cause: Cause, now: Time) {
        let Self { output, safe, retry, log_entry, data_id: DataId { source, name, .. }, .. } = self;
        let (source, name) = (*source, *name);
        let is_first_failure = retry.is_none();
        if matches!(catch_unwind(AssertUnwindSafe(|| safe(output, cause))), Ok(Ok(()))) {
            *retry = None;
            if cause != Cause::NotArmed && cause != Cause::Dropped {
                *log_entry = Some(LogEntry { source, name, cause, event: OutputEvent::MadeSafe });
            }
            return;
        }
        *retry = Some(SafeRetry { cause, at: now + SAFE_RETRY });
        if is_first_failure {
            *log_entry = Some(LogEntry { source, name, cause, event: OutputEvent::SafeFailed });
        }
    }

    /// Returns when the thread `safe-output` must check the output.
    fn deadline(&self) -> u64 {
        let retry_at = self.retry.map(|retry| retry.at);
        let deadline = retry_at.or_else(|| self.receiver.deadline());
        deadline.or_else(|| self.dry_run.map(DryRun::ends)).map_or(u64::MAX, Time::as_nanos)
    }
}

impl<O: Send + 'static> Guard<O> {
    /// Creates the guard of an output that values of type `P` from `source` to `receiver`, both absolute,
    /// control. `safe` is called with the output now, and each time that it is no longer live. It runs on the
    /// thread `safe-output`, on the thread that handles a message, or on the one that trips or drops the
    /// guard. It must be short and must not block, as the outputs of all guards wait for it; it may
    /// [trip](Self::trip) any other guard. If it panics, it is called again. The first guard of a process
    /// waits until that thread runs.
    ///
    /// # Errors
    /// The thread cannot be started, or the real-time priority of the calling thread is not below the one
    /// that was granted to it. That thread would then not run while the calling one hangs.
    pub fn new<P: Payload>(
        source: Tid,
        receiver: Tid,
        output: O,
        safe: impl FnMut(&mut O, Cause) + Send + 'static,
    ) -> io::Result<Self> {
        Self::of((source, receiver), Protected::of::<P>(), output, or_panics(safe))
    }

    /// Same as [`new`](Self::new), for a type that is known at run time only. `safe` returns whether it has
    /// failed; then it is called again, as after a panic.
    ///
    /// # Errors
    /// The errors of [`new`](Self::new). Also if the protection requires no good message before the output is
    /// armed.
    #[doc(hidden)]
    pub fn of(
        (source, destination): (Tid, Tid),
        protected: Protected,
        output: O,
        safe: impl FnMut(&mut O, Cause) -> Result<(), NotSafeError> + Send + 'static,
    ) -> io::Result<Self> {
        let node = (&Clock::WALL, &Arc::default());
        Self::of_on(node, (source, destination), protected, output, safe)
    }

    /// Same as [`new`](Self::new), on the clock of an application and with the stop of its node. On a virtual clock
    /// the thread `safe-output` is not used: `safe` is called when that clock reaches the deadline.
    pub(crate) fn new_on<P: Payload>(
        node: (&Clock, &Arc<StopLatch>),
        ends: (Tid, Tid),
        output: O,
        safe: impl FnMut(&mut O, Cause) + Send + 'static,
    ) -> io::Result<Self> {
        Self::of_on(node, ends, Protected::of::<P>(), output, or_panics(safe))
    }

    fn of_on(
        (clock, stop): (&Clock, &Arc<StopLatch>),
        (source, destination): (Tid, Tid),
        protected: Protected,
        output: O,
        safe: impl FnMut(&mut O, Cause) -> Result<(), NotSafeError> + Send + 'static,
    ) -> io::Result<Self> {
        if protected.protection.good_min == 0 {
            let words = "an output is armed by good messages: `good_min` is at least 1";
            return Err(io::Error::new(io::ErrorKind::InvalidInput, words));
        }
        let data_id = DataId { source, destination, name: protected.name };
        let receiver = Receiver::new(protected.protection);
        let safe = Box::new(safe);
        let mut inner =
            Inner { data_id, receiver, output, safe, retry: None, dry_run: None, log_entry: None };
        inner.make_safe(Cause::NotArmed, clock.now());
        inner.log_entry.take().into_iter().for_each(LogEntry::log);
        let deadline = inner.deadline();
        let watch = {
            let stop = (stop.clone(), destination);
            WatchState::new(deadline, inner.retry.is_some(), stop, protected.protection)
        };
        let watch = Arc::new(watch);
        let shared = Arc::new_cyclic(|output| Shared {
            data_id,
            inner: Mutex::new(inner),
            watch,
            clock: clock.clone(),
            wake_up: clock.wake_up(|| virtual_deadline::waker(output.clone())),
        });
        if shared.wake_up.is_some() {
            shared.set_deadline(deadline);
        } else {
            let output: Arc<dyn WatchedOutput> = shared.clone();
            safe_output::started()?.watch(data_id, shared.watch.clone(), Arc::downgrade(&output));
        }
        Ok(Self { owners: Arc::new(Owners(shared)) })
    }

    fn shared(&self) -> &Arc<Shared<O>> {
        &self.owners.0
    }

    /// Applies a command to the output, if it is live.
    ///
    /// # Errors
    /// The output is safe for this cause; the command was not applied.
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

    /// Makes the output safe: at once, or as soon as the application or thread that holds its lock releases it.
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

    /// Returns whether commands pass.
    #[must_use]
    pub fn state(&self) -> State {
        self.shared().decide(|receiver, now| {
            receiver.expire(now);
            receiver.state()
        })
    }

    /// Returns the counters.
    #[must_use]
    pub fn tally(&self) -> Tally {
        self.shared().lock().receiver.tally()
    }

    /// Checks a received message.
    #[doc(hidden)]
    #[must_use]
    pub fn check(&self, sealed: &[u8], reads: Reads) -> Verdict<()> {
        let guarded: &dyn Guarded = &**self.shared();
        guarded.check(sealed, reads)
    }

    /// Returns the time that the sender must quote.
    #[doc(hidden)]
    #[must_use]
    pub fn echo(&self) -> Time {
        self.shared().echo()
    }

    /// Makes the output safe permanently, as the drop of the last clone does, and returns whether it is safe.
    /// If it is not, the safe function is retried, and the guard is released when that succeeds.
    #[doc(hidden)]
    #[must_use]
    pub fn release(&self) -> Released {
        let shared = self.shared();
        shared.with(|inner| {
            if self.is_released() {
                return Released::Before;
            }
            shared.watch.is_releasing.store(true, Ordering::Release);
            inner.dry_run = None;
            shared.retry_safe(inner, shared.clock.now());
            shared.decide_locked(inner, |receiver, _| receiver.trip(Cause::Dropped));
            if self.is_released() { Released::Now } else { Released::NotSafe }
        })
    }

    /// Same as [`release`](Self::release), for a caller that may not wait, because it holds another output's
    /// lock. It trips the guard. The guard is released at once, or when its lock is free and its output is
    /// safe.
    #[doc(hidden)]
    pub fn release_later(&self) {
        let shared = self.shared();
        // SYNC: before the trip. A thread that arms the output between the two finds it tripped; one that
        // arms it after the trip finds it released.
        shared.watch.is_releasing.store(true, Ordering::Release);
        shared.trip();
    }

    /// Returns whether the output must be made safe, and the last attempt failed.
    #[doc(hidden)]
    #[must_use]
    pub fn is_owed(&self) -> bool {
        self.shared().watch.needs_retry.load(Ordering::Acquire)
    }

    /// Returns whether the guard is released.
    #[doc(hidden)]
    #[must_use]
    pub fn is_released(&self) -> bool {
        self.shared().is_orphan()
    }

    /// Returns the part of the guard that an application's context keeps.
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
            // The guard was released, and is safe permanently. Its drop must not block: it may run in a safe
            // function that trips another guard.
            return;
        }
        self.0.with(|inner| {
            // Another guard may have the device from now on.
            inner.dry_run = None;
            self.0.decide_locked(inner, |receiver, _| receiver.trip(Cause::Dropped));
        });
        self.0.watch.is_orphan.store(true, Ordering::Release);
        if self.0.watch.needs_retry.load(Ordering::Acquire) && self.0.wake_up.is_none() {
            // The guard has no other owner, and the output is not safe yet.
            safe_output::retry_orphan(self.0.clone());
        }
    }
}

impl<O> Shared<O> {
    /// A command that panics leaves its output unchanged: the next bad, late or missing command makes it safe.
    fn lock(&self) -> MutexGuard<'_, Inner<O>> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn decide<R>(&self, decide: impl FnOnce(&mut Receiver, Time) -> R) -> R {
        self.with(|inner| self.decide_locked(inner, decide))
    }

    /// Runs `step` with the lock of the output, then writes the log entry.
    fn with<R>(&self, step: impl FnOnce(&mut Inner<O>) -> R) -> R {
        let mut inner = self.lock();
        let result = step(&mut inner);
        let log_entry = inner.log_entry.take();
        drop(inner);
        log_entry.into_iter().for_each(LogEntry::log);
        result
    }

    /// Calls a failed safe function again.
    fn retry_safe(&self, inner: &mut Inner<O>, now: Time) {
        let Some(SafeRetry { cause, .. }) = inner.retry else { return };
        inner.make_safe(cause, now);
        self.complete_release(inner);
    }

    /// Completes a pending release if the output is safe.
    fn complete_release(&self, inner: &Inner<O>) {
        let is_safe = inner.retry.is_none() && inner.receiver.state() != State::Live;
        if is_safe && self.watch.is_releasing.load(Ordering::Acquire) {
            self.watch.is_orphan.store(true, Ordering::Release);
        }
    }

    fn decide_locked<R>(&self, inner: &mut Inner<O>, decide: impl FnOnce(&mut Receiver, Time) -> R) -> R {
        let (now, asleep) = self.clock.now_and_asleep();
        let (is_tripped, had_retry) =
            (self.watch.is_tripped.swap(false, Ordering::AcqRel), inner.retry.is_some());
        let must_stop = self.watch.must_stop();
        let decided = inner.let_decide(now, |receiver| {
            receiver.has_slept(asleep);
            if must_stop {
                receiver.trip(Cause::Stopped);
            }
            if is_tripped {
                receiver.trip(Cause::Tripped);
            }
            decide(receiver, now)
        });
        self.set_deadline(inner.deadline());
        self.watch.publish(inner.retry.is_some(), inner.receiver.state());
        if inner.retry.is_some() && !had_retry {
            // The thread sleeps until the previous deadline, if there was one.
            wake();
        }
        self.complete_release(inner);
        decided
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
            CheckResult::Locked => self.check_soon(),
            CheckResult::Done(log_entry) => log_entry.into_iter().for_each(LogEntry::log),
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

impl<O: Send + 'static> WatchedOutput for Shared<O> {
    fn try_expire(&self) -> CheckResult {
        let mut inner = match self.inner.try_lock() {
            Ok(inner) => inner,
            Err(TryLockError::Poisoned(poisoned)) => poisoned.into_inner(),
            Err(TryLockError::WouldBlock) => return CheckResult::Locked,
        };
        self.retry_safe(&mut inner, self.clock.now());
        self.end_dry_run(&mut inner);
        self.decide_locked(&mut inner, |receiver, now| receiver.expire(now));
        CheckResult::Done(inner.log_entry.take())
    }

    fn watch(&self) -> &WatchState {
        &self.watch
    }
}
