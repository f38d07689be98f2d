//! The watchdog: one thread that looks at every actor of a node, and says who does not come back.
//!
//! It reads what the actors' threads write (`vitals`), judges (`suspect`, pure), and accuses: the life is fenced at once,
//! its thread is demoted, its supervisor is told. It logs nothing and takes no lock that an actor's code could hold, so
//! that what hangs an actor does not hang it.

mod account;
mod lateness;
mod processor;
mod reprieve;
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

use lateness::Lateness;
use processor::sample;
pub(super) use reprieve::Reprieve;
use suspect::{Hang, Look, Stall, StallSuspect, TurnSuspect};

use super::{
    Reason,
    panics::{is_the_runtimes, words},
    place::make_realtime,
    system,
    tenant::{Fate, Tenant},
    vitals::Neighbours,
};
use crate::{post::lock, time::Time};

/// Time between two looks at most, at who is in the middle of something.
const PERIOD_MAX: Duration = Duration::from_millis(5);
/// The same while nobody is, and nobody lets messages wait: each look wakes a CPU.
const REST_MAX: Duration = Duration::from_millis(40);
/// Of a budget: so much at most goes by before it is seen that somebody is in the middle of something, and what he was not given
/// meanwhile is not excused.
const REST_OF_BUDGET: u32 = 25;
/// Time between two looks at least, however small a budget is.
const PERIOD_MIN: Duration = Duration::from_millis(1);
/// Above every actor: it runs for microseconds at a time.
const PRIORITY: u8 = 95;
/// Time that the thread has to begin, where somebody waits for that.
const BEGINS_WITHIN: Duration = Duration::from_secs(5);
/// Lives that are watched at once at most. One more lives unwatched, and that is said.
const WATCHED_MAX: usize = 4_096;

/// The watchdog of a node. Its thread is made when the first life is to be watched, and ends with this.
#[derive(Debug, Default)]
pub(super) struct Watchdog {
    shared: Arc<Shared>,
    thread: Mutex<Option<JoinHandle<()>>>,
}

#[derive(Default)]
struct Shared {
    arrivals: Mutex<Vec<Watched>>,
    /// Held by the thread while it looks; outlives it.
    table: Mutex<Vec<Watched>>,
    count: AtomicUsize,
    lateness: Arc<Lateness>,
}

impl std::fmt::Debug for Shared {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} lives", self.count.load(Ordering::Relaxed))
    }
}

impl Watchdog {
    /// Watches a life until it ends, if it has a budget.
    pub(super) fn watch(&self, tenant: &Tenant) {
        let Some(budget) = tenant.progress_within() else { return };
        if self.shared.count.fetch_add(1, Ordering::Relaxed) >= WATCHED_MAX {
            self.shared.count.fetch_sub(1, Ordering::Relaxed);
            let name = tenant.vitals().name();
            crate::log::error!(
                name,
                WATCHED_MAX,
                "the watchdog's table is full; nobody sees if this one hangs"
            );
            return;
        }
        lock(&self.shared.arrivals).push(Watched::new(tenant.clone(), budget));
        self.wake();
    }

    /// Begins to keep an account of what this life is given of the time that it has for something from now on.
    pub(super) fn reprieve(&self, tenant: &Tenant, within: Duration) -> Reprieve {
        let reprieve = Reprieve::new(tenant.clone(), within, self.shared.lateness.clone());
        self.wake();
        reprieve
    }

    /// Makes the thread, and waits until it depends on the calling one no more. Until then it has that one's CPUs and priority: whoever
    /// never sleeps there would never let it begin.
    pub(super) fn begin(&self) {
        let (prepared, is_prepared) = sync_channel(1);
        self.wake_or_make(Some(prepared));
        // Where there is no thread, that has been said.
        if is_prepared.recv_timeout(BEGINS_WITHIN) == Err(RecvTimeoutError::Timeout) {
            crate::log::error!(
                "the watchdog has not begun within {BEGINS_WITHIN:?}: does a thread of a higher real-time priority keep all CPUs?"
            );
        }
    }

    /// Wakes the thread; makes one if there is none that lives.
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
            Err(error) => crate::log::error!(%error, "no thread for the watchdog; nobody sees who hangs"),
        }
    }
}

impl Drop for Watchdog {
    fn drop(&mut self) {
        // The thread sees that nobody is left to report to.
        self.shared = Arc::default();
        if let Some(thread) = lock(&self.thread).as_ref() {
            thread.thread().unpark();
        }
    }
}

fn run(shared: &Weak<Shared>, prepared: Option<SyncSender<()>>) {
    is_the_runtimes();
    // Whoever woke it first may be kept on one CPU, and hang there. Refused, it stays there, too.
    let _ = system::keep_on_any();
    if let Err(error) = make_realtime(PRIORITY) {
        static SAID: Once = Once::new();
        SAID.call_once(|| {
            // Usual on a computer for development; who asks for a priority for an actor is warned.
            crate::log::info!(
                ?error,
                "the watchdog has no real-time priority: on a busy CPU it notices a hang late; allow it with `ulimit -r 99`"
            );
        });
    }
    if let Some(prepared) = prepared {
        // Whoever waits no more has said so.
        let _ = prepared.send(());
    }
    while let Some(shared) = shared.upgrade() {
        // A fault in here must not leave the node without a watchdog.
        let looked = catch_unwind(AssertUnwindSafe(|| shared.look()));
        let next = looked.unwrap_or_else(|panic| {
            crate::log::error!(said = words(panic), "the watchdog panicked, and goes on");
            Some(Time::now() + PERIOD_MAX)
        });
        shared.lateness.is_due(next);
        // Whoever owns this must be able to end it while it sleeps.
        drop(shared);
        match next {
            Some(next) => std::thread::park_timeout(next.since(Time::now())),
            None => std::thread::park(),
        }
    }
}

impl Shared {
    /// One look at everybody. Returns when the next is due; `None` if there is nobody.
    fn look(&self) -> Option<Time> {
        let now = Time::now();
        let late = self.lateness.looks(now);
        let mut table = lock(&self.table);
        table.append(&mut lock(&self.arrivals));
        let reading = self.lateness.has_readers().then_some(PERIOD_MAX);
        let period = table.iter().map(|watched| watched.period).chain(reading).min()?;
        let before = table.len();
        table.retain_mut(|watched| look_at(watched, now, late, period));
        self.count.fetch_sub(before - table.len(), Ordering::Relaxed);
        let rest = table.iter().map(Watched::rest).chain(reading).min()?;
        let deadline = table.iter().filter_map(Watched::deadline).min();
        // One that is over already waits for a CPU, or has just been seen: it is looked at again after a period.
        let deadline = deadline.filter(|deadline| *deadline > now);
        Some(deadline.map_or(now + rest, |deadline| deadline.min(now + rest)))
    }
}

/// Looks at one life. Returns whether it is to be watched further.
fn look_at(watched: &mut Watched, now: Time, late: Duration, period: Duration) -> bool {
    let vitals = watched.tenant.vitals();
    if vitals.is_gone() || vitals.is_over() {
        return false;
    }
    match catch_unwind(AssertUnwindSafe(|| watched.look(now, late, period))) {
        Ok(goes_on) => goes_on,
        Err(panic) => {
            let name = watched.tenant.vitals().name();
            crate::log::error!(
                name,
                said = words(panic),
                "the watchdog panicked over this one and leaves it"
            );
            false
        }
    }
}

/// One life that is watched.
struct Watched {
    tenant: Tenant,
    budget: Duration,
    period: Duration,
    turn: TurnSuspect,
    stall: StallSuspect,
}

impl Watched {
    fn new(tenant: Tenant, budget: Duration) -> Self {
        let period = (budget / 10).clamp(PERIOD_MIN, PERIOD_MAX);
        Self { tenant, budget, period, turn: TurnSuspect::new(budget), stall: StallSuspect::new(budget) }
    }

    /// Time until the next look, unless a deadline comes first.
    fn rest(&self) -> Duration {
        if self.turn.is_open() || self.stall.is_open() {
            return self.period;
        }
        (self.budget / REST_OF_BUDGET).clamp(self.period, REST_MAX)
    }

    fn deadline(&self) -> Option<Time> {
        self.turn.deadline(self.tenant.vitals().sight())
    }

    fn look(&mut self, now: Time, late: Duration, period: Duration) -> bool {
        let vitals = self.tenant.vitals();
        let look = Look { now, late, sight: vitals.sight() };
        let seat = self.tenant.seat().cloned();
        let cpu = || sample(seat.as_ref()?.tid()?);
        if let Some(hang) = self.turn.look(look, period, cpu) {
            let what = format!("{} has not come back", vitals.words(look.sight.doing));
            self.accuse(hang, &what, true);
            return false;
        }
        self.look_for_stall(look, cpu)
    }

    fn look_for_stall(&mut self, look: Look, cpu: impl FnOnce() -> Option<processor::Sample>) -> bool {
        let vitals = self.tenant.vitals();
        if !vitals.should_take() {
            self.stall.calm(look.now);
            return true;
        }
        // Nothing where somebody is in the mailbox this very moment: then things go on.
        let Some((waiting, taken)) = vitals.backlog() else { return true };
        let neighbours =
            || self.tenant.seat().map_or_else(Neighbours::default, |seat| seat.others_than(&self.tenant));
        match self.stall.look(look, (waiting, taken), neighbours, cpu) {
            Stall::None => true,
            Stall::Probe => {
                self.tenant.wake();
                true
            }
            Stall::Waits(hang) => {
                let what = format!("waits on a future; {waiting} messages wait for it");
                self.accuse(hang, &what, false);
                false
            }
            Stall::ThreadIsAway(hang) => {
                let what = format!(
                    "its thread does not come back from something that is no actor's; {waiting} messages wait"
                );
                self.accuse(hang, &what, true);
                false
            }
        }
    }

    /// Fences the life, says so, and only then does what may take time.
    fn accuse(&self, hang: Hang, what: &str, holds_its_thread: bool) {
        let Hang { since, lasted, excused } = hang;
        let vitals = self.tenant.vitals();
        vitals.fence();
        if holds_its_thread {
            self.tenant.set_holds_its_thread(since);
        }
        let mut words = format!("{what}, for {lasted:.1?} of {:?} allowed", self.budget);
        if !excused.is_zero() {
            words.push_str(&format!(" (without {excused:.1?} in which it had no CPU)"));
        }
        self.tenant.report(Fate::Hung(Reason::Hung(words)));
        if holds_its_thread && let Some(seat) = self.tenant.seat() {
            seat.demote();
        }
        vitals.empty_hands();
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::sync_channel;

    use super::*;
    use crate::supervision::{
        tenant::Report,
        vitals::{Doing, Vitals},
    };

    /// A life in the middle of a turn that began long ago.
    fn hung(report: Report) -> Tenant {
        let vitals = Vitals::new("hung");
        vitals.begins(Doing::Timer, Some(Time::from_nanos(1)));
        Tenant::new(vitals, None, Some(Duration::from_millis(20)), report)
    }

    #[test]
    fn a_watchdog_that_panics_over_one_goes_on_with_the_others() {
        let watchdog = Watchdog::default();
        let (say, heard) = sync_channel(1);
        watchdog.watch(&hung(Box::new(|_| panic!("whoever hears of it panics"))));
        let told = hung(Box::new(move |fate| say.send(format!("{fate:?}")).expect("it is waited for")));
        watchdog.watch(&told);
        let fate = heard.recv_timeout(Duration::from_secs(20)).expect("the other one is accused");
        assert!(fate.contains("in a timer has not come back"), "{fate}");
        assert!(told.vitals().is_over());
    }

    /// Time until the next look at a life with this budget.
    fn rest(vitals: &Arc<Vitals>, budget: Duration) -> Duration {
        let tenant = Tenant::new(vitals.clone(), None, Some(budget), Box::new(|fate| panic!("{fate:?}")));
        let mut watched = Watched::new(tenant, budget);
        assert!(watched.look(Time::from_nanos(2), Duration::ZERO, PERIOD_MAX));
        watched.rest()
    }

    #[test]
    fn who_is_in_the_middle_of_nothing_is_looked_at_seldom() {
        let vitals = Vitals::new("calm");
        let rests =
            [20, 100, 500, 1_000, 60_000].map(|ms| rest(&vitals, Duration::from_millis(ms)).as_millis());
        assert_eq!(
            rests,
            [2, 5, 20, 40, 40],
            "a 25th of its budget, 40 ms at most, and not less than a period"
        );
        vitals.begins(Doing::Timer, Some(Time::from_nanos(1)));
        let rests = [20, 100, 1_000].map(|ms| rest(&vitals, Duration::from_millis(ms)).as_millis());
        assert_eq!(
            rests,
            [2, 5, 5],
            "once it is in the middle of something, as often as its end is to be seen"
        );
    }

    #[test]
    fn a_life_that_has_ended_or_has_no_budget_is_not_accused() {
        let watchdog = Watchdog::default();
        let accused = || -> Report { Box::new(|fate| panic!("{fate:?}")) };
        let gone = hung(accused());
        gone.vitals().set_gone();
        let free = Tenant::new(hung(accused()).vitals().clone(), None, None, accused());
        watchdog.watch(&gone);
        watchdog.watch(&free);
        let (say, heard) = sync_channel(1);
        watchdog.watch(&hung(Box::new(move |_| say.send(()).expect("it is waited for"))));
        heard.recv_timeout(Duration::from_secs(20)).expect("one that came after them is accused");
        assert!(!gone.vitals().is_over() && !free.vitals().is_over());
    }
}
