//! The thread `safe-output`, which makes outputs safe when their deadlines pass. It never waits for another
//! thread. New outputs arrive through a queue; if its lock is taken, the thread tries again a little later.
//! The [`WatchState`] holds the state of an output that the thread reads without the output's lock.

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
    DataId, Protection, SAFE_OUTPUT_PRIORITY, State,
    log_queue::{self, LogEntry, PendingLog},
    overview::{self, PublishedState},
    stop_latch::StopLatch,
};
use crate::{
    supervision::{realtime_priority, set_highest_priority},
    tid::Tid,
    time::Time,
};

/// Maximum number of outputs without an owner for which the safe function is still retried.
const RETRIED_MAX: usize = 256;
/// Time for the thread to start.
const STARTS_WITHIN: Duration = Duration::from_secs(5);
/// Time after which the thread tries again to lock an output or its queue.
const LOCK_RETRY: Duration = Duration::from_micros(100);
/// Time after which the thread hands over objects to drop again.
const DISCARD_RETRY: Duration = Duration::from_millis(10);
/// Maximum sleep of the thread; it is woken when work arrives.
const IDLE: Duration = Duration::from_secs(3_600);

/// The state of an output that the thread reads without a lock.
pub(super) struct WatchState {
    /// When the thread must check the output, in nanoseconds; `u64::MAX` while the output is safe.
    pub(super) deadline: AtomicU64,
    /// A trip is pending from a caller that could not lock the output.
    pub(super) is_tripped: AtomicBool,
    /// A release is pending: the output becomes an orphan as soon as it is safe.
    pub(super) is_releasing: AtomicBool,
    /// The guard has no owner any more.
    pub(super) is_orphan: AtomicBool,
    /// The output must be made safe, and the last attempt failed.
    pub(super) needs_retry: AtomicBool,
    /// The state of the output, for reports.
    pub(super) published: PublishedState,
    /// Time from the last command until the output was safe, in a dry run, in nanoseconds; 0: there was none.
    pub(super) measured_ns: AtomicU64,
    /// The limits of the commands.
    pub(super) protection: Protection,
    /// The stop of the node.
    pub(super) stop: Arc<StopLatch>,
    /// The number of presses that the application has acknowledged.
    acknowledged: AtomicU64,
    /// Whether the output is counted at `stop` as not safe.
    is_counted: AtomicBool,
}

impl WatchState {
    pub(super) fn new(
        deadline: u64,
        needs_retry: bool,
        (stop, app): (Arc<StopLatch>, Tid),
        protection: Protection,
    ) -> Self {
        let acknowledged = stop.acknowledged(app);
        let state = Self {
            deadline: AtomicU64::new(deadline),
            is_tripped: AtomicBool::new(false),
            is_releasing: AtomicBool::new(false),
            is_orphan: AtomicBool::new(false),
            needs_retry: AtomicBool::new(needs_retry),
            published: PublishedState::not_armed(),
            measured_ns: AtomicU64::new(0),
            protection,
            stop,
            acknowledged: AtomicU64::new(acknowledged),
            is_counted: AtomicBool::new(false),
        };
        state.count(needs_retry);
        state
    }

    /// Returns whether a stop was pressed that the application has not acknowledged.
    #[inline]
    pub(super) fn must_stop(&self) -> bool {
        self.stop.read().presses() != self.acknowledged.load(Ordering::SeqCst)
    }

    /// Returns whether no stop forbids to arm the output.
    pub(super) fn may_arm(&self) -> bool {
        self.stop.read().is_released() && !self.must_stop()
    }

    /// Acknowledges all presses so far, if no stop is in force, for this output and those that `app` makes later. A
    /// later press counts again.
    pub(super) fn acknowledge(&self, app: Tid) -> bool {
        let now = self.stop.read();
        if now.is_stopped() {
            return false;
        }
        if self.acknowledged.swap(now.presses(), Ordering::SeqCst) != now.presses() {
            self.stop.record_acknowledged(app, now.presses());
        }
        true
    }

    /// Counts the output as not safe, or as safe. The caller holds its lock.
    fn count(&self, is_not_safe: bool) {
        // SYNC: by that lock. So a decision that changes nothing costs a load, and no exchange.
        if self.is_counted.load(Ordering::Relaxed) == is_not_safe {
            return;
        }
        self.is_counted.store(is_not_safe, Ordering::Relaxed);
        if is_not_safe {
            self.stop.count();
        } else {
            self.stop.discount();
        }
    }

    /// Publishes the result of a decision: whether the output must be made safe again, and its state.
    pub(super) fn publish(&self, needs_retry: bool, state: State) {
        self.needs_retry.store(needs_retry, Ordering::Release);
        self.published.set(state);
        self.count(needs_retry || state == State::Live);
    }
}

impl Drop for WatchState {
    fn drop(&mut self) {
        self.count(false);
    }
}

/// The result of a check of an output.
pub(super) enum CheckResult {
    /// The output is locked by another thread.
    Locked,
    /// The output was checked; the log entry, if there is one.
    Done(Option<LogEntry>),
}

/// An output, as the thread uses it.
pub(super) trait WatchedOutput: Send + Sync {
    /// Makes the output safe if its deadline has passed.
    fn try_expire(&self) -> CheckResult;
    /// Returns the state that is readable without the output's lock.
    fn watch(&self) -> &WatchState;
}

/// The interface of other threads to the thread of this process.
#[derive(Default)]
pub(super) struct SafeOutputThread {
    /// The queue of new outputs. Other threads hold this lock for a push, and can be preempted with it for
    /// any time: the thread never waits for it.
    arrivals: Mutex<Vec<Arrival>>,
    /// Number of outputs without an owner that are not safe yet.
    orphans: AtomicUsize,
}

/// An output that the thread must watch from now on.
pub(super) enum Arrival {
    Watched(WatchEntry),
    /// An output without an owner that is not safe yet.
    Orphan(Arc<dyn WatchedOutput>),
}

/// An object that the thread no longer needs.
#[expect(dead_code, reason = "it is there to be dropped, by another thread")]
pub(super) enum Discarded {
    WatchEntry(WatchEntry),
    Output(Arc<dyn WatchedOutput>),
}

/// One watched output. Its owners keep it alive, and it is dropped with the last of them.
pub(super) struct WatchEntry {
    watch: Arc<WatchState>,
    output: Weak<dyn WatchedOutput>,
}

static SHARED: OnceLock<SafeOutputThread> = OnceLock::new();
static THREAD: OnceLock<Thread> = OnceLock::new();
/// The thread's real-time priority, 0 for none.
static GRANTED: AtomicU8 = AtomicU8::new(0);

/// Starts the thread if necessary, and checks that its priority is above that of the calling thread.
///
/// # Errors
/// The thread cannot be started or does not begin in time, or the calling thread could keep it from running.
pub(super) fn started() -> io::Result<&'static SafeOutputThread> {
    let shared = start()?;
    check_priority(GRANTED.load(Ordering::Acquire), realtime_priority())?;
    Ok(shared)
}

/// Rejects a calling thread that `safe-output` cannot preempt. A SCHED_FIFO thread does not preempt another
/// one of the same priority, so a hung application would keep its outputs as they are.
fn check_priority(granted: u8, own: u8) -> io::Result<()> {
    if own == 0 || own < granted {
        return Ok(());
    }
    Err(io::Error::new(
        io::ErrorKind::PermissionDenied,
        format!(
            "this thread has the real-time priority {own}, and the thread `safe-output` was granted {granted} (0: none), so it would not run while this \
             thread hangs: allow {SAFE_OUTPUT_PRIORITY} with `ulimit -r 99` or `setcap cap_sys_nice+ep` on the program, or take a lower one for this thread"
        ),
    ))
}

fn start() -> io::Result<&'static SafeOutputThread> {
    static STARTING: Mutex<()> = Mutex::new(());
    let shared = SHARED.get_or_init(SafeOutputThread::default);
    let _one_at_a_time = STARTING.lock().unwrap_or_else(PoisonError::into_inner);
    if THREAD.get().is_none() {
        log_queue::begin()?;
        let (prepared, is_prepared) = sync_channel(0);
        let thread = thread::Builder::new().name("safe-output".to_owned()).spawn(move || {
            let granted = set_highest_priority("safe-output", SAFE_OUTPUT_PRIORITY);
            GRANTED.store(granted, Ordering::Release);
            // If the caller timed out, a later call starts another thread.
            if prepared.send(()).is_ok() {
                WatchLoop::default().run(shared);
            }
        })?;
        // Until it is prepared, the new thread has this thread's CPUs and priority: a thread that never
        // sleeps would keep it from starting.
        is_prepared.recv_timeout(STARTS_WITHIN).map_err(|_| {
            io::Error::other(format!(
                "the thread 'safe-output' has not started within {STARTS_WITHIN:?}: does a thread of a higher real-time priority keep all CPUs?"
            ))
        })?;
        THREAD.get_or_init(|| thread.thread().clone());
    }
    Ok(shared)
}

/// Wakes the thread because a deadline is earlier than it knows. Takes no lock.
pub(super) fn wake() {
    if let Some(thread) = THREAD.get() {
        thread.unpark();
    }
}

/// Retries to make an output safe after its last owner dropped it.
pub(super) fn retry_orphan(output: Arc<dyn WatchedOutput>) {
    SHARED.get_or_init(SafeOutputThread::default).retry_orphan(output);
}

impl SafeOutputThread {
    pub(super) fn watch(&self, data_id: DataId, watch: Arc<WatchState>, output: Weak<dyn WatchedOutput>) {
        overview::add(data_id, &watch);
        self.push_arrival(Arrival::Watched(WatchEntry { watch, output }));
    }

    fn retry_orphan(&self, output: Arc<dyn WatchedOutput>) {
        if self.orphans.fetch_add(1, Ordering::Relaxed) < RETRIED_MAX {
            self.push_arrival(Arrival::Orphan(output));
            return;
        }
        self.orphans.fetch_sub(1, Ordering::Relaxed);
        crate::log::error!(
            "an output that is not safe is abandoned: the safe functions of {RETRIED_MAX} other outputs without an owner fail"
        );
    }

    fn push_arrival(&self, arrival: Arrival) {
        self.lock().push(arrival);
        wake();
    }

    pub(super) fn lock(&self) -> MutexGuard<'_, Vec<Arrival>> {
        self.arrivals.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The local state of the thread.
#[derive(Default)]
struct WatchLoop {
    entries: Vec<WatchEntry>,
    /// Outputs without an owner that are not safe yet.
    orphans: Vec<Arc<dyn WatchedOutput>>,
    /// Outputs that are due in this round.
    due: Vec<Weak<dyn WatchedOutput>>,
    pending_log: PendingLog,
    /// Objects to drop: freeing memory may wait for another thread that does the same, so the logging thread
    /// drops them.
    discarded: Vec<Discarded>,
}

impl WatchLoop {
    fn run(mut self, shared: &SafeOutputThread) -> ! {
        loop {
            let sleeps = self.round(shared);
            if !sleeps.is_zero() {
                thread::park_timeout(sleeps);
            }
        }
    }

    /// Makes due outputs safe. Returns how long the thread may sleep if it is not woken.
    fn round(&mut self, shared: &SafeOutputThread) -> Duration {
        let has_all = self.drain_arrivals(shared);
        // Entries of the previous round: all outputs that were due then are safe.
        let is_log_handed_over = self.pending_log.hand_over(&mut self.discarded);
        let soon = if has_all && is_log_handed_over { IDLE } else { LOCK_RETRY };
        self.release_orphans(shared);
        let sleeps = self.collect_due(Time::now()).min(soon);
        let sleeps = if self.discarded.is_empty() { sleeps } else { sleeps.min(DISCARD_RETRY) };
        if self.due.is_empty() {
            return sleeps;
        }
        let mut are_locked = true;
        for output in self.due.drain(..) {
            // A panic of the safe function is caught at its call. Here an output may panic in its drop, if
            // its last owner has just gone.
            let tried = catch_unwind(AssertUnwindSafe(|| {
                let Some(output) = output.upgrade() else { return CheckResult::Done(None) };
                let tried = output.try_expire();
                if Arc::strong_count(&output) == 1 {
                    self.discarded.push(Discarded::Output(output));
                }
                tried
            }));
            match tried.unwrap_or(CheckResult::Done(None)) {
                CheckResult::Locked => {}
                CheckResult::Done(log_entry) => {
                    are_locked = false;
                    self.pending_log.note(log_entry);
                }
            }
        }
        if are_locked { LOCK_RETRY.min(sleeps) } else { Duration::ZERO }
    }

    /// Moves new outputs from the queue. Returns `false` if the queue is locked by another thread.
    fn drain_arrivals(&mut self, shared: &SafeOutputThread) -> bool {
        let mut arrivals = match shared.arrivals.try_lock() {
            Ok(arrivals) => arrivals,
            Err(TryLockError::Poisoned(poisoned)) => poisoned.into_inner(),
            Err(TryLockError::WouldBlock) => return false,
        };
        // The queue keeps its memory, which other threads allocated: freeing it could wait for one of them.
        for arrival in arrivals.drain(..) {
            match arrival {
                Arrival::Watched(entry) => self.entries.push(entry),
                Arrival::Orphan(output) => self.orphans.push(output),
            }
        }
        true
    }

    /// Releases outputs without an owner that are safe now.
    fn release_orphans(&mut self, shared: &SafeOutputThread) {
        let mut at = 0;
        while let Some(output) = self.orphans.get(at) {
            if output.watch().needs_retry.load(Ordering::Acquire) {
                at += 1;
                continue;
            }
            self.discarded.push(Discarded::Output(self.orphans.swap_remove(at)));
            shared.orphans.fetch_sub(1, Ordering::Relaxed);
        }
    }

    /// Collects the outputs that are due. Returns the time until the next deadline.
    fn collect_due(&mut self, now: Time) -> Duration {
        let Self { entries, due, discarded, .. } = self;
        let (mut sleeps, mut at) = (IDLE, 0);
        while let Some(WatchEntry { watch, output }) = entries.get(at) {
            let left = Time::from_nanos(watch.deadline.load(Ordering::Acquire)).since(now);
            let is_stopped = watch.must_stop() && watch.published.is_live();
            if left.is_zero() || is_stopped || watch.is_tripped.load(Ordering::Acquire) {
                due.push(output.clone());
            } else {
                sleeps = sleeps.min(left);
            }
            if output.strong_count() > 0 {
                at += 1;
            } else {
                discarded.push(Discarded::WatchEntry(entries.swap_remove(at)));
            }
        }
        sleeps
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn thread_as_urgent_as_safe_output_gets_no_guard() {
        for (granted, own) in [(90, 89), (80, 79), (2, 1), (90, 0), (0, 0)] {
            assert!(check_priority(granted, own).is_ok(), "{own} below {granted}");
        }
        for (granted, own) in [(90, 90), (80, 80), (80, 89), (0, 1)] {
            let refused = check_priority(granted, own).expect_err("they would wait for each other");
            assert!(refused.to_string().contains(&format!("priority {own}")), "{refused}");
        }
    }
}
