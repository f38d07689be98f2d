//! Which names a child wants to know, and which of them it has to be told of.

use std::collections::BTreeMap;

use sinew_runtime::tid::Tid;

use super::words::{NAMES_MAX, Name};
use crate::{lncl, stores::Stores};

/// The names that a child knows, as it knows them. At most [`NAMES_MAX`].
#[derive(Debug, Default)]
pub(super) struct KnownNames(BTreeMap<String, Option<u64>>);

impl KnownNames {
    /// Answers the child's question after a name.
    pub(super) fn look(&mut self, stores: &Stores, name: String) -> Name {
        let tid = lncl::resolve(stores, &name).map(Tid::bits);
        let watched = self.0.len() < NAMES_MAX || self.0.contains_key(&name);
        if watched {
            self.0.insert(name.clone(), tid);
        }
        Name { name, tid, watched }
    }

    /// The names whose holder is another one than the child knows.
    pub(super) fn changed(&mut self, stores: &Stores) -> Vec<Name> {
        let mut changed = Vec::new();
        for (name, known) in &mut self.0 {
            let tid = lncl::resolve(stores, name).map(Tid::bits);
            if tid != *known {
                *known = tid;
                changed.push(Name { name: name.clone(), tid, watched: true });
            }
        }
        changed
    }
}
