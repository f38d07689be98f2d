//! The queries that were sent and may still be answered, and their correlation ids.

use std::{
    collections::VecDeque,
    hash::{DefaultHasher, Hash, Hasher},
};

use sinew_runtime::time::Time;

/// A query that was sent and may be answered.
#[derive(Clone, Copy, Debug)]
pub(super) struct SentQuery {
    pub(super) correlation: u64,
    pub(super) sent: Time,
}

/// The last queries to one destination that may still be answered. Later queries void older ones.
#[derive(Debug, Default)]
pub(super) struct SentQueries(VecDeque<SentQuery>);

impl SentQueries {
    /// Adds `query`, and drops older ones so that at most `most` remain.
    pub(super) fn push(&mut self, query: SentQuery, most: usize) {
        while self.0.len() >= most {
            self.0.pop_front();
        }
        self.0.push_back(query);
    }

    pub(super) fn has(&self, correlation: u64) -> bool {
        self.0.iter().any(|query| query.correlation == correlation)
    }

    /// Removes and returns the query that `correlation` answers. Each query is answered once.
    pub(super) fn take(&mut self, correlation: u64) -> Option<SentQuery> {
        let at = self.0.iter().position(|query| query.correlation == correlation)?;
        self.0.remove(at)
    }

    #[cfg(test)]
    pub(super) fn newest(&self) -> Option<SentQuery> {
        self.0.back().copied()
    }

    pub(super) fn clear(&mut self) {
        self.0.clear();
    }
}

/// The generator of correlation ids. A node that has not seen an id cannot guess it.
#[derive(Debug)]
pub(super) struct Correlations {
    secret: u128,
    /// Number of ids so far.
    drawn: u64,
}

impl Correlations {
    /// Creates a generator. `secret` is random and never sent.
    pub(super) const fn new(secret: u128) -> Self {
        Self { secret, drawn: 0 }
    }

    /// Returns an unused id.
    pub(super) fn draw(&mut self) -> u64 {
        self.drawn += 1;
        let mut hasher = DefaultHasher::new();
        (self.secret, self.drawn).hash(&mut hasher);
        hasher.finish()
    }

    pub(super) const fn drawn(&self) -> u64 {
        self.drawn
    }
}
