//! The flight recorder of a node: collects the causes, forwards the triggers, and has spans frozen.
//!
//! ```text
//!  guards, watchdogs, supervisors ── Causes ──► thread `record` ── FreezePlan ──► triggers to other nodes
//!  lost nodes, `sinew record freeze` ─────────────┘                    └──► thread `freeze` ──► FrozenStore
//! ```

use std::{
    collections::VecDeque,
    path::{Path, PathBuf},
    sync::{
        Arc, Mutex, MutexGuard, TryLockError, Weak,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    time::Duration,
};

use sinew_record::NodeFact;
use sinew_runtime::{
    incident::{self, IncidentObserver},
    lock, log,
    time::Time,
};
use sinew_shm::journal::Journal;

use super::{
    facts::{self, Changes},
    plan::{FreezePlan, Output, SpanOrder, Trigger, TriggerId},
    store::{FrozenError, FrozenStore, write_facts},
    triggers::forward,
};
use crate::{
    NodeState,
    inspect::{FrozenFacts, FrozenSpan, RecordReport, names_for_reader},
};

/// Maximum number of causes between two looks. Further ones belong to the same span, or are lost in a flood.
const CAUSES_MAX: usize = 16;
/// Time between two looks at the names beside the journal, if no application has a new name.
const NAMES_PERIOD: Duration = Duration::from_secs(1);

/// The flight recorder of a node.
pub(crate) struct Flight {
    plan: Mutex<FreezePlan>,
    store: Mutex<FrozenStore>,
    causes: Arc<Causes>,
    /// Spans to freeze: at most one for each known trigger.
    work: Mutex<VecDeque<SpanOrder>>,
    is_working: AtomicBool,
    names: Mutex<KnownReport>,
    /// The folder of the journal.
    folder: PathBuf,
    /// Whether spans are kept at all.
    keeps_spans: bool,
}

/// Causes that were reported by any thread of the process.
#[derive(Default)]
struct Causes {
    reported: Mutex<VecDeque<(Time, String)>>,
    lost: AtomicU64,
}

impl IncidentObserver for Causes {
    fn happened(&self, at: Time, cause: &str) {
        // The thread may be a real-time one. Another cause is just being stored or read: that one is a trigger.
        let Ok(mut reported) = self.reported.try_lock() else {
            self.lost.fetch_add(1, Ordering::Relaxed);
            return;
        };
        if reported.len() < CAUSES_MAX {
            reported.push_back((at, cause.to_owned()));
        } else {
            self.lost.fetch_add(1, Ordering::Relaxed);
        }
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
        let plan = FreezePlan::new((state.ctx.node, state.ctx.incarnation), config.keep, config.after);
        let causes = Arc::new(Causes::default());
        let observer: Arc<dyn IncidentObserver> = causes.clone();
        // More nodes of one process than have room record without the incidents of the process.
        incident::observe(&observer);
        Arc::new(Self {
            plan: Mutex::new(plan),
            store: Mutex::new(store),
            causes,
            work: Mutex::default(),
            is_working: AtomicBool::new(false),
            names: Mutex::default(),
            folder,
            keeps_spans: config.frozen_max > 0,
        })
    }

    /// Handles a cause at this node. Returns the trigger that stands for it.
    pub(crate) fn happened(&self, at: Time, cause: &str) -> Option<TriggerId> {
        lock(&self.plan).happened(Time::now().as_nanos(), at.as_nanos(), cause)
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
        // A node that stops loses the others in order.
        if !state.ctx.stopping.load(Ordering::Relaxed) {
            let reported = std::mem::take(&mut *lock(&self.causes.reported));
            reported.iter().for_each(|(at, cause)| _ = self.happened(*at, cause));
            changes.losses.iter().for_each(|cause| _ = self.happened(now, cause));
        }
        let lost = self.causes.lost.swap(0, Ordering::Relaxed);
        if lost > 0 {
            log::debug!(lost, "causes to freeze a span were not looked at: others came at the same moment");
        }
        self.write_names(state, journal, now, changes.has_new_names);
        loop {
            let output = lock(&self.plan).poll(now.as_nanos());
            match output {
                None => break,
                Some(Output::Forward(trigger)) => {
                    note(state, journal, &trigger);
                    forward(state, &trigger);
                }
                // The node has a recording, and keeps no spans.
                Some(Output::Freeze(_)) if !self.keeps_spans => {}
                Some(Output::Freeze(order)) => lock(&self.work).push_back(order),
            }
        }
        // SYNC: with the end of `work`: a thread that has ended has carried out its orders.
        if !lock(&self.work).is_empty() && !self.is_working.swap(true, Ordering::AcqRel) {
            let (flight, weak, path) = (self.clone(), Arc::downgrade(state), journal.path().to_owned());
            let thread = std::thread::Builder::new().name("freeze".to_owned());
            if let Err(error) = thread.spawn(move || flight.work(&weak, &path)) {
                // The next turn tries again.
                self.is_working.store(false, Ordering::Release);
                log::error!(%error, "the system gives no thread to freeze a span");
            }
        }
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
        match write_facts(&journal.path().with_extension("facts"), &facts) {
            Ok(()) => names.written = Some(lasting),
            // It is tried again each second, and logged once.
            Err(error) if !names.has_failed => {
                names.has_failed = true;
                log::warn!(%error, "the names beside the journal cannot be written");
            }
            Err(_) => {}
        }
    }

    /// Carries out the orders of the thread `freeze`.
    fn work(&self, state: &Weak<NodeState>, journal: &Path) {
        loop {
            let next = lock(&self.work).pop_front();
            match (next, state.upgrade()) {
                (Some(order), Some(state)) => {
                    self.freeze(journal, &order, names_for_reader(&state, journal));
                }
                (Some(_), None) | (None, _) => break,
            }
        }
        // SYNC: with `turn`.
        self.is_working.store(false, Ordering::Release);
    }

    /// Freezes all spans that are not complete yet, up to this moment: the node ends. It waits for no layer.
    pub(super) fn finish(&self, journal: &Path) {
        if !self.keeps_spans {
            return;
        }
        // The thread `record` may hang in a layer, with the names locked.
        let names = self.names.try_lock().ok().and_then(|names| names.written.clone());
        let report = names.unwrap_or_default();
        loop {
            let Some(output) = lock(&self.plan).poll(u64::MAX) else { break };
            match output {
                Output::Freeze(order) => lock(&self.work).push_back(order),
                // Its links have ended.
                Output::Forward(_) => {}
            }
        }
        loop {
            let Some(next) = lock(&self.work).pop_front() else { break };
            self.freeze(journal, &next, report.clone());
        }
    }

    fn freeze(&self, journal: &Path, order: &SpanOrder, report: RecordReport) {
        let SpanOrder { trigger, begin_ns, end_ns, replaces } = order;
        let (id, cause) = (trigger.id.to_string(), trigger.cause.as_str());
        let span = FrozenSpan {
            id: id.clone(),
            cause: cause.to_owned(),
            at_ns: trigger.at_ns,
            bound_ns: trigger.bound_ns,
            begin_ns: *begin_ns,
            end_ns: *end_ns,
            ..FrozenSpan::default()
        };
        let facts = FrozenFacts { span: Some(span.clone()), report };
        let replaces: Vec<_> = replaces.iter().map(TriggerId::to_string).collect();
        let freeze = || -> Result<u64, FrozenError> {
            let draft = self.store().draft(&id, &replaces)?;
            // Without the lock: the copy takes as long as the disk does, and questions need the lock.
            let drafted = draft.copy(journal, &span)?;
            self.store().keep(&drafted, &facts, &replaces)?;
            Ok(drafted.records)
        };
        match freeze() {
            Ok(records) => log::warn!(id, cause, records, "the messages around a fault are frozen"),
            Err(error) => log::error!(cause, %error, "the messages around a fault are not frozen"),
        }
    }

    /// Returns the known triggers.
    #[cfg(test)]
    pub(super) fn known(&self) -> Vec<Trigger> {
        lock(&self.plan).known()
    }
}

/// Writes the trigger into the journal, so that it is an event of the span.
fn note(state: &NodeState, journal: &Journal, trigger: &Trigger) {
    let (id, cause) = (trigger.id.to_string(), trigger.cause.as_str().to_owned());
    let fact = NodeFact::Triggered { id, cause, bound_ns: trigger.bound_ns };
    facts::write(journal, state.ctx.node, Time::from_nanos(trigger.at_ns), &fact);
}
