//! The types that applications of other nodes send and applications of this node handle in different versions, and the
//! verdicts on them. Pure: the caller passes the time.

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

use super::judgement::{Judgement, Treatment};

/// Time after which a structure that did not come is requested again.
pub(super) const ASK_AGAIN: Duration = Duration::from_secs(2);
/// Minimum time between two log lines about one path.
pub(super) const TELL_AGAIN: Duration = Duration::from_secs(60);

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
    pub(super) schema: &'static Schema,
}

/// A type that an application of another node sends.
#[derive(Clone, Debug)]
pub(super) struct Sent {
    pub(super) tid: Tid,
    /// The name of the application.
    pub(super) name: Arc<str>,
    pub(super) kind: Kind,
    pub(super) hash: SchemaHash,
}

/// A structure to be requested from the node that has it.
pub(super) type Wanted = (NodeAddress, TypeHash);

/// The verdicts on all paths with types that differ: at most [`MISMATCHES_MAX`], and as many structures.
#[derive(Debug, Default)]
pub(crate) struct Verdicts {
    pairs: BTreeMap<TypedPath, Pair>,
    /// The structures that a pair needs, by the node that sent them. A hash is no proof: a node can construct a second
    /// structure of the same hash. So the structure of one node says nothing about the messages of another one.
    fetched: BTreeMap<Wanted, Schema>,
    /// When each missing structure was requested last.
    asked: BTreeMap<Wanted, Time>,
    /// When each path was logged last, for those within [`TELL_AGAIN`].
    told: BTreeMap<TypedPath, Time>,
}

#[derive(Clone, Debug)]
struct Pair {
    source: Arc<str>,
    target: String,
    sent: SchemaHash,
    handled: SchemaHash,
    policy: MismatchPolicy,
    is_protected: bool,
    schema: &'static Schema,
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
    pub(super) handled: (SchemaHash, &'static Schema),
    /// The number of messages so far.
    pub(crate) seen: u64,
}

/// Returns the effect of a refusal. The guard of a protected type notices it at once, as a payload that cannot be decoded.
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
            schema: handled.schema,
            pending: (handled.policy == MismatchPolicy::Refuse)
                .then(|| Mismatch::new(refusal(handled.is_protected))),
            verdict: None,
        }
    }

    fn is_of(&self, sent: &Sent, handled: &Handled) -> bool {
        (self.sent, self.handled, self.policy) == (sent.hash, handled.hash, handled.policy)
            && (&*self.source, self.target.as_str()) == (&*sent.name, handled.name.as_str())
    }

    /// Returns the sender's structure and its node.
    const fn wanted(&self, path: &TypedPath) -> Wanted {
        (path.source.node, (path.kind, self.sent))
    }

    fn judge(&mut self, sent: &Schema) {
        let judgement = Judgement::of(sent, self.schema, self.policy);
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
            handled: (self.handled, self.schema),
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
        let mut pairs = BTreeMap::new();
        for sent in sent {
            let handled = by_kind.get(&sent.kind).into_iter().flatten();
            for handled in handled.filter(|handled| handled.hash != sent.hash) {
                if pairs.len() >= MISMATCHES_MAX {
                    break;
                }
                let path = TypedPath { source: sent.tid, target: handled.app, kind: sent.kind };
                let former = self.pairs.remove(&path).filter(|pair| pair.is_of(sent, handled));
                let mut pair = former.unwrap_or_else(|| Pair::new(sent, handled));
                if pair.verdict.is_none()
                    && let Some(schema) = self.fetched.get(&(sent.tid.node, (sent.kind, sent.hash)))
                {
                    pair.judge(schema);
                }
                pairs.insert(path, pair);
            }
        }
        self.pairs = pairs;
        self.wanted(now)
    }

    fn wanted(&mut self, now: Time) -> Vec<Wanted> {
        let used: BTreeSet<Wanted> = self.pairs.iter().map(|(path, pair)| pair.wanted(path)).collect();
        self.fetched.retain(|of, _| used.contains(of));
        let open = self.open();
        self.asked.retain(|asked, _| open.contains(asked));
        let is_due = |wanted: &Wanted, asked: &BTreeMap<Wanted, Time>| {
            asked.get(wanted).is_none_or(|at| now.since(*at) >= ASK_AGAIN)
        };
        let due: Vec<_> = open.into_iter().filter(|wanted| is_due(wanted, &self.asked)).collect();
        self.asked.extend(due.iter().map(|wanted| (*wanted, now)));
        due
    }

    /// Returns the missing structures.
    fn open(&self) -> BTreeSet<Wanted> {
        let open = self.pairs.iter().filter(|(_, pair)| pair.verdict.is_none());
        open.map(|(path, pair)| pair.wanted(path)).collect()
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
        for (path, pair) in &mut self.pairs {
            if pair.wanted(path) == wanted && pair.verdict.is_none() {
                pair.judge(&schema);
            }
        }
        self.asked.remove(&wanted);
        self.fetched.insert(wanted, schema);
        Ok(())
    }

    /// Returns the disagreements of which messages have arrived and that were not logged within [`TELL_AGAIN`].
    pub(super) fn take_due(&mut self, now: Time) -> Vec<Disagreement> {
        self.told.retain(|_, at| now.since(*at) < TELL_AGAIN);
        let mut due = Vec::new();
        for (path, pair) in &mut self.pairs {
            let is_full = self.told.len() >= MISMATCHES_MAX;
            if is_full || self.told.contains_key(path) {
                continue;
            }
            if let Some(verdict) = &mut pair.verdict
                && verdict.is_watched()
                && verdict.mismatch.take_notified()
            {
                verdict.is_told = true;
                self.told.insert(*path, now);
                due.extend(pair.disagreement(*path));
            }
        }
        due
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
        let asked = self.asked.values().map(|at| *at + ASK_AGAIN);
        let told = self.told.values().map(|at| *at + TELL_AGAIN);
        asked.chain(told).min()
    }

    /// Returns all disagreements, in the order of their senders.
    pub(crate) fn disagreements(&self) -> Vec<Disagreement> {
        self.pairs.iter().filter_map(|(path, pair)| pair.disagreement(*path)).collect()
    }

    /// Returns the structure that this node has sent.
    pub(crate) fn fetched(&self, from: NodeAddress, of: TypeHash) -> Option<&Schema> {
        self.fetched.get(&(from, of))
    }
}

#[cfg(test)]
mod tests;
