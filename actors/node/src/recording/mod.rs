//! The recording: messages and facts in the node's journal, while its configuration or a program asks for it.
//!
//! ```text
//!  a sender's thread ── router ── RecordTap ──► journal (a file in memory; the newest bytes win) ──► any reader
//!  thread `record` ── compares nodes, names, barriers, clocks every 100 ms ──┘
//! ```
//!
//! Without a recording there is no tap in the routing table, no thread and no file.

mod facts;
mod flight;
mod names;
mod plan;
mod store;
#[cfg(test)]
mod tests;
mod triggers;

use std::{
    collections::BTreeMap,
    io,
    path::{Path, PathBuf},
    sync::{Arc, Condvar, Mutex, MutexGuard, OnceLock, PoisonError, Weak},
    time::Duration,
};

use rustix::time::{ClockId, clock_gettime};
use sinew_model::context::NodeContext;
use sinew_record::{NodeFact, OutcomeTap, RecordCounts, RecordTap, RecordingReport, Selection};
use sinew_runtime::{
    log::{self, LogObserver},
    outcome::{self, OutcomeObserver},
    router::tap::{Tap, TapOf},
    supervision::{RestartObserver, observe_restarts},
    tid::Tid,
    time::Time,
    wire::{Kind, known_types},
};
use sinew_shm::journal::{CreateJournalError, Journal, Options};

use facts::{FactWriter, KnownFacts};
pub(crate) use flight::Flight;
pub(crate) use names::{journal_kinds, report};
pub(crate) use triggers::Triggers;

use crate::NodeState;

/// Time without a question after which a recording ends that a program asked for.
pub(crate) const LEASE: Duration = Duration::from_secs(5);
/// Maximum number of programs that record at once.
pub(crate) const PROGRAMS_MAX: usize = 8;
/// Time between two looks at the node's state, and at the selected names.
const PERIOD: Duration = Duration::from_millis(100);
/// Time limit for the copies of spans at the end of the node.
const COPIES_WITHIN: Duration = Duration::from_secs(5);
/// The folder of files in memory: on a disk the system would stop a sender while it stores a page.
const MEMORY: &str = "/dev/shm";

/// The recording of a node.
#[derive(Default)]
pub(crate) struct Recording {
    state: Mutex<State>,
    /// Notified when the last selection has gone.
    ended: Condvar,
    /// Freezes spans, if the configuration asks for a recording.
    flight: OnceLock<Arc<Flight>>,
}

#[derive(Default)]
struct State {
    active: Option<Active>,
    /// That of the configuration.
    configured: Option<Selection>,
    /// Those of programs, each until its lease ends.
    programs: BTreeMap<Tid, Program>,
    /// The counters of recordings that have ended.
    ended: RecordCounts,
    /// Whether the node ends, and records no more.
    is_closed: bool,
}

/// A program that records.
struct Program {
    selection: Selection,
    /// The end of its lease.
    until: Time,
    counts: RecordCounts,
}

/// A recording that runs.
struct Active {
    journal: Arc<Journal>,
    /// The sum of all selections.
    selection: Selection,
    /// The names and addresses of the tap.
    chosen: Option<sinew_record::Chosen>,
    /// Writes outcomes, as long as it is here.
    outcomes: Option<Arc<dyn OutcomeObserver>>,
    /// Writes the log and restarts, as long as it is here.
    _facts: Arc<FactWriter>,
}

/// A recording that has ended. Its journal may still be copied.
#[derive(Default)]
#[must_use = "spans are lost if the process ends before they are copied"]
pub(crate) struct Ending {
    active: Option<Active>,
    is_kept: bool,
    flight: Option<Arc<Flight>>,
}

impl Ending {
    /// Waits for the copies, up to a limit. Then the journal is closed.
    pub(crate) fn wait(self) {
        if let Some(flight) = &self.flight
            && !flight.wait(COPIES_WITHIN)
        {
            log::error!(
                within = ?COPIES_WITHIN,
                "spans are not frozen in time; the folder of record.frozen_folder may be too slow"
            );
        }
        if let Some(active) = &self.active
            && !self.is_kept
        {
            active.journal.remove();
            if let Some(flight) = &self.flight {
                flight.remove_names(active.journal.path());
            }
        }
    }
}

/// Why there is no recording.
#[derive(Debug, thiserror::Error)]
pub(crate) enum RecordError {
    /// The journal cannot be made.
    #[error("{cause}{remedy}", cause = .0, remedy = remedy(.0))]
    Journal(#[from] CreateJournalError),
    /// The system has no thread for it.
    #[error("the system gives no thread for the recording: {0}")]
    Thread(#[from] io::Error),
    /// The node ends.
    #[error("this node is ending")]
    Closed,
    /// As many programs record as may.
    #[error("{PROGRAMS_MAX} programs record on this node at once, and so many do; end another one")]
    Programs,
}

/// Returns the setting that mends it, if the text of the error does not name it.
const fn remedy(error: &CreateJournalError) -> &'static str {
    match error {
        CreateJournalError::Taken { .. } | CreateJournalError::Folder { .. } => {
            " (record.folder, such as one in $XDG_RUNTIME_DIR with the mode 0700)"
        }
        CreateJournalError::Size(_)
        | CreateJournalError::Identity(_)
        | CreateJournalError::System { .. }
        | CreateJournalError::Unsupported => "",
    }
}

impl Recording {
    /// Begins the recording that the configuration asks for, if it does.
    pub(crate) fn begin_configured(&self, node: &Arc<NodeState>) -> Result<(), RecordError> {
        let config = &node.ctx.config.record;
        if config.folder.is_none() && config.file.is_none() {
            return Ok(());
        }
        let selection =
            Selection { apps: config.apps.clone(), types: config.types.clone(), groups: Vec::new() };
        let names = KnownNames::of(node);
        // Before the ring of a former incarnation is replaced.
        self.flight.get_or_init(|| Flight::begin(node, &journal_path(&node.ctx)));
        let mut state = self.lock();
        state.configured = Some(selection);
        self.start(node, &names, &mut state)
    }

    /// Starts or renews the recording for a program. Returns the journal's path.
    pub(crate) fn ask(
        &self,
        node: &Arc<NodeState>,
        program: Tid,
        selection: Selection,
        now: Time,
    ) -> Result<PathBuf, RecordError> {
        let names = KnownNames::of(node);
        let mut state = self.lock();
        if state.is_closed {
            return Err(RecordError::Closed);
        }
        if state.programs.len() >= PROGRAMS_MAX && !state.programs.contains_key(&program) {
            return Err(RecordError::Programs);
        }
        let counts = state.programs.get(&program).map_or_else(RecordCounts::default, |known| known.counts);
        state.programs.insert(program, Program { selection, until: now + LEASE, counts });
        if let Err(why) = self.start(node, &names, &mut state) {
            state.programs.remove(&program);
            return Err(why);
        }
        let active = state.active.as_ref().expect("it has started, and this program keeps it");
        Ok(active.journal.path().to_owned())
    }

    /// Ends the recording for a program.
    pub(crate) fn leave(&self, node: &NodeState, program: Tid) {
        let names = KnownNames::of(node);
        let mut state = self.lock();
        if let Some(ended) = state.programs.remove(&program) {
            state.ended.add(ended.counts);
            self.settle(node, &names, &mut state);
        }
    }

    /// Notes the counters that a program has reported, if it records.
    pub(crate) fn note_counts(&self, program: Tid, counts: RecordCounts) {
        if let Some(program) = self.lock().programs.get_mut(&program) {
            program.counts = counts;
        }
    }

    /// Returns the state of the recording.
    pub(crate) fn report_state(&self) -> RecordingReport {
        let state = self.lock();
        let mut counts = state.ended;
        state.programs.values().for_each(|program| counts.add(program.counts));
        RecordingReport {
            is_configured: state.configured.is_some(),
            programs: u32::try_from(state.programs.len()).unwrap_or(u32::MAX),
            written_bytes: state.active.as_ref().map_or(0, |active| active.journal.written_bytes()),
            seen: counts.seen,
            dropped: counts.dropped,
        }
    }

    /// Returns the part that freezes spans, if the configuration asks for a recording.
    pub(crate) fn flight(&self) -> Option<&Arc<Flight>> {
        self.flight.get()
    }

    /// Returns the path of the journal, if there is one.
    #[cfg(test)]
    pub(crate) fn path(&self) -> Option<PathBuf> {
        self.lock().active.as_ref().map(|active| active.journal.path().to_owned())
    }

    /// Notes the order to stop the node.
    pub(crate) fn stop_ordered(&self) {
        if let Some(flight) = self.flight() {
            flight.stop_ordered(Time::now());
        }
    }

    /// Ends the recording with the node. The file of a configured one stays. Spans are copied by a thread of their own,
    /// for which [`Ending::wait`] waits.
    pub(crate) fn end(&self, node: &NodeState) -> Ending {
        let (active, was_configured) = {
            let mut state = self.lock();
            state.is_closed = true;
            state.programs.clear();
            (state.active.take(), state.configured.take().is_some())
        };
        let Some(active) = active else { return Ending::default() };
        active.remove_taps(node);
        let flight = self.flight().cloned();
        if let Some(flight) = &flight {
            flight.finish(node, &active.journal);
        }
        self.ended.notify_all();
        let is_kept = was_configured && node.ctx.config.record.folder.is_some();
        Ending { active: Some(active), is_kept, flight }
    }

    /// Ends the recording, and waits for its copies.
    #[cfg(test)]
    pub(crate) fn close(&self, node: &NodeState) {
        self.end(node).wait();
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Makes the journal and the thread, if there are none, and updates the tap.
    fn start(&self, node: &Arc<NodeState>, names: &KnownNames, state: &mut State) -> Result<(), RecordError> {
        if state.active.is_none() {
            let now = Time::now();
            names::remember_own_types();
            let journal = Arc::new(create(node, now)?);
            let began = NodeFact::Began {
                node: node.ctx.node,
                name: node.ctx.config.name.clone(),
                project: node.ctx.config.project.clone(),
                incarnation: node.ctx.incarnation,
            };
            facts::write(&journal, node.ctx.node, now, &began);
            let (weak, of) = (Arc::downgrade(node), journal.clone());
            let thread = std::thread::Builder::new().name("record".to_owned());
            if let Err(why) = thread.spawn(move || run(&weak, &of)) {
                journal.remove();
                return Err(why.into());
            }
            let facts = Arc::new(FactWriter { node: node.ctx.node, journal: journal.clone() });
            let (log, restarts): (Arc<dyn LogObserver>, Arc<dyn RestartObserver>) =
                (facts.clone(), facts.clone());
            // More nodes of one process than have room record without the log and without restarts.
            log::observe(&log);
            observe_restarts(&restarts);
            let selection = Selection::default();
            state.active = Some(Active { journal, selection, chosen: None, outcomes: None, _facts: facts });
        }
        self.settle(node, names, state);
        Ok(())
    }

    /// Fits the tap to the selections, or ends the recording without any.
    fn settle(&self, node: &NodeState, names: &KnownNames, state: &mut State) {
        let State { active: Some(active), configured, programs, .. } = state else { return };
        let mut all = configured.iter().chain(programs.values().map(|program| &program.selection));
        let Some(mut sum) = all.next().cloned() else {
            if let Some(active) = state.active.take() {
                self.remove(node, &active);
            }
            return;
        };
        all.for_each(|selection| sum.add(selection));
        active.selection = sum;
        active.refresh(node, names);
    }

    fn remove(&self, node: &NodeState, active: &Active) {
        active.remove_taps(node);
        active.journal.remove();
        self.ended.notify_all();
    }

    /// Looks at the selected names, and ends expired leases. Returns whether this journal is still written.
    fn refresh(&self, node: &NodeState, journal: &Arc<Journal>, now: Time) -> bool {
        let names = KnownNames::of(node);
        let mut state = self.lock();
        let before = state.programs.len();
        let State { programs, ended, .. } = &mut *state;
        programs.retain(|_, program| {
            let is_leased = program.until > now;
            if !is_leased {
                ended.add(program.counts);
            }
            is_leased
        });
        if state.programs.len() < before {
            self.settle(node, &names, &mut state);
        }
        let Some(active) = state.active.as_mut().filter(|active| Arc::ptr_eq(&active.journal, journal))
        else {
            return false;
        };
        active.refresh(node, &names);
        true
    }

    /// Waits for the next look, or for the end.
    fn rest(&self) {
        let state = self.lock();
        // A poisoned lock is that of a panic elsewhere; the next look decides.
        drop(self.ended.wait_timeout(state, PERIOD));
    }
}

/// The names of the node's applications and of payload types. They are read without the lock of the recording: a layer
/// that hangs must not stop the end of the node.
struct KnownNames {
    apps: Vec<(String, Tid)>,
    kinds: BTreeMap<Kind, String>,
}

impl KnownNames {
    fn of(node: &NodeState) -> Self {
        let directory = names::directory(node);
        let kinds = directory.iter().flat_map(|entry| entry.kinds.iter().copied());
        let mut kinds: BTreeMap<_, _> = kinds
            .filter_map(|kind| Some((kind, sinew_lncl::undelivered::kind_name(&node.lncl, kind)?)))
            .collect();
        // Applications send types that none of them handles.
        for (kind, name) in known_types() {
            kinds.entry(kind).or_insert_with(|| name.to_owned());
        }
        let apps = names::named_apps(node, Vec::new()).collect();
        Self { apps, kinds }
    }
}

impl Active {
    /// Ends the recording of messages and outcomes.
    fn remove_taps(&self, node: &NodeState) {
        install(node, None);
        self.outcomes.iter().for_each(outcome::stop_observing);
    }

    /// Replaces the tap if the selected names have other addresses now.
    fn refresh(&mut self, node: &NodeState, names: &KnownNames) {
        let chosen = if self.selection.is_all() {
            self.selection.chosen([], [])
        } else {
            self.selection.chosen(
                names.apps.iter().map(|(name, tid)| (&**name, *tid)),
                names.kinds.iter().map(|(kind, name)| (&**name, *kind)),
            )
        };
        if self.chosen.as_ref() != Some(&chosen) {
            let tap = RecordTap::new(node.ctx.node, self.journal.clone(), chosen.clone());
            install(node, Some(Arc::new(tap)));
            let outcomes = OutcomeTap::new(node.ctx.node, self.journal.clone(), chosen.clone());
            let outcomes: Arc<dyn OutcomeObserver> = Arc::new(outcomes);
            // More nodes of one process than have room record without outcomes.
            outcome::observe(&outcomes, self.outcomes.as_ref());
            self.outcomes = Some(outcomes);
            self.chosen = Some(chosen);
        }
    }
}

fn install(node: &NodeState, tap: Option<Arc<dyn Tap>>) {
    node.ctx.router.set_tap(TapOf::Recording, tap);
    if let Some(applications) = node.ctx.ports.applications() {
        applications.observe_links();
    }
}

/// Writes facts until the recording or the node ends.
fn run(node: &Weak<NodeState>, journal: &Arc<Journal>) {
    let mut known = KnownFacts::default();
    while let Some(state) = node.upgrade() {
        let now = Time::now();
        if !state.recording.refresh(&state, journal, now) {
            return;
        }
        let changes = known.look(&state, journal, now);
        if let Some(flight) = state.recording.flight() {
            flight.turn(&state, journal, now, &changes);
        }
        state.recording.rest();
    }
}

fn create(node: &NodeState, now: Time) -> Result<Journal, RecordError> {
    let config = &node.ctx.config.record;
    let identity = format!("{}\n{}\n{}", node.ctx.config.name, node.ctx.node, node.ctx.config.project);
    let options = Options {
        ring_bytes: config.keep_bytes as u64,
        identity: identity.as_bytes(),
        now: now.as_nanos(),
        wall_offset: wall_offset(),
        keeps_previous: config.folder.is_some(),
        ..Options::default()
    };
    let path = journal_path(&node.ctx);
    let journal = Journal::create(&path, &options)?;
    log::info!(path = %path.display(), bytes = config.keep_bytes, "the node records");
    Ok(journal)
}

/// Returns the path of the journal.
fn journal_path(ctx: &NodeContext) -> PathBuf {
    let memory = Path::new(MEMORY);
    let folder = match &ctx.config.record.folder {
        Some(folder) => folder.clone(),
        None if memory.is_dir() => memory.to_owned(),
        None => std::env::temp_dir(),
    };
    folder.join(file_name(&ctx.config.project, &ctx.node.to_string()))
}

/// Returns the name of the journal: that of one project's node.
fn file_name(project: &str, node: &str) -> String {
    let letter = |c: char| if c.is_ascii_alphanumeric() || c == '-' { c } else { '_' };
    format!("sinew-{}-{node}.journal", project.chars().map(letter).collect::<String>())
}

/// Returns the nanoseconds from the monotonic clock to the wall clock.
pub(crate) fn wall_offset() -> i64 {
    let nanoseconds = |clock| {
        let now = clock_gettime(clock);
        i128::from(now.tv_sec) * 1_000_000_000 + i128::from(now.tv_nsec)
    };
    // The wall clock is read between two looks at the other one.
    let (before, wall, after) =
        (nanoseconds(ClockId::Monotonic), nanoseconds(ClockId::Realtime), nanoseconds(ClockId::Monotonic));
    i64::try_from(wall - (before + after) / 2).unwrap_or(i64::MAX)
}
