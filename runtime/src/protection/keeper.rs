//! The thread that makes outputs safe when their time is over. It waits for no other one: what others hand it lies in a queue, and while one
//! of them is at that it looks again a little later. What it knows of an output without that one's lock is in the [`Watch`].

use std::{
    io,
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{
        Arc, Mutex, MutexGuard, OnceLock, PoisonError, TryLockError, Weak,
        atomic::{AtomicBool, AtomicU8, AtomicU64, AtomicUsize, Ordering},
        mpsc::sync_channel,
    },
    thread::{self, Thread},
    time::Duration,
};

use super::{
    SAFE_OUTPUT_PRIORITY,
    said::{self, Said, Unsaid},
};
use crate::{
    supervision::{make_foremost, realtime_priority},
    time::Time,
};

/// Outputs that nobody has any more and that are tried on, at most.
const OWING_MAX: usize = 256;
/// Time that the thread which keeps the watchdogs has to begin.
const BEGINS_WITHIN: Duration = Duration::from_secs(5);
/// Time after which is tried again what somebody holds just then: an output, or the queue to the thread.
const HELD: Duration = Duration::from_micros(100);
/// Time after which it hands over again what is to be dropped.
const TIDIES: Duration = Duration::from_millis(10);
/// Longest sleep of the thread; it is woken when it has something to do.
const IDLE: Duration = Duration::from_secs(3_600);

/// What the thread knows of an output without touching it.
pub(super) struct Watch {
    /// When it has to look, in nanoseconds; `u64::MAX` while the output is safe.
    pub(super) deadline: AtomicU64,
    /// Somebody trips the output who could not wait for it.
    pub(super) is_tripped: AtomicBool,
    /// Somebody has let go of the output: it is an orphan as soon as it is safe.
    pub(super) is_to_go: AtomicBool,
    /// Nobody has the guard any more.
    pub(super) is_orphan: AtomicBool,
    /// The output was to be made safe, and that has failed.
    pub(super) owes: AtomicBool,
}

impl Watch {
    pub(super) const fn new(deadline: u64, owes: bool) -> Self {
        Self {
            deadline: AtomicU64::new(deadline),
            is_tripped: AtomicBool::new(false),
            is_to_go: AtomicBool::new(false),
            is_orphan: AtomicBool::new(false),
            owes: AtomicBool::new(owes),
        }
    }
}

/// What came of a look at an output.
pub(super) enum Tried {
    /// Somebody has it in hand just now.
    Held,
    /// It was looked at, and this is to be said of it.
    Done(Option<Said>),
}

/// An output, as the thread sees it.
pub(super) trait Watched: Send + Sync {
    /// Makes the output safe if its time is over.
    fn try_expire(&self) -> Tried;
    /// What is known of it without its lock.
    fn watch(&self) -> &Watch;
}

/// Who keeps the watchdogs of this process, as everybody else sees it: a way in.
#[derive(Default)]
pub(super) struct Keeper {
    /// Others hold this for a push, and may be kept from going on meanwhile for as long as it takes: the thread never waits for it.
    arrivals: Mutex<Vec<Arrival>>,
    /// How many outputs are owed.
    owing: AtomicUsize,
}

/// What the thread is to keep from now on.
pub(super) enum Arrival {
    Kept(Kept),
    /// One that nobody has any more and that is not safe yet.
    Owing(Arc<dyn Watched>),
}

/// What the thread has no use for any more.
#[expect(dead_code, reason = "it is there to be dropped, by another thread")]
pub(super) enum Rubbish {
    Kept(Kept),
    Output(Arc<dyn Watched>),
}

/// One output, which its owners keep: it is dropped where the last of them is.
pub(super) struct Kept {
    watch: Arc<Watch>,
    output: Weak<dyn Watched>,
}

static KEEPER: OnceLock<Keeper> = OnceLock::new();
static THREAD: OnceLock<Thread> = OnceLock::new();
/// The thread's real-time priority, 0 for none.
static GRANTED: AtomicU8 = AtomicU8::new(0);

/// The keeper, whose thread runs and comes before the calling one.
///
/// # Errors
/// The thread cannot be started, or does not begin; or the calling one would keep it from running.
pub(super) fn begun() -> io::Result<&'static Keeper> {
    let keeper = start()?;
    comes_first(GRANTED.load(Ordering::Acquire), realtime_priority())?;
    Ok(keeper)
}

/// Refuses whoever would not be interrupted by the thread: the system lets no thread of its real-time schedule wait for another one that is as
/// urgent, so an application that hangs would have its outputs as they are.
fn comes_first(granted: u8, own: u8) -> io::Result<()> {
    if own == 0 || own < granted {
        return Ok(());
    }
    Err(io::Error::new(
        io::ErrorKind::PermissionDenied,
        format!(
            "this thread has the real-time priority {own}, and what makes outputs safe was granted {granted} (0: none), so that it would not run while this \
             one hangs: allow {SAFE_OUTPUT_PRIORITY} with `ulimit -r 99` or `setcap cap_sys_nice+ep` on the program, or take a lower one for this thread"
        ),
    ))
}

fn start() -> io::Result<&'static Keeper> {
    static STARTING: Mutex<()> = Mutex::new(());
    let keeper = KEEPER.get_or_init(Keeper::default);
    let _one_at_a_time = STARTING.lock().unwrap_or_else(PoisonError::into_inner);
    if THREAD.get().is_none() {
        said::begin()?;
        let (prepared, is_prepared) = sync_channel(0);
        let thread = thread::Builder::new().name("safe-output".to_owned()).spawn(move || {
            let granted = make_foremost("safe-output", SAFE_OUTPUT_PRIORITY);
            GRANTED.store(granted, Ordering::Release);
            // Where nobody waits any more, there will be another one.
            if prepared.send(()).is_ok() {
                Rounds::default().go(keeper);
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
pub(super) fn rouse() {
    if let Some(thread) = THREAD.get() {
        thread.unpark();
    }
}

/// Tries an output on until it is safe, in place of its owners.
pub(super) fn keep_owing(output: Arc<dyn Watched>) {
    KEEPER.get_or_init(Keeper::default).keep_owing(output);
}

impl Keeper {
    pub(super) fn keep(&self, watch: Arc<Watch>, output: Weak<dyn Watched>) {
        self.arrives(Arrival::Kept(Kept { watch, output }));
    }

    fn keep_owing(&self, output: Arc<dyn Watched>) {
        if self.owing.fetch_add(1, Ordering::Relaxed) < OWING_MAX {
            self.arrives(Arrival::Owing(output));
            return;
        }
        self.owing.fetch_sub(1, Ordering::Relaxed);
        crate::log::error!(
            "an output is given up that is not safe: what makes outputs safe fails for {OWING_MAX} others that nobody has any more"
        );
    }

    fn arrives(&self, arrival: Arrival) {
        self.lock().push(arrival);
        rouse();
    }

    pub(super) fn lock(&self) -> MutexGuard<'_, Vec<Arrival>> {
        self.arrivals.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// What the thread has for itself.
#[derive(Default)]
struct Rounds {
    kept: Vec<Kept>,
    /// Outputs that nobody has any more and that are not safe yet.
    owing: Vec<Arc<dyn Watched>>,
    /// Those whose time is over in this round.
    due: Vec<Weak<dyn Watched>>,
    unsaid: Unsaid,
    /// To give memory back can mean to wait for a thread that does so too: it is left to the one that speaks.
    rubbish: Vec<Rubbish>,
}

impl Rounds {
    fn go(mut self, keeper: &Keeper) -> ! {
        loop {
            let sleeps = self.round(keeper);
            if !sleeps.is_zero() {
                thread::park_timeout(sleeps);
            }
        }
    }

    /// Makes safe what is due; how long there is nothing to do then, if nobody wakes the thread.
    fn round(&mut self, keeper: &Keeper) -> Duration {
        let has_all = self.take_in(keeper);
        // Of the round before: all that was due then is safe.
        let has_said_all = self.unsaid.hand_over(&mut self.rubbish);
        let soon = if has_all && has_said_all { IDLE } else { HELD };
        self.let_go(keeper);
        let sleeps = self.look(Time::now()).min(soon);
        let sleeps = if self.rubbish.is_empty() { sleeps } else { sleeps.min(TIDIES) };
        if self.due.is_empty() {
            return sleeps;
        }
        let mut are_held = true;
        for output in self.due.drain(..) {
            // A panic of what makes it safe is caught where that is called; here an output may panic whose last owner has just gone.
            let tried = catch_unwind(AssertUnwindSafe(|| {
                let Some(output) = output.upgrade() else { return Tried::Done(None) };
                let tried = output.try_expire();
                if Arc::strong_count(&output) == 1 {
                    self.rubbish.push(Rubbish::Output(output));
                }
                tried
            }));
            match tried.unwrap_or(Tried::Done(None)) {
                Tried::Held => {}
                Tried::Done(said) => {
                    are_held = false;
                    self.unsaid.note(said);
                }
            }
        }
        if are_held { HELD.min(sleeps) } else { Duration::ZERO }
    }

    /// Takes in what is to be kept from now on; whether nobody was at the queue just then.
    fn take_in(&mut self, keeper: &Keeper) -> bool {
        let mut arrivals = match keeper.arrivals.try_lock() {
            Ok(arrivals) => arrivals,
            Err(TryLockError::Poisoned(poisoned)) => poisoned.into_inner(),
            Err(TryLockError::WouldBlock) => return false,
        };
        // The queue keeps its memory, which is of those threads: to give it back could mean to wait for one.
        for arrival in arrivals.drain(..) {
            match arrival {
                Arrival::Kept(kept) => self.kept.push(kept),
                Arrival::Owing(output) => self.owing.push(output),
            }
        }
        true
    }

    /// Lets go of those that are safe by now.
    fn let_go(&mut self, keeper: &Keeper) {
        let mut at = 0;
        while let Some(output) = self.owing.get(at) {
            if output.watch().owes.load(Ordering::Acquire) {
                at += 1;
                continue;
            }
            self.rubbish.push(Rubbish::Output(self.owing.swap_remove(at)));
            keeper.owing.fetch_sub(1, Ordering::Relaxed);
        }
    }

    /// Notes whose time is over; the time until the next one's is.
    fn look(&mut self, now: Time) -> Duration {
        let Self { kept, due, rubbish, .. } = self;
        let (mut sleeps, mut at) = (IDLE, 0);
        while let Some(Kept { watch, output }) = kept.get(at) {
            let left = Time::from_nanos(watch.deadline.load(Ordering::Acquire)).since(now);
            if left.is_zero() || watch.is_tripped.load(Ordering::Acquire) {
                due.push(output.clone());
            } else {
                sleeps = sleeps.min(left);
            }
            if output.strong_count() > 0 {
                at += 1;
            } else {
                rubbish.push(Rubbish::Kept(kept.swap_remove(at)));
            }
        }
        sleeps
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn whoever_is_as_urgent_as_what_makes_outputs_safe_has_no_guard() {
        for (granted, own) in [(90, 89), (80, 79), (2, 1), (90, 0), (0, 0)] {
            assert!(comes_first(granted, own).is_ok(), "{own} below {granted}");
        }
        for (granted, own) in [(90, 90), (80, 80), (80, 89), (0, 1)] {
            let refused = comes_first(granted, own).expect_err("they would wait for each other");
            assert!(refused.to_string().contains(&format!("priority {own}")), "{refused}");
        }
    }
}
