//! The watchdog: one thread that checks every actor of a node, and reports hung ones.
//!
//! It reads the state that the actors' threads write (`liveness`), judges (`suspect`, pure), and acts on a
//! hang: the incarnation is fenced at once, its thread is demoted, its supervisor is notified. It logs
//! nothing and takes no lock that an actor's code could hold, so that a hung actor cannot block it.

mod account;
mod deadline_extension;
mod lateness;
mod processor;
mod rest;
#[cfg(test)]
mod rest_tests;
mod round;
mod suspect;

use std::{
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{
        Arc, Mutex, Once, Weak,
        atomic::{AtomicUsize, Ordering},
        mpsc::{RecvTimeoutError, SyncSender, sync_channel},
    },
    thread::JoinHandle,
    time::Duration,
};

pub(super) use deadline_extension::DeadlineExtension;
use lateness::Lateness;
use processor::sample;
use rest::{Pace, Rest};
use round::Round;
use suspect::{Check, Hang, Stall, StallSuspect, TurnSuspect};

use super::{
    Reason,
    actor_handle::{ActorEvent, ActorHandle},
    liveness::Neighbours,
    panics::panic_message,
    place::set_realtime_priority,
};
use crate::{
    lock,
    thread::{mark_runtime_thread, system},
    time::Time,
};

/// Maximum time between two checks of an actor with a turn in progress.
const PERIOD_MAX: Duration = Duration::from_millis(5);
/// The same if no turn is in progress and no messages wait: each check wakes a CPU.
const IDLE_PERIOD_MAX: Duration = Duration::from_millis(40);
/// The same if the whole node [rests](rest).
const REST_PERIOD_MAX: Duration = Duration::from_millis(250);
/// Fraction of a budget that may pass between two checks at rest. A turn is seen long before its end, and messages
/// that wait before the probe at half of the budget.
const REST_BUDGET_DIVISOR: u32 = 4;
/// Fraction of a budget that may pass until a turn in progress is seen. CPU time that the actor did not get
/// before that is not excused.
const IDLE_BUDGET_DIVISOR: u32 = 25;
/// Minimum time between two checks, for any budget.
const PERIOD_MIN: Duration = Duration::from_millis(1);
/// Above every actor: the thread runs for microseconds at a time.
const PRIORITY: u8 = 95;
/// Time for the thread to start, if a caller waits for that.
const STARTS_WITHIN: Duration = Duration::from_secs(5);
/// Maximum number of watched incarnations. Further ones are not watched, which is logged.
const WATCHED_MAX: usize = 4_096;

/// The watchdog of a node. Its thread is created when the first incarnation is watched, and ends with this.
#[derive(Debug, Default)]
pub(super) struct Watchdog {
    shared: Arc<Shared>,
    thread: Mutex<Option<JoinHandle<()>>>,
}

#[derive(Default)]
struct Shared {
    arrivals: Mutex<Vec<Watched>>,
    /// Locked by the thread during a check; outlives the thread.
    table: Mutex<Table>,
    count: AtomicUsize,
    lateness: Arc<Lateness>,
}

/// The watched incarnations, and how often they are checked.
#[derive(Default)]
struct Table {
    watched: Vec<Watched>,
    rest: Rest,
}

impl std::fmt::Debug for Shared {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} incarnations", self.count.load(Ordering::Relaxed))
    }
}

impl Watchdog {
    /// Watches an incarnation until it ends, if it has a budget.
    pub(super) fn watch(&self, handle: &ActorHandle) {
        let Some(budget) = handle.progress_within() else { return };
        if self.shared.count.fetch_add(1, Ordering::Relaxed) >= WATCHED_MAX {
            self.shared.count.fetch_sub(1, Ordering::Relaxed);
            let name = handle.liveness().name();
            crate::log::error!(
                name,
                WATCHED_MAX,
                "the watchdog's table is full: a hang of this actor is not detected"
            );
            return;
        }
        lock(&self.shared.arrivals).push(Watched::new(handle.clone(), budget));
        self.wake();
    }

    /// Starts the account of the CPU time that this incarnation gets for one step, which can extend its deadline.
    pub(super) fn deadline_extension(&self, handle: &ActorHandle, within: Duration) -> DeadlineExtension {
        let extension = DeadlineExtension::new(handle.clone(), within, self.shared.lateness.clone());
        self.wake();
        extension
    }

    /// Creates the thread, and waits until it no longer depends on the calling one. Until then it has the
    /// CPUs and the priority of the calling thread, which would keep it from starting by never sleeping.
    pub(super) fn begin(&self) {
        let (prepared, is_prepared) = sync_channel(1);
        self.wake_or_make(Some(prepared));
        // A failure to create the thread was logged before.
        if is_prepared.recv_timeout(STARTS_WITHIN) == Err(RecvTimeoutError::Timeout) {
            crate::log::error!(
                "the watchdog has not begun within {STARTS_WITHIN:?}: does a thread of a higher real-time priority keep all CPUs?"
            );
        }
    }

    /// Wakes the thread; creates it if it does not exist.
    fn wake(&self) {
        self.wake_or_make(None);
    }

    fn wake_or_make(&self, prepared: Option<SyncSender<()>>) {
        let mut thread = lock(&self.thread);
        if let Some(thread) = thread.as_ref().filter(|thread| !thread.is_finished()) {
            return thread.thread().unpark();
        }
        let shared = Arc::downgrade(&self.shared);
        match std::thread::Builder::new().name("watchdog".to_owned()).spawn(move || run(&shared, prepared)) {
            Ok(new) => *thread = Some(new),
            Err(error) => crate::log::error!(%error, "no thread for the watchdog: hangs are not detected"),
        }
    }
}

impl Drop for Watchdog {
    fn drop(&mut self) {
        // The thread sees that its owner is gone, and ends.
        self.shared = Arc::default();
        if let Some(thread) = lock(&self.thread).as_ref() {
            thread.thread().unpark();
        }
    }
}

fn run(shared: &Weak<Shared>, prepared: Option<SyncSender<()>>) {
    mark_runtime_thread();
    // The creating thread may be pinned to one CPU, and hang there. If this is refused, the thread stays there too.
    let _ = system::unpin();
    if let Err(error) = set_realtime_priority(PRIORITY) {
        static LOGGED: Once = Once::new();
        LOGGED.call_once(|| {
            // Usual on a development computer; a refused priority of an actor is logged as a warning.
            crate::log::info!(
                ?error,
                "the watchdog has no real-time priority: on a busy CPU it notices a hang late; allow it with `ulimit -r 99`"
            );
        });
    }
    if let Some(prepared) = prepared {
        // A caller that timed out has logged that.
        let _ = prepared.send(());
    }
    while let Some(shared) = shared.upgrade() {
        // A fault here must not leave the node without a watchdog.
        let result = catch_unwind(AssertUnwindSafe(|| shared.check()));
        let next = result.unwrap_or_else(|panic| {
            crate::log::error!(panic = panic_message(panic), "the watchdog panicked, and continues");
            Some(Time::now() + PERIOD_MAX)
        });
        shared.lateness.set_due(next);
        // The owner must be able to end the thread while it sleeps.
        drop(shared);
        match next {
            Some(next) => std::thread::park_timeout(next.since(Time::now())),
            None => std::thread::park(),
        }
    }
}

impl Shared {
    /// Checks all watched actors. Returns when the next check is due; `None` if none are watched.
    fn check(&self) -> Option<Time> {
        let now = Time::now();
        let late = self.lateness.record_check(now);
        let mut table = lock(&self.table);
        let Table { watched: table, rest } = &mut *table;
        let former = table.len();
        table.append(&mut lock(&self.arrivals));
        let reading = self.lateness.has_readers().then_some(PERIOD_MAX);
        let period = table.iter().map(|watched| watched.period).chain(reading).min()?;
        let before = table.len();
        let mut round = Round::new(now, late, period, rest.pace());
        table.retain_mut(|watched| check_one(watched, &mut round));
        self.count.fetch_sub(before - table.len(), Ordering::Relaxed);
        let is_same = former == before && before == table.len();
        let may_rest = is_same && reading.is_none() && table.iter().all(Watched::may_rest);
        let turns = table.iter().fold(0_u64, |sum, watched| sum.wrapping_add(watched.turns()));
        let pace = rest.check(now, turns, may_rest);
        if pace.is_marked() || round.pace.is_marked() {
            table.iter().for_each(|watched| watched.handle.liveness().set_records(pace.is_marked()));
        }
        let check_interval = table.iter().map(|watched| watched.check_interval(pace)).chain(reading).min()?;
        let deadline = table.iter().filter_map(Watched::deadline).min();
        // A late actor waits for a CPU, or was just checked: the next check is after a period.
        let deadline = deadline.filter(|deadline| *deadline > now);
        Some(deadline.map_or(now + check_interval, |deadline| deadline.min(now + check_interval)))
    }
}

/// Checks one incarnation. Returns whether it must be watched further.
fn check_one(watched: &mut Watched, round: &mut Round) -> bool {
    let liveness = watched.handle.liveness();
    let has_ended = liveness.has_ended() || liveness.is_fenced();
    let goes_on = !has_ended && check_living(watched, round);
    if !goes_on {
        // The next incarnation has the same mailbox, and is not watched yet.
        watched.handle.liveness().set_records(false);
    }
    goes_on
}

fn check_living(watched: &mut Watched, round: &mut Round) -> bool {
    match catch_unwind(AssertUnwindSafe(|| watched.check(round))) {
        Ok(goes_on) => goes_on,
        Err(panic) => {
            let name = watched.handle.liveness().name();
            crate::log::error!(
                name,
                panic = panic_message(panic),
                "the watchdog panicked over this actor, and no longer watches it"
            );
            false
        }
    }
}

/// One watched incarnation.
struct Watched {
    handle: ActorHandle,
    budget: Duration,
    period: Duration,
    turn: TurnSuspect,
    stall: StallSuspect,
    /// At rest: a number that changes with each turn of the thread's actors, and how long the thread had waited for a
    /// CPU then, in nanoseconds.
    rested: Option<(u64, u64)>,
}

impl Watched {
    fn new(handle: ActorHandle, budget: Duration) -> Self {
        let period = (budget / 10).clamp(PERIOD_MIN, PERIOD_MAX);
        let (turn, stall) = (TurnSuspect::new(budget), StallSuspect::new(budget));
        Self { handle, budget, period, turn, stall, rested: None }
    }

    /// Returns whether nothing is in progress or waits, and all that begins at rest can be recorded.
    fn may_rest(&self) -> bool {
        let is_open = self.turn.is_open() || self.stall.is_open() || self.stall.has_waiting();
        !is_open && self.handle.liveness().can_record()
    }

    /// Returns the number of its present or last turn.
    fn turns(&self) -> u64 {
        self.handle.liveness().snapshot().turn
    }

    /// Returns the time until the next check, unless a deadline is earlier.
    fn check_interval(&self, pace: Pace) -> Duration {
        if self.turn.is_open() || self.stall.is_open() {
            return self.period;
        }
        let (divisor, most) = match pace {
            Pace::Alert | Pace::Marking => (IDLE_BUDGET_DIVISOR, IDLE_PERIOD_MAX),
            Pace::Resting => (REST_BUDGET_DIVISOR, REST_PERIOD_MAX),
        };
        (self.budget / divisor).clamp(self.period, most)
    }

    fn deadline(&self) -> Option<Time> {
        self.turn.deadline(self.handle.liveness().snapshot())
    }

    fn check(&mut self, round: &mut Round) -> bool {
        let liveness = self.handle.liveness();
        let check = Check { now: round.now, late: round.late, snapshot: liveness.snapshot() };
        let slot = self.handle.slot().cloned();
        let cpu = || sample(slot.as_ref()?.tid()?);
        if let Some(hang) = self.turn.check(check, round.period, cpu) {
            let what = format!("{} has not come back", liveness.describe(check.snapshot.activity));
            self.report_hang(hang, &what, true);
            return false;
        }
        if round.pace.is_marked() {
            self.account_at_rest(check, round);
        } else {
            self.rested = None;
        }
        self.check_for_stall(check, cpu)
    }

    /// Keeps an account of the thread of an idle actor. So the time in which it gets no CPU is known also for the
    /// beginning of a turn that a rare check sees late.
    fn account_at_rest(&mut self, check: Check, round: &mut Round) {
        let Some(slot) = self.handle.slot() else { return };
        let Some(tid) = slot.tid() else { return };
        if check.snapshot.is_busy() {
            if let Some((_, rested)) = self.rested.take() {
                self.turn.excuse_start(check, rested, sample(tid));
            }
            return;
        }
        let thread = round.thread(tid, slot);
        // An actor without a supervisor is not among the thread's actors, so its own turns are added. Those of others
        // count twice then, which changes nothing: only a difference from the former number counts.
        let turns = thread.turns.wrapping_add(check.snapshot.turn);
        // A thread without turns has waited for no CPU.
        if self.rested.is_none_or(|(former, _)| former != turns) {
            self.rested = thread.waited().map(|waited| (turns, waited));
        }
    }

    fn check_for_stall(&mut self, check: Check, cpu: impl FnOnce() -> Option<processor::Sample>) -> bool {
        let liveness = self.handle.liveness();
        if !liveness.should_take() {
            self.stall.reset(check.now);
            return true;
        }
        // No judgement while the mailbox is locked: then it is in use.
        let Some(backlog) = liveness.backlog() else { return true };
        let waiting = backlog.waiting;
        let neighbours =
            || self.handle.slot().map_or_else(Neighbours::default, |slot| slot.neighbours_of(&self.handle));
        match self.stall.check(check, backlog, neighbours, cpu) {
            Stall::None => true,
            Stall::Probe => {
                self.handle.wake();
                true
            }
            Stall::Waits(hang) => {
                let what = format!("waits on a future; {waiting} messages wait for it");
                self.report_hang(hang, &what, false);
                false
            }
            Stall::ThreadIsAway(hang) => {
                let what = format!(
                    "its thread does not come back from something that is no actor's; {waiting} messages wait"
                );
                self.report_hang(hang, &what, true);
                false
            }
        }
    }

    /// Fences the incarnation, reports it, and only then does the slow steps.
    fn report_hang(&self, hang: Hang, what: &str, blocks_thread: bool) {
        let Hang { since, lasted, excused } = hang;
        let liveness = self.handle.liveness();
        liveness.fence();
        if blocks_thread {
            self.handle.set_blocks_thread(since);
        }
        let mut words = format!("{what}, for {lasted:.1?} of {:?} allowed", self.budget);
        if !excused.is_zero() {
            words.push_str(&format!(" (without {excused:.1?} in which it had no CPU)"));
        }
        self.handle.report(ActorEvent::Hung(Reason::Hung(words)));
        if blocks_thread && let Some(slot) = self.handle.slot() {
            slot.demote();
        }
        liveness.release_inbox();
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::sync_channel;

    use super::*;
    use crate::supervision::{
        actor_handle::Report,
        liveness::{Activity, Liveness},
    };

    /// An incarnation in the middle of a turn that began long ago.
    fn hung(report: Report) -> ActorHandle {
        let liveness = Liveness::new("hung");
        liveness.begin(Activity::Timer, Some(Time::from_nanos(1)));
        ActorHandle::new(liveness, None, Some(Duration::from_millis(20)), report)
    }

    #[test]
    fn watchdog_continues_after_a_panic_over_one_actor() {
        let watchdog = Watchdog::default();
        let (say, heard) = sync_channel(1);
        watchdog.watch(&hung(Box::new(|_| panic!("whoever hears of it panics"))));
        let told = hung(Box::new(move |event| say.send(format!("{event:?}")).expect("it is waited for")));
        watchdog.watch(&told);
        let event = heard.recv_timeout(Duration::from_secs(20)).expect("the other one is accused");
        assert!(event.contains("in a timer has not come back"), "{event}");
        assert!(told.liveness().is_fenced());
    }

    /// Time until the next check of an incarnation with this budget.
    fn check_interval(liveness: &Arc<Liveness>, budget: Duration, pace: Pace) -> Duration {
        let handle =
            ActorHandle::new(liveness.clone(), None, Some(budget), Box::new(|event| panic!("{event:?}")));
        let mut watched = Watched::new(handle, budget);
        let (now, late, period) = (Time::from_nanos(2), Duration::ZERO, PERIOD_MAX);
        assert!(watched.check(&mut Round::new(now, late, period, pace)));
        watched.check_interval(pace)
    }

    #[test]
    fn idle_incarnation_is_checked_rarely() {
        let liveness = Liveness::new("idle");
        let interval = |ms, pace| check_interval(&liveness, Duration::from_millis(ms), pace).as_millis();
        let rests = [20, 100, 500, 1_000, 60_000].map(|ms| interval(ms, Pace::Alert));
        assert_eq!(rests, [20, 100, 500, 1_000, 60_000].map(|ms| interval(ms, Pace::Marking)));
        assert_eq!(
            rests,
            [2, 5, 20, 40, 40],
            "a 25th of its budget, 40 ms at most, and not less than a period"
        );
        let rests = [8, 20, 100, 1_000, 60_000].map(|ms| interval(ms, Pace::Resting));
        assert_eq!(rests, [2, 5, 25, 250, 250], "a quarter of its budget, 250 ms at most");
        liveness.begin(Activity::Timer, Some(Time::from_nanos(1)));
        let rests = [20, 100, 1_000].map(|ms| interval(ms, Pace::Resting));
        assert_eq!(
            rests,
            [2, 5, 5],
            "once it is in the middle of something, as often as its end is to be seen"
        );
    }

    #[test]
    fn ended_or_unlimited_incarnation_is_not_accused() {
        let watchdog = Watchdog::default();
        let accused = || -> Report { Box::new(|event| panic!("{event:?}")) };
        let gone = hung(accused());
        gone.liveness().set_ended();
        let free = ActorHandle::new(hung(accused()).liveness().clone(), None, None, accused());
        watchdog.watch(&gone);
        watchdog.watch(&free);
        let (say, heard) = sync_channel(1);
        watchdog.watch(&hung(Box::new(move |_| say.send(()).expect("it is waited for"))));
        heard.recv_timeout(Duration::from_secs(20)).expect("one that came after them is accused");
        assert!(!gone.liveness().is_fenced() && !free.liveness().is_fenced());
    }
}
