//! The copy of the directory that a child has, so that it need not ask.

use std::collections::{BTreeMap, BTreeSet};

use sinew_runtime::tid::Tid;

use super::words::{NAMES_MAX, Name, Names};
use crate::{
    lncl,
    stores::{Stores, lock},
};

/// What a child knows of the directory. All of it up to [`NAMES_MAX`] names; beyond that, the names that it asked for. What it could not be told
/// it does not know: then the copy of before is the right one.
#[derive(Clone, Debug, Default)]
pub(super) struct KnownNames {
    known: BTreeMap<String, Option<u64>>,
    complete: bool,
}

impl KnownNames {
    /// What the child has to be told, if anything has changed.
    pub(super) fn changes(&mut self, stores: &Stores) -> Option<Names> {
        let all = all_names(stores);
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
            let tid = lncl::resolve(stores, name).map(Tid::bits);
            if tid != *known {
                *known = tid;
                names.push(Name { name: name.clone(), tid, watched: true });
            }
        }
        let is_news = !names.is_empty() || complete != self.complete;
        self.complete = complete;
        is_news.then_some(Names { names, complete })
    }

    /// Answers the child's question after a name.
    pub(super) fn look(&mut self, stores: &Stores, name: String) -> Names {
        let tid = lncl::resolve(stores, &name).map(Tid::bits);
        let watched = self.known.len() < NAMES_MAX || self.known.contains_key(&name);
        if watched {
            self.known.insert(name.clone(), tid);
        }
        Names { names: vec![Name { name, tid, watched }], complete: self.complete }
    }

    /// The child could not be told whose this name is: it is among the next [`changes`](Self::changes), if it is anybody's. Who hears nothing
    /// takes it for nobody's.
    pub(super) fn owe(&mut self, name: String) {
        if self.known.len() < NAMES_MAX {
            self.known.entry(name).or_insert(None);
        }
    }
}

fn all_names(stores: &Stores) -> BTreeSet<String> {
    let directory = lock(&stores.sync).directory();
    let mut names: BTreeSet<_> = directory.into_iter().map(|entry| entry.name).collect();
    // The sync manager hears of these a moment later.
    names.extend(lock(&stores.registry).names());
    names
}
