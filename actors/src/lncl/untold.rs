//! What the sync manager and NDL are to be told of this node's applications, until they have it.
//!
//! Where a layer's post is full its facts wait here, in order, and go on when it has read something. Meanwhile a fact takes the place of those
//! that it makes out of date: of each application is kept that the life is over of which the layer knows, and what is so now. So what waits is
//! bounded by how many applications there may be, and the layer, however long it stood still, ends with what the registry says.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::Mutex,
};

use sinew_runtime::tid::AppAddress;

use super::AppFact;
use crate::{
    ndl,
    stores::{Posts, lock},
    sync,
};

/// What is to be told to both layers. It outlives them.
#[derive(Debug)]
pub(crate) struct Untold {
    sync: Mutex<Facts>,
    ndl: Mutex<Facts>,
}

/// What is to be told to one of them.
#[derive(Debug)]
struct Facts {
    reader: Reader,
    /// By their order.
    facts: BTreeMap<u64, AppFact>,
    numbered: u64,
    /// Where the facts of each application are; those of no application stand under `None`.
    of: BTreeMap<Option<AppAddress>, Vec<u64>>,
    /// The applications that are there, by what the layer was told: no more than are registered at one time.
    told: BTreeSet<AppAddress>,
}

/// Whom facts are for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Reader {
    Sync,
    Ndl,
}

/// What a fact does to what its reader knows of an application.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Role {
    /// The reader knows it from now on.
    Begins,
    /// The same one is otherwise.
    Changes,
    /// The reader knows it no more.
    Ends,
}

impl Reader {
    const fn role(self, fact: &AppFact) -> Role {
        match (self, fact) {
            (Self::Sync, AppFact::Registered { .. }) | (Self::Ndl, AppFact::Ready { .. }) => Role::Begins,
            (_, AppFact::Unregistered { .. })
            | (Self::Ndl, AppFact::Down { .. } | AppFact::Stopped { .. }) => Role::Ends,
            (Self::Sync, AppFact::Ready { .. } | AppFact::Down { .. } | AppFact::Stopped { .. })
            | (_, AppFact::Handles { .. } | AppFact::GroupsChanged)
            | (Self::Ndl, AppFact::Registered { .. }) => Role::Changes,
        }
    }
}

const fn about(fact: &AppFact) -> Option<AppAddress> {
    match fact {
        AppFact::Registered { app, .. }
        | AppFact::Handles { app, .. }
        | AppFact::Ready { app }
        | AppFact::Down { app }
        | AppFact::Stopped { app }
        | AppFact::Unregistered { app } => Some(*app),
        AppFact::GroupsChanged => None,
    }
}

/// Whether of one life of an application `former` need not be told before `later`.
const fn is_out_of_date(former: &AppFact, later: &AppFact) -> bool {
    match later {
        AppFact::Down { .. } | AppFact::Stopped { .. } => {
            matches!(former, AppFact::Ready { .. } | AppFact::Down { .. } | AppFact::Stopped { .. })
        }
        AppFact::Ready { .. } => matches!(former, AppFact::Ready { .. }),
        AppFact::Handles { .. } => matches!(former, AppFact::Handles { .. }),
        AppFact::GroupsChanged => matches!(former, AppFact::GroupsChanged),
        AppFact::Registered { .. } | AppFact::Unregistered { .. } => false,
    }
}

impl Untold {
    /// Nothing yet.
    pub(crate) const fn new() -> Self {
        Self { sync: Mutex::new(Facts::new(Reader::Sync)), ndl: Mutex::new(Facts::new(Reader::Ndl)) }
    }

    /// Tells the sync manager this, behind what it was not told yet. Returns whether it has room for all of it. For who holds the registry's
    /// lock, as facts are put together in the order in which they come.
    pub(super) fn tell_sync(&self, posts: &Posts, fact: AppFact) -> bool {
        let mut facts = lock(&self.sync);
        facts.note(fact);
        facts.offer_to_sync(posts)
    }

    /// The same of NDL.
    pub(super) fn tell_ndl(&self, posts: &Posts, fact: AppFact) -> bool {
        let mut facts = lock(&self.ndl);
        facts.note(fact);
        facts.offer_to_ndl(posts)
    }

    /// Tells the sync manager what it has room for by now. By itself behind each event: whoever found its post full and keeps a fact has done so
    /// before the sync manager has read on, as both have the lock.
    pub(crate) fn offer_to_sync(&self, posts: &Posts) -> bool {
        lock(&self.sync).offer_to_sync(posts)
    }

    /// The same of NDL.
    pub(crate) fn offer_to_ndl(&self, posts: &Posts) -> bool {
        lock(&self.ndl).offer_to_ndl(posts)
    }

    /// How many facts wait for the layer for which most do.
    #[cfg(test)]
    pub(super) fn most(&self) -> usize {
        [&self.sync, &self.ndl].map(|facts| lock(facts).facts.len()).into_iter().max().unwrap_or(0)
    }
}

impl Facts {
    const fn new(reader: Reader) -> Self {
        Self { reader, facts: BTreeMap::new(), numbered: 0, of: BTreeMap::new(), told: BTreeSet::new() }
    }

    fn note(&mut self, fact: AppFact) {
        let (app, role) = (about(&fact), self.reader.role(&fact));
        let (reader, facts) = (self.reader, &mut self.facts);
        let kept = self.of.entry(app).or_default();
        kept.retain(|number| {
            let is_kept = facts.get(number).is_some_and(|former| match role {
                // That the life is over which the reader knows stays where it stood: the next one to have that name may be told behind it.
                Role::Begins | Role::Ends => reader.role(former) == Role::Ends,
                Role::Changes => !is_out_of_date(former, &fact),
            });
            if !is_kept {
                facts.remove(number);
            }
            is_kept
        });
        let last = kept.iter().rev().filter_map(|number| facts.get(number)).map(|kept| reader.role(kept));
        let last = last.into_iter().find(|role| *role != Role::Changes);
        let is_there = match (last, app) {
            (Some(last), _) => last == Role::Begins,
            (None, Some(app)) => self.told.contains(&app),
            (None, None) => true,
        };
        // What is new of somebody whom the reader does not know is nothing to it.
        if role == Role::Begins || is_there {
            kept.push(self.numbered);
            facts.insert(self.numbered, fact);
            self.numbered += 1;
        }
        if kept.is_empty() {
            self.of.remove(&app);
        }
    }

    /// Offers one after the other, until one is not taken. Returns whether all were.
    fn offer(&mut self, mut takes: impl FnMut(&AppFact) -> bool) -> bool {
        while let Some(first) = self.facts.first_entry() {
            if !takes(first.get()) {
                return false;
            }
            let (number, fact) = first.remove_entry();
            let app = about(&fact);
            if let Some(kept) = self.of.get_mut(&app) {
                kept.retain(|kept| *kept != number);
                if kept.is_empty() {
                    self.of.remove(&app);
                }
            }
            match (self.reader.role(&fact), app) {
                (Role::Begins, Some(app)) => {
                    self.told.insert(app);
                }
                (Role::Ends, Some(app)) => {
                    self.told.remove(&app);
                }
                (Role::Changes, _) | (_, None) => {}
            }
        }
        true
    }

    fn offer_to_sync(&mut self, posts: &Posts) -> bool {
        self.offer(|fact| posts.sync.post(sync::Event::App(fact.clone())).is_ok())
    }

    fn offer_to_ndl(&mut self, posts: &Posts) -> bool {
        self.offer(|fact| posts.ndl.post(ndl::Event::App(fact.clone())).is_ok())
    }
}

#[cfg(test)]
mod tests;
