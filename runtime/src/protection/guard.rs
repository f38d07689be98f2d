//! An output that is safe unless good commands come, and the thread that sees to it.

use std::{
    io,
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{
        Arc, Condvar, Mutex, MutexGuard, OnceLock, PoisonError, TryLockError,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    thread,
    time::Duration,
};

use bytes::Bytes;

use super::{
    Cause, Codename, NotGood, Protection, State, Tally,
    receiver::{Receiver, Verdict},
};
use crate::{supervision::Place, tid::Tid, time::Time, wire::Payload};

/// SCHED_FIFO priority of the thread that keeps the watchdogs: above all that controls.
const PRIORITY: u8 = 90;
/// Time after which an output is tried again that its application holds just then.
const HELD: Duration = Duration::from_micros(100);
/// Longest sleep of the thread; it is woken when it has something to do.
const IDLE: Duration = Duration::from_secs(3_600);

/// The only way to an output of type `O`: commands pass while it is live, and it is made safe as soon as it is not.
///
/// Clones have the same output. When the last one is dropped (its application has ended) the output is made safe.
pub struct Guard<O: Send + 'static> {
    shared: Arc<Shared<O>>,
    /// Counts the clones, without the thread's own hold.
    owners: Arc<Owners<O>>,
}

struct Owners<O: Send + 'static>(Arc<Shared<O>>);

struct Shared<O> {
    inner: Mutex<Inner<O>>,
    /// When the thread has to look, in nanoseconds; `u64::MAX` while the output is safe.
    deadline: AtomicU64,
    /// Nobody has the guard any more.
    is_orphan: AtomicBool,
}

struct Inner<O> {
    receiver: Receiver,
    output: O,
    safe: MakeSafe<O>,
}

type MakeSafe<O> = Box<dyn FnMut(&mut O, Cause) + Send>;

impl<O> Inner<O> {
    /// Lets the receiver change its mind, and makes the output safe if it did.
    fn let_decide<R>(&mut self, decide: impl FnOnce(&mut Receiver) -> R) -> R {
        let before = self.receiver.state();
        let decided = decide(&mut self.receiver);
        if let (State::Live, State::Safe(cause)) = (before, self.receiver.state()) {
            self.make_safe(cause);
        }
        decided
    }

    fn make_safe(&mut self, cause: Cause) {
        let Self { output, safe, receiver } = self;
        let codename = receiver.codename();
        if catch_unwind(AssertUnwindSafe(|| safe(output, cause))).is_err() {
            crate::log::error!(source = %codename.source, of = codename.name, %cause, "what makes an output safe has panicked");
        } else if cause != Cause::NotArmed && cause != Cause::Dropped {
            crate::log::warn!(source = %codename.source, of = codename.name, %cause, "an output is safe");
        }
    }
}

impl<O: Send + 'static> Guard<O> {
    /// The output of what `receiver` does with the values of type `P` from `source`. `safe` is called with it now, and each time that
    /// it is not live any more: on the thread `safe-output`, on that of a message, or of whoever trips or drops the guard. It must be
    /// short, and wait for nobody.
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
        let mut inner = Inner { receiver: Receiver::new(codename, protection), output, safe: Box::new(safe) };
        inner.make_safe(Cause::NotArmed);
        let deadline = AtomicU64::new(u64::MAX);
        let shared =
            Arc::new(Shared { inner: Mutex::new(inner), deadline, is_orphan: AtomicBool::new(false) });
        keeper()?.keep(shared.clone());
        Ok(Self { owners: Arc::new(Owners(shared.clone())), shared })
    }

    /// Moves the output, if it is live.
    ///
    /// # Errors
    /// It is not, since this; it was not moved.
    pub fn apply<R>(&self, command: impl FnOnce(&mut O) -> R) -> Result<R, Cause> {
        let mut inner = self.shared.lock();
        let now = Time::now();
        inner.let_decide(|receiver| receiver.expire(now));
        match inner.receiver.state() {
            State::Live => Ok(command(&mut inner.output)),
            State::Safe(cause) => Err(cause),
        }
    }

    /// Makes the output live: from now on commands pass. Somebody has seen that it is safe to; nothing does this by itself.
    ///
    /// # Errors
    /// Too few good messages have come.
    pub fn arm(&self) -> Result<(), NotGood> {
        let armed = self.shared.decide(|receiver, now| receiver.arm(now));
        if armed.is_ok() {
            // The thread sleeps, as there was no deadline.
            KEEPER.get().into_iter().for_each(Keeper::rouse);
        }
        armed
    }

    /// Makes the output safe.
    pub fn trip(&self) {
        self.shared.decide(|receiver, _| receiver.trip(Cause::Tripped));
    }

    /// Whether commands pass.
    #[must_use]
    pub fn state(&self) -> State {
        self.shared.decide(|receiver, now| {
            receiver.expire(now);
            receiver.state()
        })
    }

    /// What has been counted.
    #[must_use]
    pub fn tally(&self) -> Tally {
        self.shared.lock().receiver.tally()
    }

    /// What an application's context knows of it.
    pub(crate) fn guarded(&self) -> Arc<dyn Guarded> {
        self.shared.clone()
    }
}

impl<O: Send + 'static> Clone for Guard<O> {
    fn clone(&self) -> Self {
        Self { shared: self.shared.clone(), owners: self.owners.clone() }
    }
}

impl<O: Send + 'static> std::fmt::Debug for Guard<O> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Guard({:?})", self.shared.lock().receiver)
    }
}

impl<O: Send + 'static> Drop for Owners<O> {
    fn drop(&mut self) {
        let shared = &self.0;
        shared.decide(|receiver, _| receiver.trip(Cause::Dropped));
        shared.is_orphan.store(true, Ordering::Release);
        KEEPER.get().into_iter().for_each(Keeper::rouse);
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

    fn decide_locked<R>(
        &self,
        inner: &mut MutexGuard<'_, Inner<O>>,
        decide: impl FnOnce(&mut Receiver, Time) -> R,
    ) -> R {
        let now = Time::now();
        let decided = inner.let_decide(|receiver| decide(receiver, now));
        let deadline = inner.receiver.deadline().map_or(u64::MAX, Time::as_nanos);
        self.deadline.store(deadline, Ordering::Release);
        decided
    }
}

/// A guard, whatever its output is, as its application's context sees it.
pub(crate) trait Guarded: Send + Sync {
    /// Who sends what to whom.
    fn codename(&self) -> Codename;
    /// Takes a message in.
    fn take(&self, bytes: &Bytes) -> Verdict;
    /// The time that the sender is to quote.
    fn echo(&self) -> Time;
}

impl<O: Send + 'static> Guarded for Shared<O> {
    fn codename(&self) -> Codename {
        *self.lock().receiver.codename()
    }

    fn take(&self, bytes: &Bytes) -> Verdict {
        self.decide(|receiver, now| receiver.take(now, bytes))
    }

    fn echo(&self) -> Time {
        self.decide(|receiver, now| receiver.echo(now))
    }
}

/// A guard, as the thread sees it.
trait Watched: Send + Sync {
    fn deadline(&self) -> Time;
    fn is_orphan(&self) -> bool;
    /// Makes the output safe if its time is over. `false`: its application holds it just now.
    fn try_expire(&self) -> bool;
}

impl<O: Send + 'static> Watched for Shared<O> {
    fn deadline(&self) -> Time {
        Time::from_nanos(self.deadline.load(Ordering::Acquire))
    }

    fn is_orphan(&self) -> bool {
        self.is_orphan.load(Ordering::Acquire)
    }

    fn try_expire(&self) -> bool {
        let mut inner = match self.inner.try_lock() {
            Ok(inner) => inner,
            Err(TryLockError::Poisoned(poisoned)) => poisoned.into_inner(),
            Err(TryLockError::WouldBlock) => return false,
        };
        self.decide_locked(&mut inner, |receiver, now| receiver.expire(now));
        true
    }
}

/// Who keeps the watchdogs of this process.
struct Keeper {
    watched: Mutex<Vec<Arc<dyn Watched>>>,
    changed: Condvar,
}

static KEEPER: OnceLock<Keeper> = OnceLock::new();

/// The keeper, whose thread runs.
fn keeper() -> io::Result<&'static Keeper> {
    static STARTED: Mutex<bool> = Mutex::new(false);
    let keeper = KEEPER.get_or_init(|| Keeper { watched: Mutex::new(Vec::new()), changed: Condvar::new() });
    let mut started = STARTED.lock().unwrap_or_else(PoisonError::into_inner);
    if !*started {
        thread::Builder::new().name("safe-output".to_owned()).spawn(|| {
            Place::layer("safe-output").realtime(PRIORITY).prepare();
            keeper.run()
        })?;
        *started = true;
    }
    Ok(keeper)
}

impl Keeper {
    fn lock(&self) -> MutexGuard<'_, Vec<Arc<dyn Watched>>> {
        self.watched.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn keep(&self, guard: Arc<dyn Watched>) {
        self.lock().push(guard);
    }

    /// A deadline is nearer than the thread knows.
    fn rouse(&self) {
        // It reads the deadlines and begins to wait under this lock: it sees the new one, or this.
        drop(self.lock());
        self.changed.notify_one();
    }

    fn run(&self) -> ! {
        let mut watched = self.lock();
        loop {
            let now = Time::now();
            let mut sleeps = IDLE;
            let mut buried = Vec::new();
            watched.retain(|guard| {
                if guard.is_orphan() {
                    buried.push(guard.clone());
                    return false;
                }
                let is_held = guard.deadline() <= now && !guard.try_expire();
                sleeps = sleeps.min(if is_held { HELD } else { guard.deadline().since(now) });
                true
            });
            if !buried.is_empty() {
                // What an output does when it is dropped is its own affair, and nobody waits for it here.
                drop(watched);
                drop(buried);
                watched = self.lock();
                continue;
            }
            let waited = self.changed.wait_timeout(watched, sleeps);
            watched = waited.unwrap_or_else(PoisonError::into_inner).0;
        }
    }
}
