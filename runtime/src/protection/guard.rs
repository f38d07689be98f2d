//! An output that is safe unless good commands come, and the thread that sees to it.

use std::{
    io,
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{
        Arc, Mutex, MutexGuard, OnceLock, PoisonError, TryLockError, Weak,
        atomic::{AtomicBool, AtomicU64, Ordering},
        mpsc::sync_channel,
    },
    thread::{self, Thread},
    time::Duration,
};

use bytes::Bytes;

use super::{
    ArmError, Cause, Codename, Protection, SAFE_OUTPUT_PRIORITY, State, Tally,
    receiver::{Opened, Receiver, Verdict},
};
use crate::{supervision::make_foremost, tid::Tid, time::Time, wire::Payload};

/// Outputs that nobody has any more and that are tried on, at most.
const OWING_MAX: usize = 256;
/// Time that the thread which keeps the watchdogs has to begin.
const BEGINS_WITHIN: Duration = Duration::from_secs(5);
/// Time after which an output is tried again that its application holds just then.
const HELD: Duration = Duration::from_micros(100);
/// Time after which what makes an output safe is called again, where it has panicked.
const SAFE_RETRY: Duration = Duration::from_millis(1);
/// Longest sleep of the thread; it is woken when it has something to do.
const IDLE: Duration = Duration::from_secs(3_600);

/// The only way to an output of type `O`: commands pass while it is live, and it is made safe as soon as it is not.
///
/// Clones have the same output. When the last one is dropped (its application has ended) the output is made safe.
pub struct Guard<O: Send + 'static> {
    /// Counts the clones, without the hold that a context has.
    owners: Arc<Owners<O>>,
}

struct Owners<O: Send + 'static>(Arc<Shared<O>>);

struct Shared<O> {
    codename: Codename,
    inner: Mutex<Inner<O>>,
    watch: Arc<Watch>,
}

/// What the thread knows of an output without touching it.
struct Watch {
    /// When it has to look, in nanoseconds; `u64::MAX` while the output is safe.
    deadline: AtomicU64,
    /// Somebody trips the output who could not wait for it.
    is_tripped: AtomicBool,
    /// Nobody has the guard any more.
    is_orphan: AtomicBool,
}

struct Inner<O> {
    codename: Codename,
    receiver: Receiver,
    output: O,
    safe: MakeSafe<O>,
    owes: Option<Owed>,
}

/// The output was to be made safe, and that has panicked.
#[derive(Clone, Copy)]
struct Owed {
    cause: Cause,
    /// When it is tried again: what comes meanwhile puts it off no further.
    retry: Time,
}

type MakeSafe<O> = Box<dyn FnMut(&mut O, Cause) + Send>;

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
        let Self { output, safe, owes, codename: Codename { source, name, .. }, .. } = self;
        let is_news = owes.is_none();
        if catch_unwind(AssertUnwindSafe(|| safe(output, cause))).is_ok() {
            *owes = None;
            if cause != Cause::NotArmed && cause != Cause::Dropped {
                crate::log::warn!(%source, of = *name, %cause, "a guard is shut; its output, if it has one, is safe");
            }
            return;
        }
        *owes = Some(Owed { cause, retry: now + SAFE_RETRY });
        if is_news {
            crate::log::error!(%source, of = *name, %cause, "what makes an output safe has panicked; it is tried again each millisecond");
        }
    }

    /// Calls again what has panicked.
    fn pay(&mut self, now: Time) {
        if let Some(Owed { cause, .. }) = self.owes {
            self.make_safe(cause, now);
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
    /// The thread cannot be started.
    pub fn new<P: Payload>(
        source: Tid,
        receiver: Tid,
        output: O,
        safe: impl FnMut(&mut O, Cause) + Send + 'static,
    ) -> io::Result<Self> {
        const { assert!(P::PROTECTION.is_some(), "a guard is for a payload whose PROTECTION says what is borne") };
        let protection = P::PROTECTION.unwrap_or(Protection::of_period(Duration::ZERO));
        let codename = Codename::of::<P>(source, receiver);
        let receiver = Receiver::new(protection);
        let mut inner = Inner { codename, receiver, output, safe: Box::new(safe), owes: None };
        inner.make_safe(Cause::NotArmed, Time::now());
        let watch = Watch {
            deadline: AtomicU64::new(inner.deadline()),
            is_tripped: AtomicBool::new(false),
            is_orphan: AtomicBool::new(false),
        };
        let shared = Arc::new(Shared { codename, inner: Mutex::new(inner), watch: Arc::new(watch) });
        let output: Arc<dyn Watched> = shared.clone();
        keeper()?.keep(Kept { watch: shared.watch.clone(), output: Arc::downgrade(&output) });
        Ok(Self { owners: Arc::new(Owners(shared)) })
    }

    fn shared(&self) -> &Arc<Shared<O>> {
        &self.owners.0
    }

    /// Moves the output, if it is live.
    ///
    /// # Errors
    /// It is not, since this; it was not moved.
    pub fn apply<R>(&self, command: impl FnOnce(&mut O) -> R) -> Result<R, Cause> {
        let mut inner = self.shared().lock();
        self.shared().decide_locked(&mut inner, |receiver, now| receiver.expire(now));
        match inner.receiver.state() {
            State::Live => Ok(command(&mut inner.output)),
            State::Safe(cause) => Err(cause),
        }
    }

    /// Makes the output live: from now on commands pass. Somebody has seen that it is safe to; nothing does this by itself.
    ///
    /// # Errors
    /// Too few good messages have come, or the output could not be made safe.
    pub fn arm(&self) -> Result<(), ArmError> {
        {
            let mut inner = self.shared().lock();
            inner.pay(Time::now());
            if inner.owes.is_some() {
                return Err(ArmError::SafeFails);
            }
            self.shared().decide_locked(&mut inner, |receiver, now| receiver.arm(now))?;
        }
        // The thread sleeps, as there was no deadline.
        rouse();
        Ok(())
    }

    /// Makes the output safe: at once, or, while its application or another thread has it in hand, as soon as it has not.
    pub fn trip(&self) {
        self.shared().watch.is_tripped.store(true, Ordering::Release);
        if !self.shared().try_expire() {
            rouse();
        }
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
        write!(f, "Guard({:?})", self.shared().codename)
    }
}

impl<O: Send + 'static> Drop for Owners<O> {
    fn drop(&mut self) {
        self.0.decide(|receiver, _| receiver.trip(Cause::Dropped));
        self.0.watch.is_orphan.store(true, Ordering::Release);
        if self.0.owes() {
            // Nobody else has it any more, and it is not safe yet.
            KEEPER.get_or_init(Keeper::default).keep_owing(self.0.clone());
        }
    }
}

impl<O> Shared<O> {
    /// A command that panics has left its output as it is: the next one that is bad, late or missing makes it safe.
    fn lock(&self) -> MutexGuard<'_, Inner<O>> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn decide<R>(&self, decide: impl FnOnce(&mut Receiver, Time) -> R) -> R {
        self.decide_locked(&mut self.lock(), decide)
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
        if inner.owes.is_some() && !owed {
            // The thread sleeps until the deadline that was, if there was any.
            rouse();
        }
        decided
    }
}

/// A guard, whatever its output is, as its application's context sees it.
pub(crate) trait Guarded: Send + Sync {
    /// Who sends what to whom.
    fn codename(&self) -> Codename;
    /// Whether nobody has the guard any more.
    fn is_orphan(&self) -> bool;
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
        let (opened, value) = Opened::of(&self.codename(), bytes, read);
        self.judge(opened).of(value)
    }
}

impl<O: Send + 'static> Guarded for Shared<O> {
    fn codename(&self) -> Codename {
        self.codename
    }

    fn is_orphan(&self) -> bool {
        self.watch.is_orphan.load(Ordering::Acquire)
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

/// An output, as the thread sees it.
trait Watched: Send + Sync {
    /// Makes the output safe if its time is over. `false`: somebody has it in hand just now.
    fn try_expire(&self) -> bool;
    /// Whether it was to be made safe, and that has panicked.
    fn owes(&self) -> bool;
}

impl<O: Send + 'static> Watched for Shared<O> {
    fn try_expire(&self) -> bool {
        let mut inner = match self.inner.try_lock() {
            Ok(inner) => inner,
            Err(TryLockError::Poisoned(poisoned)) => poisoned.into_inner(),
            Err(TryLockError::WouldBlock) => return false,
        };
        inner.pay(Time::now());
        self.decide_locked(&mut inner, |receiver, now| receiver.expire(now));
        true
    }

    fn owes(&self) -> bool {
        self.lock().owes.is_some()
    }
}

/// One output, which its owners keep: it is dropped where the last of them is.
struct Kept {
    watch: Arc<Watch>,
    output: Weak<dyn Watched>,
}

/// Who keeps the watchdogs of this process.
#[derive(Default)]
struct Keeper {
    kept: Mutex<Vec<Kept>>,
    /// Outputs that nobody has any more and that are not safe yet.
    owing: Mutex<Vec<Arc<dyn Watched>>>,
}

static KEEPER: OnceLock<Keeper> = OnceLock::new();
static THREAD: OnceLock<Thread> = OnceLock::new();

/// The keeper, whose thread runs.
fn keeper() -> io::Result<&'static Keeper> {
    static STARTING: Mutex<()> = Mutex::new(());
    let keeper = KEEPER.get_or_init(Keeper::default);
    let _one_at_a_time = STARTING.lock().unwrap_or_else(PoisonError::into_inner);
    if THREAD.get().is_none() {
        let (prepared, is_prepared) = sync_channel(0);
        let thread = thread::Builder::new().name("safe-output".to_owned()).spawn(move || {
            make_foremost("safe-output", SAFE_OUTPUT_PRIORITY);
            // Where nobody waits any more, there will be another one.
            if prepared.send(()).is_ok() {
                keeper.run();
            }
        })?;
        // Until it is prepared it has this thread's CPUs and priority: who never sleeps would never let it begin.
        is_prepared.recv_timeout(BEGINS_WITHIN).map_err(|_| {
            io::Error::other(format!(
                "the thread 'safe-output' has not begun within {BEGINS_WITHIN:?}: does a thread of a higher real-time priority keep all CPUs?"
            ))
        })?;
        THREAD.get_or_init(|| thread.thread().clone());
    }
    Ok(keeper)
}

/// A deadline is nearer than the thread knows. Takes no lock.
fn rouse() {
    if let Some(thread) = THREAD.get() {
        thread.unpark();
    }
}

impl Keeper {
    fn lock(&self) -> MutexGuard<'_, Vec<Kept>> {
        self.kept.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn keep(&self, kept: Kept) {
        self.lock().push(kept);
        rouse();
    }

    /// Tries an output on until it is safe, in place of its owners.
    fn keep_owing(&self, output: Arc<dyn Watched>) {
        let mut owing = self.owing.lock().unwrap_or_else(PoisonError::into_inner);
        if owing.len() < OWING_MAX {
            owing.push(output);
        } else {
            crate::log::error!(
                "an output is given up that is not safe: what makes outputs safe panics for {OWING_MAX} others that nobody has any more"
            );
        }
        drop(owing);
        rouse();
    }

    /// Lets go of those that are safe by now: what is dropped with them is the user's, and no lock is held.
    fn let_go(&self) {
        let mut paid = Vec::new();
        self.owing.lock().unwrap_or_else(PoisonError::into_inner).retain(|output| {
            let owes = output.owes();
            if !owes {
                paid.push(output.clone());
            }
            owes
        });
        let _ = catch_unwind(AssertUnwindSafe(|| drop(paid)));
    }

    fn run(&self) -> ! {
        loop {
            self.let_go();
            let (due, sleeps) = self.look(Time::now());
            if due.is_empty() {
                thread::park_timeout(sleeps);
                continue;
            }
            // Without the lock: what makes an output safe is the user's, and may make, arm or drop guards.
            let mut are_held = true;
            for output in due {
                // A panic of what makes it safe is caught where that is called; here an output may panic whose last owner has just gone.
                let tried = catch_unwind(AssertUnwindSafe(|| {
                    output.upgrade().is_none_or(|output| output.try_expire())
                }));
                are_held &= !tried.unwrap_or(true);
            }
            if are_held {
                thread::park_timeout(HELD.min(sleeps));
            }
        }
    }

    /// Whose time is over, and the time until the next one's is.
    fn look(&self, now: Time) -> (Vec<Weak<dyn Watched>>, Duration) {
        let (mut due, mut sleeps) = (Vec::new(), IDLE);
        self.lock().retain(|Kept { watch, output }| {
            let left = Time::from_nanos(watch.deadline.load(Ordering::Acquire)).since(now);
            if left.is_zero() || watch.is_tripped.load(Ordering::Acquire) {
                due.push(output.clone());
            } else {
                sleeps = sleeps.min(left);
            }
            output.strong_count() > 0
        });
        (due, sleeps)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tid::{AppAddress, NodeAddress};

    #[test]
    fn messages_do_not_put_off_the_next_try_of_what_has_panicked() {
        let tid = |app| Tid::new(NodeAddress::new(7), AppAddress::new(app));
        let codename = Codename { source: tid(1), destination: tid(2), name: "test.torque" };
        let receiver = Receiver::new(Protection::of_period(SAFE_RETRY));
        let safe = Box::new(|(): &mut (), _| panic!("a planted panic"));
        let mut inner = Inner { codename, receiver, output: (), safe, owes: None };
        let begun = Time::from_nanos(1_000_000_000);
        inner.make_safe(Cause::Tripped, begun);
        let due = (begun + SAFE_RETRY).as_nanos();
        for tenth in 0..20 {
            let now = begun + SAFE_RETRY / 10 * tenth;
            inner.let_decide(now, |receiver| receiver.take(now, Opened::Corrupt));
            assert_eq!(inner.deadline(), due);
        }
    }
}
