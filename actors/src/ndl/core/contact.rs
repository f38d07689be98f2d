//! An address that NDL talks to: how it was found, what was asked there, and who answers.

use std::collections::{BTreeMap, VecDeque};

use sinew_runtime::{tid::NodeAddress, time::Time};

use super::{
    Source,
    budget::{Bucket, KNOWN},
};

/// A query that was sent and may be answered.
#[derive(Clone, Copy, Debug)]
pub(super) struct Question {
    pub(super) correlation: u64,
    pub(super) asked: Time,
}

/// The last queries to one destination that may still be answered: later ones make older ones void.
#[derive(Debug, Default)]
pub(super) struct Questions(VecDeque<Question>);

impl Questions {
    /// Keeps `question`, and of those before it as many that there are `most` at most.
    pub(super) fn push(&mut self, question: Question, most: usize) {
        while self.0.len() >= most {
            self.0.pop_front();
        }
        self.0.push_back(question);
    }

    pub(super) fn has(&self, correlation: u64) -> bool {
        self.0.iter().any(|question| question.correlation == correlation)
    }

    /// The question that `correlation` answers; each is answered once.
    pub(super) fn take(&mut self, correlation: u64) -> Option<Question> {
        let at = self.0.iter().position(|question| question.correlation == correlation)?;
        self.0.remove(at)
    }

    #[cfg(test)]
    pub(super) fn newest(&self) -> Option<Question> {
        self.0.back().copied()
    }

    pub(super) fn clear(&mut self) {
        self.0.clear();
    }
}

/// Who is at an address.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Role {
    /// Nobody who answered yet; asked this many times in the cycle.
    Candidate { asked: u32 },
    /// A member.
    Member(NodeAddress),
    /// Nobody any more. It is asked ever more seldom: after `left` cycles, and then after `wait`.
    Former { node: NodeAddress, wait: u32, left: u32 },
}

/// An address that NDL talks to.
#[derive(Debug)]
pub(super) struct Contact {
    pub(super) role: Role,
    /// Listed in the configuration: asked for ever.
    pub(super) is_seed: bool,
    /// Since when this address has been known.
    pub(super) since: Time,
    pub(super) sources: BTreeMap<Source, Time>,
    pub(super) questions: Questions,
    /// When it was asked last because of something that was heard.
    pub(super) looked_at: Option<Time>,
    /// Datagrams that it may send; only members and seeds have a budget of their own.
    pub(super) budget: Bucket,
    /// Answers to our questions that it may send.
    pub(super) answers: Bucket,
}

impl Contact {
    pub(super) fn new(now: Time, source: Source) -> Self {
        Self {
            role: Role::Candidate { asked: 0 },
            is_seed: false,
            since: now,
            sources: BTreeMap::from([(source, now)]),
            questions: Questions::default(),
            looked_at: None,
            budget: Bucket::full(KNOWN, now),
            answers: Bucket::full(KNOWN, now),
        }
    }

    /// One that the configuration lists.
    pub(super) fn seed(now: Time) -> Self {
        Self { is_seed: true, ..Self::new(now, Source::Seed) }
    }

    /// One of which only a member says that it is its own. A stranger may have said so in its name: that is no source.
    pub(super) fn announced(now: Time) -> Self {
        Self { sources: BTreeMap::new(), ..Self::new(now, Source::Query) }
    }

    /// Where a node may be that was lost.
    pub(super) fn former(now: Time, node: NodeAddress) -> Self {
        let role = Role::Former { node, wait: 1, left: 0 };
        Self { role, ..Self::announced(now) }
    }

    /// Where a node was before this one was started anew.
    pub(super) fn remembered(now: Time, node: NodeAddress) -> Self {
        Self { sources: BTreeMap::from([(Source::Remembered, now)]), ..Self::former(now, node) }
    }

    /// A source names it, perhaps anew, also while it was about to be forgotten.
    pub(super) fn heard_of(&mut self, now: Time, source: Source) {
        self.sources.entry(source).or_insert(now);
        if let Role::Candidate { asked } = &mut self.role {
            *asked = 0;
        }
    }

    /// A candidate that was asked so often since it was heard of last; a seed is asked for ever.
    pub(super) const fn has_missed(&self, missed_max: u32) -> bool {
        matches!(self.role, Role::Candidate { asked } if asked >= missed_max) && !self.is_seed
    }

    /// Nothing else speaks for this address: nobody was heard there since, and it is not listed.
    pub(super) fn is_remembered_alone(&self) -> bool {
        let is_asked_for_it = matches!(self.role, Role::Candidate { .. } | Role::Former { .. });
        is_asked_for_it && !self.is_seed && self.sources.keys().eq(&[Source::Remembered])
    }

    pub(super) fn is_former_of(&self, node: NodeAddress) -> bool {
        matches!(self.role, Role::Former { node: former, .. } if former == node)
    }

    pub(super) fn is_candidate(&self) -> bool {
        matches!(self.role, Role::Candidate { .. }) && !self.is_seed && !self.is_announced_only()
    }

    /// Nobody was heard there: only a member says that it is its own. These have room of their own.
    pub(super) fn is_announced_only(&self) -> bool {
        matches!(self.role, Role::Candidate { .. }) && !self.is_seed && self.sources.is_empty()
    }

    /// Whether its datagrams are counted against its own budget, not the strangers'.
    pub(super) const fn has_own_budget(&self) -> bool {
        matches!(self.role, Role::Member(_)) || self.is_seed
    }
}
