//! The thread `types`: it traces and publishes the types of this node's applications, fetches structures, compares them
//! and logs the differences.
//!
//! Tracing a type takes up to some milliseconds, so no thread with deadlines does it. The thread has a low priority and
//! holds each lock only for a copy of bounded length.

use std::{
    collections::BTreeMap,
    io,
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{Arc, Weak, atomic::Ordering},
    thread,
    time::Duration,
};

use serde::Serialize;
use sinew_lncl::undelivered::kind_name;
use sinew_model::{facts::TypeHash, thread_priority::lower_priority};
use sinew_runtime::{
    lock, log,
    outcome::Rejection,
    router::mismatches::{Mismatch, Mismatches, TypedPath},
    tid::{AppAddress, NodeAddress, Tid},
    time::Time,
    wire::{Class, Header, Kind, Message, encode},
};
use sinew_sync::{AppTypes, ListVersion};
use tokio::{
    runtime::{Builder, Runtime},
    sync::{Notify, watch},
};

use super::{
    FRAMES_MAX,
    frames::{Frame, MismatchReport, SchemaAnswer, SchemaQuestion},
    judgement::{Judgement, Treatment, sentence},
    verdicts::{Disagreement, Handled, Sent},
};
use crate::NodeState;

/// Minimum time between two steps: a start of many applications is one step, not one for each.
const PAUSE: Duration = Duration::from_millis(10);
/// Time to the next step after a panic.
const AFTER_PANIC: Duration = Duration::from_secs(2);
/// Minimum time between two answers to one node with one structure; a node asks again after 2 s.
const ANSWER_AGAIN: Duration = Duration::from_secs(1);
/// Maximum number of answers within [`ANSWER_AGAIN`].
const ANSWERS_MAX: usize = 1_024;

/// Starts the thread. It ends with the node.
///
/// # Errors
/// The thread cannot be started, or has no timer.
pub(crate) fn begin(state: &Arc<NodeState>) -> io::Result<()> {
    let runtime = Builder::new_current_thread().enable_time().build()?;
    let comparing = Comparing {
        state: Arc::downgrade(state),
        wake: state.types.wake.clone(),
        changes: state.ctx.directory_changes.subscribe(),
        lists: BTreeMap::new(),
        installed: (Vec::new(), 0),
        answered: BTreeMap::new(),
    };
    thread::Builder::new().name("types".to_owned()).spawn(move || comparing.run(&runtime))?;
    Ok(())
}

struct Comparing {
    /// Weak: the thread does not keep the state alive.
    state: Weak<NodeState>,
    wake: Arc<Notify>,
    changes: watch::Receiver<u64>,
    /// The types that other nodes list, as of the last step.
    lists: BTreeMap<NodeAddress, SentTypes>,
    /// The entries of the routing table, and the number of changes of routes before them.
    installed: (Vec<(TypedPath, Arc<Mismatch>)>, u64),
    /// When each structure was sent to each node, for those within [`ANSWER_AGAIN`].
    answered: BTreeMap<(NodeAddress, TypeHash), Time>,
}

/// The types that the applications of another node send.
struct SentTypes {
    of: ListVersion,
    sent: Vec<Sent>,
}

impl Comparing {
    fn run(mut self, runtime: &Runtime) {
        lower_priority();
        let mut next = None;
        while runtime.block_on(self.wait(next)) {
            let Some(state) = self.state.upgrade() else { return };
            // SYNC: see `Types::close`.
            if state.types.is_closed.load(Ordering::Acquire) {
                return;
            }
            let step = AssertUnwindSafe(|| self.step(&state));
            next = catch_unwind(step).unwrap_or_else(|_| {
                log::error!(
                    "the comparison of types panicked; it continues behind the type or frame that it treated"
                );
                Some(Time::now() + AFTER_PANIC)
            });
            drop(state);
            thread::sleep(PAUSE);
        }
    }

    /// Waits for a change of the directory, for new types or frames, or until `until`. Returns `false` when the node
    /// has ended.
    async fn wait(&mut self, until: Option<Time>) -> bool {
        let timer = async {
            match until {
                Some(at) => tokio::time::sleep(at.since(Time::now())).await,
                None => std::future::pending::<()>().await,
            }
        };
        tokio::select! {
            changed = self.changes.changed() => changed.is_ok(),
            () = self.wake.notified() => true,
            () = timer => true,
        }
    }

    /// Handles all that is new. Returns the time of the next step.
    fn step(&mut self, state: &NodeState) -> Option<Time> {
        // Before the directory is read: a node that is linked anew since then may have other types.
        let route_changes = state.ctx.router.route_changes();
        publish(state);
        for _ in 0..FRAMES_MAX {
            let Some((from, frame)) = state.types.pop_frame() else { break };
            if let Err(fault) = self.handle(state, from, frame) {
                state.ctx.refusals.count(Time::now(), "types", &fault);
            }
        }
        let (handled, sent_here) = own_types(state);
        self.read_lists(state);
        let now = Time::now();
        let (wanted, cases) = {
            let sent = self.lists.values().flat_map(|list| &list.sent).chain(&sent_here);
            let mut verdicts = lock(&state.types.verdicts);
            (verdicts.declare(now, &handled, sent), verdicts.cases())
        };
        for case in cases {
            let judgement = case.judge();
            lock(&state.types.verdicts).decide(&case, judgement);
        }
        let (due, left_out, mut table, next) = {
            let mut verdicts = lock(&state.types.verdicts);
            let due = verdicts.take_due(now);
            (due, verdicts.take_left_out(now), verdicts.table(), verdicts.next_wake())
        };
        if let Some(count) = left_out {
            log::warn!(
                "{count} pairs of applications and types are not compared, for want of room: their messages are \
                 decoded as usual; build the programs with one version of their types"
            );
        }
        table.retain(|(path, _)| self.is_linked(state, path.source.node));
        let is_set = self.install(state, table, route_changes);
        for (node, (kind, hash)) in wanted {
            // It is requested again.
            let _ = send(state, node, Kind::SYNC_SCHEMA_ASK, &SchemaQuestion { kind, hash });
        }
        due.iter().for_each(|disagreement| tell(state, disagreement));
        if is_set { next } else { Some(now) }
    }

    /// Handles a frame of another node.
    ///
    /// # Errors
    /// Returns the fault of the frame.
    fn handle(&mut self, state: &NodeState, from: NodeAddress, frame: Frame) -> Result<(), String> {
        match frame {
            Frame::Question(question) => self.answer(state, from, question),
            Frame::Answer(SchemaAnswer { kind, hash, schema }) => {
                lock(&state.types.verdicts).received(from, (kind, hash), &schema)
            }
            Frame::Report(report) => reported(state, from, &report),
        }
    }

    /// Sends a structure to the node that asks for it.
    ///
    /// # Errors
    /// Returns the fault of the question, or why the answer was not sent.
    fn answer(
        &mut self,
        state: &NodeState,
        from: NodeAddress,
        question: SchemaQuestion,
    ) -> Result<(), String> {
        let SchemaQuestion { kind, hash } = question;
        let schema = state.types.schema_of_hash(kind, hash).ok_or_else(|| {
            format!("from {from}, a question for a structure of kind {kind} that this node does not have")
        })?;
        let now = Time::now();
        self.answered.retain(|_, at| now.since(*at) < ANSWER_AGAIN);
        let is_again = self.answered.contains_key(&(from, (kind, hash)));
        if is_again || self.answered.len() >= ANSWERS_MAX {
            return Err(format!("from {from}, a question for the structure of kind {kind} too early"));
        }
        self.answered.insert((from, (kind, hash)), now);
        let answer = SchemaAnswer { kind, hash, schema };
        let sent = send(state, from, Kind::SYNC_SCHEMA, &answer);
        sent.map_err(|why| format!("a structure was not sent to {from}: {why}"))
    }

    /// Reads the lists that have changed. The lock of the directory is held for the types of one node at a time.
    fn read_lists(&mut self, state: &NodeState) {
        let versions: BTreeMap<_, _> = lock(&state.sync.core).list_versions().into_iter().collect();
        self.lists.retain(|node, list| versions.get(node) == Some(&list.of));
        for (node, of) in versions {
            self.lists.entry(node).or_insert_with(|| {
                let apps = lock(&state.sync.core).declared_types_of(node);
                // If the list has changed meanwhile, its version differs at the next step, which follows.
                SentTypes { of, sent: apps.into_iter().flat_map(sent_by).collect() }
            });
        }
    }

    /// Returns whether the list of `node` is of its linked incarnation, or `node` is this one. The directory learns of
    /// another incarnation later than the routing table.
    fn is_linked(&self, state: &NodeState, node: NodeAddress) -> bool {
        if node == state.ctx.node {
            return true;
        }
        let linked = state.ctx.ports.links().and_then(|links| links.incarnation(node));
        linked.is_none_or(|linked| self.lists.get(&node).is_some_and(|list| list.of.0 == linked))
    }

    /// Puts the entries into the routing table, if they are others than before. Returns whether they are there.
    fn install(
        &mut self,
        state: &NodeState,
        table: Vec<(TypedPath, Arc<Mismatch>)>,
        route_changes: u64,
    ) -> bool {
        let (installed, at) = &self.installed;
        let mut pairs = table.iter().zip(installed);
        let are_same = pairs.all(|((path, entry), (former_path, former_entry))| {
            path == former_path && Arc::ptr_eq(entry, former_entry)
        });
        if are_same && table.len() == installed.len() && *at == route_changes {
            return true;
        }
        let wake = self.wake.clone();
        let mismatches = (!table.is_empty())
            .then(|| Mismatches::new(table.iter().cloned(), Arc::new(move || wake.notify_one())));
        let is_set = state.ctx.router.set_mismatches(mismatches, route_changes);
        if is_set {
            self.installed = (table, route_changes);
        }
        is_set
    }
}

/// Publishes the types of the applications that have new ones.
fn publish(state: &NodeState) {
    // Each type is traced by itself: a panic in one does not affect the others.
    while let Some((app, types)) = state.types.declared.pop_changed() {
        let may_have_fewer = types.has_two_of_a_kind();
        let hashes = types.hashes();
        for kind in types.invalid() {
            let detail = format!("of {app}, the declaration of kind {kind} is no valid structure");
            state.ctx.refusals.count(Time::now(), "types", &detail);
        }
        if !hashes.is_empty() || may_have_fewer {
            // An application that has ended meanwhile has no entry in the directory.
            let is_current = || state.types.declared.is_current(app, types.registration);
            sinew_lncl::types_known(&state.lncl, app, hashes, is_current);
        }
    }
}

/// Returns the published types that applications of this node handle, and those that they send if another process has
/// declared types.
fn own_types(state: &NodeState) -> (Vec<Handled>, Vec<Sent>) {
    let all = lock(&state.sync.core).own_declared_types();
    let declared = &state.types.declared;
    let compares_senders = declared.has_declarations();
    let (mut handled, mut sent) = (Vec::new(), Vec::new());
    for AppTypes { tid, name, types } in all {
        let program = declared.program(tid.app);
        for (kind, hash) in types.handles {
            let own = declared.handled(tid.app, kind);
            // The directory learns later than this table that the address has another owner.
            if let Some(own) = own
                && let Some((schema, of_own)) = own.schema()
                && of_own == hash
            {
                let (name, policy, is_protected) = (name.clone(), own.policy(), own.is_protected());
                handled.push(Handled {
                    app: tid.app,
                    name,
                    kind,
                    hash,
                    policy,
                    is_protected,
                    schema,
                    program,
                });
            }
        }
        let name: Arc<str> = name.into();
        for (kind, hash) in types.sends.into_iter().filter(|_| compares_senders) {
            let own = declared.sent(tid.app, kind).and_then(|own| own.schema());
            if let Some((structure, _)) = own.filter(|(_, of_own)| *of_own == hash) {
                let here = Some((structure, program));
                sent.push(Sent { tid, name: name.clone(), kind, hash, here });
            }
        }
    }
    (handled, sent)
}

/// Returns the types that an application of another node sends.
fn sent_by(app: AppTypes) -> impl Iterator<Item = Sent> {
    let AppTypes { tid, name, types } = app;
    let name: Arc<str> = name.into();
    types.sends.into_iter().map(move |(kind, hash)| Sent { tid, name: name.clone(), kind, hash, here: None })
}

/// Logs the report of another node that messages of this node are of a type that differs.
///
/// # Errors
/// Returns the fault of the report.
fn reported(state: &NodeState, from: NodeAddress, report: &MismatchReport) -> Result<(), String> {
    let own = state.types.declared.sent(report.source, report.kind);
    let (own, _) = own.and_then(|own| own.schema()).ok_or_else(|| {
        format!("from {from}, a report on kind {}, which {} does not send", report.kind, report.source)
    })?;
    let target = Tid::new(from, report.target);
    if !lock(&state.sync.core).lists_handled(target, (report.kind, report.hash)) {
        return Err(format!("from {from}, a report on kind {}, which {target} does not handle", report.kind));
    }
    let report = {
        let mut reported = lock(&state.types.reported);
        reported.add(Time::now(), from, report, &own)?.cloned()
    };
    if let Some(report) = report {
        let source = title(state, Tid::new(state.ctx.node, report.source));
        let ends = (format!("{source} of this node"), title(state, report.target));
        write(state, report.kind, (&ends.0, &ends.1), &report.judgement, report.seen);
    }
    Ok(())
}

/// Logs a disagreement, and reports it to the node of the sender if that is another one.
fn tell(state: &NodeState, disagreement: &Disagreement) {
    let Disagreement { path, source, target, judgement, handled: (hash, schema), seen } = disagreement;
    let TypedPath { source: sender, target: app, kind } = *path;
    let ends = (
        format!("{source} ({sender})"),
        format!("{target} ({}) of this node", Tid::new(state.ctx.node, app)),
    );
    write(state, kind, (&ends.0, &ends.1), judgement, *seen);
    if sender.node == state.ctx.node {
        return;
    }
    let report = MismatchReport {
        source: sender.app,
        target: app,
        kind,
        hash: *hash,
        policy: judgement.policy.word().to_owned(),
        refused: judgement.treatment == Treatment::Refused,
        seen: *seen,
        schema: schema.encode(),
    };
    if let Err(why) = send(state, sender.node, Kind::SYNC_MISMATCH, &report) {
        let detail = format!("a report on the type of a message was not sent to {}: {why}", sender.node);
        state.ctx.refusals.count(Time::now(), "types", &detail);
    }
}

/// Writes the line of the log about a type that differs.
fn write(state: &NodeState, kind: Kind, ends: (&str, &str), judgement: &Judgement, seen: u64) {
    let name = type_name(state, kind);
    let words = sentence(ends, &name, judgement, seen);
    match judgement.treatment {
        Treatment::Refused | Treatment::Warned => log::warn!(%kind, "{words}"),
        Treatment::Accepted if judgement.is_doubtful => log::warn!(%kind, "{words}"),
        Treatment::Accepted | Treatment::Same => log::info!(%kind, "{words}"),
    }
}

/// Returns the name of a type, or its number.
fn type_name(state: &NodeState, kind: Kind) -> String {
    kind_name(&state.lncl, kind).unwrap_or_else(|| format!("kind {kind}"))
}

/// Returns the name of an application with its TID, or its TID alone.
fn title(state: &NodeState, tid: Tid) -> String {
    let name = lock(&state.sync.core).name_of(tid);
    name.map_or_else(|| tid.to_string(), |name| format!("{name} ({tid})"))
}

/// Sends a frame to the sync manager of another node.
fn send<T: Serialize>(state: &NodeState, to: NodeAddress, kind: Kind, frame: &T) -> Result<(), Rejection> {
    let source = Tid::new(state.ctx.node, AppAddress::SYNC);
    let mut header = Header::new(kind, source, Tid::new(to, AppAddress::SYNC));
    // A structure is not urgent.
    header.class = Class::Bulk;
    header.sequence = lock(&state.sync.core).next_sequence();
    header.sent = Time::now();
    state.ctx.router.send(Message::new(header, encode(frame)))
}

#[cfg(test)]
mod tests;
