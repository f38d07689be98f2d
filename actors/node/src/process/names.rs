//! The child's copy of the directory, which saves it lookups.

use std::collections::{BTreeMap, BTreeSet};

use sinew_runtime::{lock, tid::Tid};

use super::protocol::{NAMES_MAX, Name, Names};
use crate::NodeState;

/// The directory as a child knows it: all of it up to [`NAMES_MAX`] names, beyond that the names that it
/// looked up. If an update cannot be sent, the earlier copy stays the valid one.
#[derive(Clone, Debug, Default)]
pub(super) struct KnownNames {
    known: BTreeMap<String, Option<u64>>,
    complete: bool,
}

impl KnownNames {
    /// Returns the update for the child, if the directory has changed.
    pub(super) fn changes(&mut self, state: &NodeState) -> Option<Names> {
        let all = all_names(state);
        let complete = all.len() <= NAMES_MAX;
        let mut names = Vec::new();
        if complete {
            self.known.retain(|name, _| {
                let stays = all.contains(name);
                if !stays {
                    names.push(Name { name: name.clone(), tid: None, watched: true });
                }
                stays
            });
            for name in all {
                self.known.entry(name).or_insert(None);
            }
        }
        for (name, known) in &mut self.known {
            let tid = sinew_lncl::resolve(&state.lncl, name).map(Tid::bits);
            if tid != *known {
                *known = tid;
                names.push(Name { name: name.clone(), tid, watched: true });
            }
        }
        let has_changed = !names.is_empty() || complete != self.complete;
        self.complete = complete;
        has_changed.then_some(Names { names, complete })
    }

    /// Answers the child's lookup of a name.
    pub(super) fn look_up(&mut self, state: &NodeState, name: String) -> Names {
        let tid = sinew_lncl::resolve(&state.lncl, &name).map(Tid::bits);
        let watched = self.known.len() < NAMES_MAX || self.known.contains_key(&name);
        if watched {
            self.known.insert(name.clone(), tid);
        }
        Names { names: vec![Name { name, tid, watched }], complete: self.complete }
    }

    /// Marks a name after a failed answer: the next [`changes`](Self::changes) include it if it is in use.
    /// Without an answer, the child takes the name for unused.
    pub(super) fn mark_pending(&mut self, name: String) {
        if self.known.len() < NAMES_MAX {
            self.known.entry(name).or_insert(None);
        }
    }
}

fn all_names(state: &NodeState) -> BTreeSet<String> {
    let directory = lock(&state.sync.core).directory();
    let mut names: BTreeSet<_> = directory.into_iter().map(|entry| entry.name).collect();
    // The sync manager learns of these a moment later.
    names.extend(lock(&state.lncl.registry).names());
    names
}
