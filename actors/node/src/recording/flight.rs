//! The flight recorder of a node: collects the causes, forwards the triggers, and has spans frozen.
//!
//! ```text
//!  guards, watchdogs, supervisors ── Causes ──► thread `record` ── FreezePlan ──► triggers to other nodes
//!  lost nodes, `sinew record freeze` ─────────────┘                    └──► thread `freeze` ──► FrozenStore
//! ```

use std::{
    collections::VecDeque,
    io,
    panic::{AssertUnwindSafe, catch_unwind},
    path::{Path, PathBuf},
    sync::{
        Arc, Condvar, Mutex, MutexGuard, PoisonError, TryLockError, Weak,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    time::Duration,
};

use rustix::fs::{Access, access};
use sinew_model::thread_priority::lower_priority;
use sinew_record::{FrozenFacts, FrozenSpan, RecordReport};
use sinew_runtime::{
    incident::{self, IncidentKind, IncidentObserver},
    lock, log,
    time::Time,
};
use sinew_shm::journal::Journal;

use super::{
    facts::{Changes, write_trigger},
    names::names_for_reader,
    plan::{FreezePlan, Output, SpanOrder, Trigger, TriggerId},
    store::{FrozenError, FrozenStore, move_ring, read_facts, write_facts},
    triggers::forward,
};
use crate::NodeState;

/// Maximum number of causes between two looks. Further ones belong to the same span, or are lost in a flood.
const CAUSES_MAX: usize = 16;
/// Time between two looks at the names beside the journal, if no application has a new name.
const NAMES_PERIOD: Duration = Duration::from_secs(1);

/// The flight recorder of a node.
pub(crate) struct Flight {
    plan: Mutex<FreezePlan>,
    store: Mutex<FrozenStore>,
    /// The folder of the journal as a store: rings of dead incarnations are moved out of it.
    beside: FrozenStore,
    causes: Arc<Causes>,
    work: Mutex<Work>,
    /// Notified when the thread `freeze` ends.
    idle: Condvar,
    /// The time of the first order to stop the node, in nanoseconds; `u64::MAX` before.
    stop_ns: AtomicU64,
    /// Whether the layers have ended: names are those that were written last.
    is_ending: AtomicBool,
    names: Mutex<KnownReport>,
    /// The folder of the journal.
    folder: PathBuf,
    /// Whether the last cause made no trigger. The first one of several is in the log.
    is_refusing: AtomicBool,
    /// Whether spans are kept at all.
    keeps_spans: bool,
    /// Whether the journal, and the names beside it, outlive an orderly end of the node.
    keeps_journal: bool,
}

/// Causes that were reported by any thread of the process.
#[derive(Default)]
struct Causes {
    reported: Mutex<VecDeque<(Time, IncidentKind, String)>>,
    /// Symptoms of which the words are lost.
    lost_symptoms: AtomicU64,
    /// Failures of which the words are lost.
    lost_failures: AtomicU64,
}

impl Causes {
    /// Counts a cause without its words.
    fn lose(&self, kind: IncidentKind) {
        let lost = match kind {
            IncidentKind::Failure => &self.lost_failures,
            IncidentKind::Symptom => &self.lost_symptoms,
        };
        lost.fetch_add(1, Ordering::Relaxed);
    }
}

impl IncidentObserver for Causes {
    fn happened(&self, at: Time, kind: IncidentKind, cause: &str) {
        // The thread may be a real-time one. Another cause is just being stored or read: this one has no words then.
        let Ok(mut reported) = self.reported.try_lock() else {
            self.lose(kind);
            return;
        };
        if reported.len() < CAUSES_MAX {
            reported.push_back((at, kind, cause.to_owned()));
        } else {
            self.lose(kind);
        }
    }
}

/// An order to the thread `freeze`.
enum Order {
    Freeze(SpanOrder),
    /// The ring of a dead incarnation, beside the journal.
    Move(String),
}

/// The orders of the thread `freeze`.
#[derive(Default)]
struct Work {
    /// Spans to freeze, at most one for each known trigger, and rings to move, at most as many as a store has.
    orders: VecDeque<Order>,
    is_running: bool,
}

impl Work {
    /// Takes the first span to freeze, which the journal loses with time, or else the first order.
    fn next(&mut self) -> Option<Order> {
        let first = self.orders.iter().position(|order| matches!(order, Order::Freeze(_)));
        self.orders.remove(first.unwrap_or(0))
    }
}

/// The names that were written beside the journal.
#[derive(Default)]
struct KnownReport {
    written: Option<RecordReport>,
    due: Time,
    has_failed: bool,
}

impl Flight {
    /// Begins it for a node, and keeps the ring of a former incarnation that has died.
    pub(super) fn begin(state: &NodeState, journal: &Path) -> Arc<Self> {
        let config = &state.ctx.config.record;
        let folder = journal.parent().unwrap_or_else(|| Path::new(".")).to_owned();
        let base = journal.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let frozen_folder = config.frozen_folder.clone().unwrap_or_else(|| folder.clone());
        if config.frozen_max > 0
            && let Err(error) = access(&frozen_folder, Access::WRITE_OK | Access::EXEC_OK)
        {
            log::warn!(
                folder = %frozen_folder.display(), %error,
                "no span can be frozen: create the folder of record.frozen_folder, or permit this user to write there"
            );
        }
        let mut store = FrozenStore::new(frozen_folder, base, config.frozen_max);
        store.clean();
        if config.frozen_max > 0 {
            match store.keep_dead_ring(journal) {
                Some(Ok(id)) => {
                    log::warn!(id, "the last incarnation of this node has died: its ring is kept")
                }
                Some(Err(error)) => {
                    log::warn!(%error, "the ring of this node's last incarnation is not kept")
                }
                None => {}
            }
        }
        let (beside, dead) = store.beside(journal);
        beside.clean();
        let mut work = Work::default();
        if config.frozen_max > 0 {
            work.orders.extend(dead.into_iter().map(Order::Move));
        }
        let plan = FreezePlan::new((state.ctx.node, state.ctx.incarnation), config.keep, config.after);
        let causes = Arc::new(Causes::default());
        let observer: Arc<dyn IncidentObserver> = causes.clone();
        // More nodes of one process than have room record without the incidents of the process.
        incident::observe(&observer);
        Arc::new(Self {
            plan: Mutex::new(plan),
            store: Mutex::new(store),
            beside,
            causes,
            work: Mutex::new(work),
            idle: Condvar::new(),
            stop_ns: AtomicU64::new(u64::MAX),
            is_ending: AtomicBool::new(false),
            names: Mutex::default(),
            folder,
            is_refusing: AtomicBool::new(false),
            keeps_spans: config.frozen_max > 0,
            keeps_journal: config.folder.is_some(),
        })
    }

    /// Handles a cause at this node. Returns the trigger that stands for it.
    pub(crate) fn happened(&self, at: Time, cause: &str) -> Option<TriggerId> {
        let id = lock(&self.plan).happened(Time::now().as_nanos(), at.as_nanos(), cause);
        let was_refusing = self.is_refusing.swap(id.is_none(), Ordering::Relaxed);
        if id.is_none() && !was_refusing {
            log::warn!(
                cause,
                "the messages around a fault are not frozen: this node knows too many triggers"
            );
        }
        id
    }

    /// Handles the trigger of another node. Returns `false` if it is refused.
    pub(super) fn received(&self, now: Time, trigger: Trigger) -> bool {
        let mut plan = lock(&self.plan);
        let before = plan.refused();
        plan.received(now.as_nanos(), trigger);
        plan.refused() == before
    }

    /// Returns the frozen spans. It waits while a file is renamed or removed, but not for a copy.
    pub(crate) fn store(&self) -> MutexGuard<'_, FrozenStore> {
        lock(&self.store)
    }

    /// Returns the frozen spans, if no other thread has them.
    pub(crate) fn try_store(&self) -> Option<MutexGuard<'_, FrozenStore>> {
        match self.store.try_lock() {
            Ok(store) => Some(store),
            Err(TryLockError::Poisoned(poisoned)) => Some(poisoned.into_inner()),
            Err(TryLockError::WouldBlock) => None,
        }
    }

    /// Returns the folder of the journal.
    pub(crate) fn folder(&self) -> &Path {
        &self.folder
    }

    /// Handles all causes since the last turn, and carries out the orders that are due. The thread `record` calls it.
    pub(super) fn turn(
        self: &Arc<Self>,
        state: &Arc<NodeState>,
        journal: &Arc<Journal>,
        now: Time,
        changes: &Changes,
    ) {
        self.take_causes(now, &changes.losses);
        self.write_names(state, journal, now, changes.has_new_names);
        let send = |trigger: &Trigger| {
            write_trigger(state, journal, trigger);
            forward(state, trigger);
        };
        while self.poll(now.as_nanos(), send) {}
        if let Err(error) = self.start_work(&Arc::downgrade(state), journal.path()) {
            log::error!(%error, "the system gives no thread to freeze a span; it is asked again");
        }
    }

    /// Takes one output of the plan. Returns `false` if there is none.
    fn poll(&self, now_ns: u64, forward: impl FnOnce(&Trigger)) -> bool {
        // Until the order is among the others: the end of the node must not miss it.
        let mut work = lock(&self.work);
        let output = lock(&self.plan).poll(now_ns);
        match output {
            None => return false,
            Some(Output::Forward(trigger)) => {
                drop(work);
                forward(&trigger);
            }
            // The node has a recording, and keeps no spans.
            Some(Output::Freeze(_)) if !self.keeps_spans => {}
            Some(Output::Freeze(order)) => work.orders.push_back(Order::Freeze(order)),
        }
        true
    }

    /// Notes the order to stop the node. From now on only failures are causes: guards and watchdogs are expected to see
    /// the end of peers, and nodes leave.
    pub(super) fn stop_ordered(&self, now: Time) {
        self.stop_ns.fetch_min(now.as_nanos(), Ordering::Relaxed);
    }

    /// Makes triggers of all causes since the last call.
    fn take_causes(&self, now: Time, losses: &[String]) {
        let stop_ns = self.stop_ns.load(Ordering::Relaxed);
        let reported = std::mem::take(&mut *lock(&self.causes.reported));
        for (at, kind, cause) in &reported {
            if *kind == IncidentKind::Failure || at.as_nanos() < stop_ns {
                self.happened(*at, cause);
            }
        }
        let lost_failures = self.causes.lost_failures.swap(0, Ordering::Relaxed);
        if lost_failures > 0 {
            self.happened(now, &format!("{lost_failures} failures at the moment of another incident"));
        }
        let lost = self.causes.lost_symptoms.swap(0, Ordering::Relaxed);
        if now.as_nanos() >= stop_ns {
            return;
        }
        losses.iter().for_each(|cause| _ = self.happened(now, cause));
        if lost > 0 {
            // Those of a flood are in the span of the first one.
            self.happened(now, &format!("{lost} incidents at the moment of another one"));
        }
    }

    /// Starts the thread `freeze`, if it has orders and does not run.
    fn start_work(self: &Arc<Self>, state: &Weak<NodeState>, journal: &Path) -> io::Result<()> {
        let mut work = lock(&self.work);
        if work.orders.is_empty() || work.is_running {
            return Ok(());
        }
        let (flight, state, path) = (self.clone(), state.clone(), journal.to_owned());
        let thread = std::thread::Builder::new().name("freeze".to_owned());
        thread.spawn(move || flight.work(&state, &path))?;
        work.is_running = true;
        Ok(())
    }

    /// Writes the names beside the journal, if they have changed: a dead node cannot tell them. A new name of an
    /// application is written at once: the node may die within its first second.
    fn write_names(&self, state: &NodeState, journal: &Journal, now: Time, is_due: bool) {
        let mut names = lock(&self.names);
        if now < names.due && !is_due {
            return;
        }
        names.due = now + NAMES_PERIOD;
        let report = names_for_reader(state, journal.path());
        let lasting = RecordReport { clocks: Vec::new(), wall_offset_ns: 0, ..report.clone() };
        if names.written.as_ref() == Some(&lasting) {
            return;
        }
        let facts = FrozenFacts { span: None, report };
        let path = journal.path().with_extension("facts");
        match write_facts(&path, &facts) {
            Ok(()) => names.written = Some(lasting),
            // It is tried again each second, and logged once.
            Err(error) if !names.has_failed => {
                names.has_failed = true;
                log::warn!(
                    path = %path.display(), %error,
                    "the names beside the journal cannot be written: if the file is another user's, set record.folder to a folder of this user alone"
                );
            }
            Err(_) => {}
        }
        // The end of the node may have removed them before they were written.
        // SYNC: SeqCst, as in `finish`: either this thread sees the end, or the end sees the file.
        if self.is_ending.load(Ordering::SeqCst) {
            self.remove_names(journal.path());
        }
    }

    /// Removes the names beside a journal that ends with the node. It waits for no thread that is writing them: that
    /// thread removes them, too.
    pub(super) fn remove_names(&self, journal: &Path) {
        if !self.keeps_journal {
            // There is none, or it stays because the folder refuses that.
            let _ = std::fs::remove_file(journal.with_extension("facts"));
        }
    }

    /// Carries out the orders of the thread `freeze`.
    fn work(&self, state: &Weak<NodeState>, journal: &Path) {
        let _running = Running(self);
        // All nodes of a host copy at the same time: their control loops have the CPUs first.
        lower_priority();
        while let Some(order) = self.next_order() {
            // The others are carried out nevertheless.
            if catch_unwind(AssertUnwindSafe(|| self.carry_out(order, state, journal))).is_err() {
                log::error!("the thread `freeze` panicked: a span is not frozen, or a ring is not moved");
            }
        }
    }

    fn carry_out(&self, order: Order, state: &Weak<NodeState>, journal: &Path) {
        let order = match order {
            Order::Freeze(order) => order,
            Order::Move(id) => {
                match move_ring(&self.beside, &self.store, &id) {
                    Ok(()) => {
                        log::info!(id, "the ring of a dead incarnation is moved to record.frozen_folder")
                    }
                    Err(error) => {
                        log::warn!(id, %error, "the ring of a dead incarnation stays in record.folder");
                    }
                }
                return;
            }
        };
        let is_ending = self.is_ending.load(Ordering::Relaxed);
        let report = match state.upgrade().filter(|_| !is_ending) {
            Some(state) => names_for_reader(&state, journal),
            None => self.written_names(journal),
        };
        self.freeze(journal, &order, report);
    }

    /// Returns the next order of the thread. `None`: the thread ends.
    fn next_order(&self) -> Option<Order> {
        let mut work = lock(&self.work);
        if self.is_ending.load(Ordering::Relaxed) {
            // The node waits. The next start finds these rings again.
            work.orders.retain(|order| matches!(order, Order::Freeze(_)));
        }
        let next = work.next();
        if next.is_none() {
            work.is_running = false;
            self.idle.notify_all();
        }
        next
    }

    /// Returns the names that were written last. It waits for no layer.
    fn written_names(&self, journal: &Path) -> RecordReport {
        // The thread `record` may hang in a layer, with the names locked.
        let names = self.names.try_lock().ok().and_then(|names| names.written.clone());
        let read = || read_facts(&journal.with_extension("facts")).ok().map(|facts| facts.report);
        names.or_else(read).unwrap_or_default()
    }

    /// Has all spans frozen that are not complete yet, up to this moment: the node ends. [`wait`](Self::wait) waits for
    /// the copies.
    pub(super) fn finish(self: &Arc<Self>, node: &NodeState, journal: &Journal) {
        // SYNC: SeqCst, the partner is `write_names`: names that are written from now on are removed by their writer.
        self.is_ending.store(true, Ordering::SeqCst);
        // The failure of an actor may be why the node ends.
        self.take_causes(Time::now(), &[]);
        if !self.keeps_spans {
            return;
        }
        // Its links have ended.
        while self.poll(u64::MAX, |trigger| write_trigger(node, journal, trigger)) {}
        if let Err(error) = self.start_work(&Weak::new(), journal.path()) {
            // There is no further turn: nothing waits for these spans.
            let lost = std::mem::take(&mut lock(&self.work).orders).len();
            log::error!(%error, lost, "the system gives no thread: the node ends without the last spans and moves");
        }
    }

    /// Waits until the thread `freeze` has carried out its orders. Returns `false` if the time is over before.
    pub(super) fn wait(&self, within: Duration) -> bool {
        let work = self.idle.wait_timeout_while(lock(&self.work), within, |work| work.is_running);
        let (work, _) = work.unwrap_or_else(PoisonError::into_inner);
        !work.is_running && work.orders.is_empty()
    }

    fn freeze(&self, journal: &Path, order: &SpanOrder, report: RecordReport) {
        let SpanOrder { trigger, causes: cause, begin_ns, end_ns, replaces } = order;
        let id = trigger.id.to_string();
        let span = FrozenSpan {
            id: id.clone(),
            cause: cause.clone(),
            at_ns: trigger.at_ns,
            bound_ns: trigger.bound_ns,
            begin_ns: *begin_ns,
            // A node that ends freezes it before.
            end_ns: (*end_ns).min(Time::now().as_nanos()),
            ..FrozenSpan::default()
        };
        let facts = FrozenFacts { span: Some(span.clone()), report };
        let replaces: Vec<_> = replaces.iter().map(TriggerId::to_string).collect();
        let freeze = || -> Result<u64, FrozenError> {
            let draft = self.store().draft(&id, &replaces)?;
            // Without the lock: the copy takes as long as the disk does, and questions need the lock.
            let records = draft.copy(journal, &span)?;
            self.store().keep(&facts, &replaces)?;
            Ok(records)
        };
        match freeze() {
            Ok(records) => {
                log::warn!(id, cause, records, "the messages around a fault are frozen");
                if let Some(spans) = self.store().is_full() {
                    log::warn!(
                        spans,
                        "all places for frozen spans are taken: further faults are not frozen until these spans are fetched; run `sinew record fetch`, or raise record.frozen_max"
                    );
                }
            }
            Err(error) => log::error!(cause, %error, "the messages around a fault are not frozen"),
        }
    }

    /// Returns the known triggers.
    #[cfg(test)]
    pub(super) fn known(&self) -> Vec<Trigger> {
        lock(&self.plan).known()
    }
}

/// The thread `freeze`. If it panics between two orders, the next turn starts another one.
struct Running<'a>(&'a Flight);

impl Drop for Running<'_> {
    fn drop(&mut self) {
        // Else the last look at the orders has noted the end, and another thread may run already.
        if std::thread::panicking() {
            lock(&self.0.work).is_running = false;
            self.0.idle.notify_all();
        }
    }
}

#[cfg(test)]
mod tests;
