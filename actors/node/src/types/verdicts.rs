//! The types that applications of this node handle in another version than their senders, on other nodes and in other
//! processes of this one, and the verdicts on them. Pure: the caller passes the time.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::Arc,
    time::Duration,
};

use sinew_model::facts::TypeHash;
use sinew_runtime::{
    router::mismatches::{Effect, MISMATCHES_MAX, Mismatch, TypedPath},
    tid::{AppAddress, NodeAddress, Tid},
    time::Time,
    wire::{Kind, MismatchPolicy, SchemaHash},
};
use sinew_schema::Schema;

use super::{
    app_type::Structure,
    judgement::{Judgement, Treatment},
};

/// Time after which a structure that did not come is requested again.
pub(super) const ASK_AGAIN: Duration = Duration::from_secs(2);
/// Minimum time between two log lines about one path.
pub(super) const TELL_AGAIN: Duration = Duration::from_secs(60);
/// Maximum number of paths from one node with types that differ, so that no node takes the room of the others.
const PATHS_OF_NODE_MAX: usize = 64;
/// Maximum number of paths from one node, and from all, that have other hashes and no difference on the wire. They take
/// no room in the routing table.
const SAME_OF_NODE_MAX: usize = 512;
const SAME_MAX: usize = 4_096;
/// Maximum number of structures that are requested from one node at once. It refuses more than that.
pub(super) const ASKED_OF_NODE_MAX: usize = 8;
/// Time after which paths that have no room are told. Verdicts without a difference on the wire may make room before.
const LEFT_OUT_AFTER: Duration = Duration::from_secs(10);
/// Maximum number of reports to one node in one step.
const TOLD_AT_ONCE_MAX: usize = 4;

/// A type that an application of this node handles.
#[derive(Clone, Debug)]
pub(super) struct Handled {
    pub(super) app: AppAddress,
    /// The name of the application.
    pub(super) name: String,
    pub(super) kind: Kind,
    pub(super) hash: SchemaHash,
    pub(super) policy: MismatchPolicy,
    /// Whether messages of the type have end-to-end protection.
    pub(super) is_protected: bool,
    pub(super) schema: Structure,
    pub(super) program: Program,
}

/// The program of an application of this node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Program {
    /// That of the node: its types are not compared with each other.
    Node,
    /// That of another process of the node's own user.
    Other,
    /// That of a guest: its pairs get the room that others leave.
    Guest,
}

/// A type that an application sends.
#[derive(Clone, Debug)]
pub(super) struct Sent {
    pub(super) tid: Tid,
    /// The name of the application.
    pub(super) name: Arc<str>,
    pub(super) kind: Kind,
    pub(super) hash: SchemaHash,
    /// The structure, if the application is one of this node.
    pub(super) here: Option<(Structure, Program)>,
}

impl Sent {
    /// Returns whether this type and one that is handled are those of two programs, and differ.
    fn differs_from(&self, handled: &Handled) -> bool {
        let is_own = matches!(self.here, Some((_, Program::Node)));
        self.hash != handled.hash && !(is_own && handled.program == Program::Node)
    }

    /// Returns whether one end of the path to an application with this type is a guest of this node.
    fn is_with_guest(&self, handled: &Handled) -> bool {
        handled.program == Program::Guest || matches!(self.here, Some((_, Program::Guest)))
    }
}

/// A structure to be requested from the node that has it.
pub(super) type Wanted = (NodeAddress, TypeHash);

/// The verdicts on all paths with types that differ: at most [`MISMATCHES_MAX`], and [`SAME_MAX`] without a difference
/// on the wire. There is at most one structure for each.
#[derive(Debug, Default)]
pub(crate) struct Verdicts {
    pairs: BTreeMap<TypedPath, Pair>,
    /// The structures that a pair needs, by the node that sent them. A hash is no proof: a node can construct a second
    /// structure of the same hash. So the structure of one node says nothing about the messages of another one.
    fetched: BTreeMap<Wanted, Arc<Schema>>,
    /// When each missing structure was requested last.
    asked: BTreeMap<Wanted, Time>,
    /// When each path was logged last, for those within [`TELL_AGAIN`].
    told: BTreeMap<TypedPath, Time>,
    /// When the missing structures were looked at last.
    looked_at: Time,
    /// When the next disagreements are due, if there were too many for one step.
    more_due: Option<Time>,
    /// The number of paths without room, and since when there were any.
    left_out: (usize, Option<Time>),
    is_left_out_told: bool,
    /// Whether a verdict has made room for one of them.
    has_made_room: bool,
}

/// The number of paths so far, of all nodes and of each.
#[derive(Debug, Default)]
struct Room {
    all: Places,
    of_node: BTreeMap<NodeAddress, Places>,
}

#[derive(Clone, Copy, Debug, Default)]
struct Places {
    differing: usize,
    same: usize,
}

impl Room {
    /// Takes a place for a path from `node`. Returns whether there was one.
    fn take(&mut self, node: NodeAddress, is_same: bool) -> bool {
        let (all, of_node) = (&mut self.all, self.of_node.entry(node).or_default());
        let (taken, of_all, max) = if is_same {
            (&mut of_node.same, &mut all.same, (SAME_OF_NODE_MAX, SAME_MAX))
        } else {
            (&mut of_node.differing, &mut all.differing, (PATHS_OF_NODE_MAX, MISMATCHES_MAX))
        };
        let has_room = *taken < max.0 && *of_all < max.1;
        *taken += usize::from(has_room);
        *of_all += usize::from(has_room);
        has_room
    }
}

/// Two structures to be compared. That may take some milliseconds, so it is done without the lock of the verdicts.
#[derive(Clone, Debug)]
pub(super) struct Case {
    path: TypedPath,
    sent: (SchemaHash, Structure),
    handled: (SchemaHash, Structure),
    policy: MismatchPolicy,
}

impl Case {
    /// Compares them.
    pub(super) fn judge(&self) -> Judgement {
        Judgement::of(&self.sent.1, &self.handled.1, self.policy)
    }
}

#[derive(Clone, Debug)]
struct Pair {
    source: Arc<str>,
    target: String,
    sent: SchemaHash,
    handled: SchemaHash,
    policy: MismatchPolicy,
    is_protected: bool,
    schema: Structure,
    /// The sender's structure, if it is an application of this node.
    sent_here: Option<Structure>,
    /// Refuses the messages until there is a verdict, for [`MismatchPolicy::Refuse`].
    pending: Option<Arc<Mismatch>>,
    verdict: Option<Verdict>,
}

#[derive(Clone, Debug)]
struct Verdict {
    judgement: Judgement,
    mismatch: Arc<Mismatch>,
    is_told: bool,
}

/// A path of which messages have arrived, for the logs of both nodes.
#[derive(Clone, Debug)]
pub(crate) struct Disagreement {
    pub(crate) path: TypedPath,
    /// The name of the sender.
    pub(crate) source: String,
    /// The name of the receiver.
    pub(crate) target: String,
    pub(crate) judgement: Judgement,
    /// The structure of the receiver's type, and its hash.
    pub(super) handled: (SchemaHash, Structure),
    /// The number of messages so far.
    pub(crate) seen: u64,
}

/// Returns the effect of a refusal. The guard of a protected type notices it at once, as a payload that cannot be
/// decoded.
const fn refusal(is_protected: bool) -> Effect {
    if is_protected { Effect::Spoiled } else { Effect::Refused }
}

impl Pair {
    fn new(sent: &Sent, handled: &Handled) -> Self {
        Self {
            source: sent.name.clone(),
            target: handled.name.clone(),
            sent: sent.hash,
            handled: handled.hash,
            policy: handled.policy,
            is_protected: handled.is_protected,
            schema: handled.schema.clone(),
            sent_here: sent.here.as_ref().map(|(structure, _)| structure.clone()),
            // The guard of a protected type would trip for a difference that may turn out to be none.
            pending: (handled.policy == MismatchPolicy::Refuse && !handled.is_protected)
                .then(|| Mismatch::new(Effect::Refused)),
            verdict: None,
        }
    }

    fn is_of(&self, sent: &Sent, handled: &Handled) -> bool {
        (self.sent, self.handled, self.policy) == (sent.hash, handled.hash, handled.policy)
            && (&*self.source, self.target.as_str()) == (&*sent.name, handled.name.as_str())
    }

    /// Returns the sender's structure and its node. `None`: the sender is an application of this node.
    fn wanted(&self, path: &TypedPath) -> Option<Wanted> {
        self.sent_here.is_none().then_some((path.source.node, (path.kind, self.sent)))
    }

    fn is_same(&self) -> bool {
        self.verdict.as_ref().is_some_and(|verdict| verdict.judgement.treatment == Treatment::Same)
    }

    fn decide(&mut self, judgement: Judgement) {
        let mismatch = Mismatch::new(match judgement.treatment {
            Treatment::Same | Treatment::Accepted | Treatment::Warned => Effect::Counted,
            Treatment::Refused => refusal(self.is_protected),
        });
        self.verdict = Some(Verdict { judgement, mismatch, is_told: false });
    }

    fn disagreement(&self, path: TypedPath) -> Option<Disagreement> {
        let Verdict { judgement, mismatch, .. } = self.verdict.as_ref()?;
        (judgement.treatment != Treatment::Same).then(|| Disagreement {
            path,
            source: self.source.to_string(),
            target: self.target.clone(),
            judgement: judgement.clone(),
            handled: (self.handled, self.schema.clone()),
            seen: mismatch.seen(),
        })
    }
}

impl Verdict {
    /// Returns whether the routing table must see the messages. Those that are accepted are reported once.
    const fn is_watched(&self) -> bool {
        match self.judgement.treatment {
            Treatment::Same => false,
            Treatment::Accepted => !self.is_told,
            Treatment::Warned | Treatment::Refused => true,
        }
    }
}

impl Verdicts {
    /// Replaces the declared types. Returns the structures to be requested now.
    pub(super) fn declare<'a>(
        &mut self,
        now: Time,
        handled: &[Handled],
        sent: impl IntoIterator<Item = &'a Sent>,
    ) -> Vec<Wanted> {
        let mut by_kind: BTreeMap<Kind, Vec<&Handled>> = BTreeMap::new();
        for handled in handled {
            by_kind.entry(handled.kind).or_default().push(handled);
        }
        let sent: Vec<&Sent> = sent.into_iter().collect();
        let (mut pairs, mut room, mut left_out) = (BTreeMap::new(), Room::default(), 0);
        for of_guests in [false, true] {
            for sent in &sent {
                let handled = by_kind.get(&sent.kind).into_iter().flatten();
                let differing = handled.filter(|handled| sent.differs_from(handled));
                for handled in differing.filter(|handled| sent.is_with_guest(handled) == of_guests) {
                    let path = TypedPath { source: sent.tid, target: handled.app, kind: sent.kind };
                    let former = self.pairs.remove(&path).filter(|pair| pair.is_of(sent, handled));
                    let pair = former.unwrap_or_else(|| Pair::new(sent, handled));
                    if room.take(sent.tid.node, pair.is_same()) {
                        pairs.insert(path, pair);
                    } else {
                        left_out += 1;
                    }
                }
            }
        }
        let since = (left_out > 0).then(|| self.left_out.1.unwrap_or(now));
        (self.pairs, self.left_out, self.has_made_room) = (pairs, (left_out, since), false);
        self.wanted(now)
    }

    fn wanted(&mut self, now: Time) -> Vec<Wanted> {
        let used: BTreeSet<Wanted> = self.pairs.iter().filter_map(|(path, pair)| pair.wanted(path)).collect();
        self.fetched.retain(|of, _| used.contains(of));
        let open = self.open();
        self.asked.retain(|asked, _| open.contains(asked));
        let mut waiting: BTreeMap<NodeAddress, usize> = BTreeMap::new();
        for ((node, _), at) in &self.asked {
            *waiting.entry(*node).or_default() += usize::from(now.since(*at) < ASK_AGAIN);
        }
        // Those that were never requested come first: an answer that does not come holds no other one up.
        let is_due = |wanted: &Wanted| self.asked.get(wanted).is_none_or(|at| now.since(*at) >= ASK_AGAIN);
        let mut due: Vec<_> = open.into_iter().filter(is_due).collect();
        due.sort_by_key(|wanted| self.asked.get(wanted).copied());
        due.retain(|(node, _)| {
            let waiting = waiting.entry(*node).or_default();
            *waiting += 1;
            *waiting <= ASKED_OF_NODE_MAX
        });
        self.asked.extend(due.iter().map(|wanted| (*wanted, now)));
        self.looked_at = now;
        due
    }

    /// Returns the missing structures.
    fn open(&self) -> BTreeSet<Wanted> {
        let unjudged = self.pairs.iter().filter(|(_, pair)| pair.verdict.is_none());
        let wanted = unjudged.filter_map(|(path, pair)| pair.wanted(path));
        wanted.filter(|wanted| !self.fetched.contains_key(wanted)).collect()
    }

    /// Returns the paths without a verdict of which both structures are there.
    pub(super) fn cases(&self) -> Vec<Case> {
        let unjudged = self.pairs.iter().filter(|(_, pair)| pair.verdict.is_none());
        let case = |(path, pair): (&TypedPath, &Pair)| {
            let sent = match pair.wanted(path) {
                Some(wanted) => Structure::Declared(self.fetched.get(&wanted)?.clone()),
                None => pair.sent_here.clone()?,
            };
            let (sent, handled) = ((pair.sent, sent), (pair.handled, pair.schema.clone()));
            Some(Case { path: *path, sent, handled, policy: pair.policy })
        };
        unjudged.filter_map(case).collect()
    }

    /// Sets the verdict on a case, unless the types were declared anew since.
    pub(super) fn decide(&mut self, case: &Case, judgement: Judgement) {
        let Some(pair) = self.pairs.get_mut(&case.path) else { return };
        if (pair.sent, pair.handled, pair.policy) == (case.sent.0, case.handled.0, case.policy) {
            pair.decide(judgement);
            self.has_made_room |= pair.is_same() && self.left_out.0 > 0;
        }
    }

    /// Handles the structure that `from` sent, for the messages of `from` alone. One that is not missing is ignored.
    ///
    /// # Errors
    /// Returns the fault if the bytes are not the structure of this hash.
    pub(super) fn received(&mut self, from: NodeAddress, of: TypeHash, bytes: &[u8]) -> Result<(), String> {
        let wanted = (from, of);
        if !self.open().contains(&wanted) {
            return Ok(());
        }
        let schema =
            Schema::parse(bytes).map_err(|fault| format!("from {from}, of kind {}: {fault}", of.0))?;
        if schema.hash() != of.1 {
            return Err(format!("from {from}, of kind {}: it has another hash than requested", of.0));
        }
        self.asked.remove(&wanted);
        self.fetched.insert(wanted, Arc::new(schema));
        Ok(())
    }

    /// Returns the disagreements of which messages have arrived and that were not logged within [`TELL_AGAIN`].
    pub(super) fn take_due(&mut self, now: Time) -> Vec<Disagreement> {
        self.told.retain(|_, at| now.since(*at) < TELL_AGAIN);
        self.more_due = None;
        let (mut due, mut of_node) = (Vec::new(), BTreeMap::new());
        for (path, pair) in &mut self.pairs {
            let is_full = self.told.len() >= MISMATCHES_MAX;
            if is_full || self.told.contains_key(path) {
                continue;
            }
            let of_node = of_node.entry(path.source.node).or_insert(0);
            if let Some(verdict) = &mut pair.verdict
                && verdict.is_watched()
                && verdict.mismatch.is_notified()
            {
                if *of_node == TOLD_AT_ONCE_MAX {
                    self.more_due = Some(now);
                    continue;
                }
                *of_node += 1;
                verdict.mismatch.take_notified();
                verdict.is_told = true;
                self.told.insert(*path, now);
                due.extend(pair.disagreement(*path));
            }
        }
        due
    }

    /// Returns the number of paths without room, once, when there were some for [`LEFT_OUT_AFTER`].
    pub(super) fn take_left_out(&mut self, now: Time) -> Option<usize> {
        let is_due = self.left_out_due().is_some_and(|at| now >= at);
        self.is_left_out_told |= is_due;
        is_due.then_some(self.left_out.0)
    }

    fn left_out_due(&self) -> Option<Time> {
        self.left_out.1.filter(|_| !self.is_left_out_told).map(|since| since + LEFT_OUT_AFTER)
    }

    /// Returns the entries of the routing table.
    pub(super) fn table(&self) -> Vec<(TypedPath, Arc<Mismatch>)> {
        let entry = |(path, pair): (&TypedPath, &Pair)| {
            let mismatch = match &pair.verdict {
                Some(verdict) => Some(&verdict.mismatch).filter(|_| verdict.is_watched()),
                None => pair.pending.as_ref(),
            };
            Some((*path, mismatch?.clone()))
        };
        self.pairs.iter().filter_map(entry).collect()
    }

    /// Returns the time of the next request, or of the next log line that may be due.
    pub(super) fn next_wake(&self) -> Option<Time> {
        // A request that is overdue waits until another one is answered or overdue.
        let asked = self.asked.values().map(|at| *at + ASK_AGAIN).filter(|at| *at > self.looked_at);
        let told = self.told.values().map(|at| *at + TELL_AGAIN);
        let room = self.has_made_room.then_some(self.looked_at);
        asked.chain(told).chain(self.more_due).chain(self.left_out_due()).chain(room).min()
    }

    /// Returns all disagreements, in the order of their senders.
    pub(crate) fn disagreements(&self) -> Vec<Disagreement> {
        self.pairs.iter().filter_map(|(path, pair)| pair.disagreement(*path)).collect()
    }

    /// Returns the structure that this node has sent.
    pub(crate) fn fetched(&self, from: NodeAddress, of: TypeHash) -> Option<&Schema> {
        self.fetched.get(&(from, of)).map(|schema| &**schema)
    }
}

#[cfg(test)]
mod tests;
